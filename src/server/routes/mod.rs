//! HTTP routes.

mod cors;
mod episodes;
mod metrics;
mod pushes;
mod refusal;
mod sessions;
mod tickets;
mod twins;
mod uploads;
mod viewer;
mod websocket;

use std::sync::Arc;

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Json, Router};

use crate::auth::Grant;
use crate::convert;
use crate::fault::Fault;
use crate::newcomers::ConnectionSlot;
use crate::state::ServerState;

use refusal::Refusal;

/// The routes of a server.
pub(crate) fn router(state: Arc<ServerState>) -> Router {
    let json_limit = DefaultBodyLimit::max(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES);
    let pages = viewer::FILES.iter().fold(Router::new(), |pages, &file| {
        pages.route(file.path, get(async move || file.response()))
    });
    Router::new()
        .route("/v1/session", get(websocket::upgrade))
        .route("/v1/sessions", get(sessions::list))
        .route("/v1/sessions/{session}/watch", get(websocket::watch))
        .route("/v1/tickets", post(tickets::issue))
        .route("/v1/episodes", get(episodes::list))
        .route("/v1/episodes/{episode}", get(episodes::show))
        .route("/v1/twins", get(twins::list))
        .route("/v1/twins/{twin}", get(twins::show))
        .route("/v1/twins/{twin}/versions", get(twins::versions))
        .route("/v1/twins/{twin}/trajectories/{name}", get(twins::trajectory))
        .route("/v1/twins/{twin}/rollback", post(twins::rollback))
        .route("/v1/twins/{twin}/pushes", post(pushes::begin))
        .route("/v1/twins/{twin}/pushes/{id}", get(pushes::show).delete(pushes::cancel))
        .route("/v1/uploads", post(uploads::begin))
        // The body of an upload is not held in memory: it is written to disk as it arrives.
        .route(
            "/v1/uploads/{id}",
            get(uploads::show)
                .delete(uploads::delete)
                .patch(uploads::append)
                .layer(DefaultBodyLimit::disable()),
        )
        .route("/metrics", get(metrics::show))
        // The routes above need a token on a server with tokens; those below need none.
        .route_layer(from_fn_with_state(state.clone(), authorize))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(ready))
        .merge(pages)
        .fallback(no_route)
        .method_not_allowed_fallback(no_method)
        .layer(json_limit)
        .layer(from_fn_with_state(state.clone(), metrics::count_refusals))
        .layer(from_fn_with_state(state.clone(), cors::answer))
        .with_state(state)
}

/// Refuses requests without a valid token, and passes the token's [`Grant`] to the routes.
async fn authorize(
    State(state): State<Arc<ServerState>>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    let header = request.headers().get(header::HOST).map(|host| host.to_str().unwrap_or_default());
    let host = request.uri().authority().map(|authority| authority.as_str()).or(header);
    let has_tokens = state.tokens.is_some();
    state.origins.check_page(request.headers(), has_tokens, host)?;
    let grant = match &state.tokens {
        Some(tokens) => match tickets::of(&request) {
            Some(ticket) => state.tickets.redeem(ticket)?,
            None => {
                let authorization = request.headers().get(header::AUTHORIZATION);
                tokens.grant(authorization.map(|value| value.as_bytes()))?
            }
        },
        None => Grant::everything(),
    };
    state.origins.check_host(has_tokens, host)?;
    if let Some(slot) = request.extensions().get::<Arc<ConnectionSlot>>() {
        slot.become_known()?;
    }
    request.extensions_mut().insert(grant);
    Ok(next.run(request).await)
}

/// `GET /readyz`: whether sessions can be opened, which needs the list of twins.
async fn ready(State(state): State<Arc<ServerState>>) -> Response {
    match state.engine.check_twins().await {
        Ok(()) => "ready\n".into_response(),
        Err(error) => {
            let body = Json(convert::refusal_body(&error.into()));
            (StatusCode::SERVICE_UNAVAILABLE, body).into_response()
        }
    }
}

async fn no_route(uri: Uri) -> Refusal {
    Fault::NoRoute { path: uri.path().to_owned() }.into()
}

async fn no_method(method: Method, uri: Uri) -> Refusal {
    Fault::NoMethod { method: method.to_string(), path: uri.path().to_owned() }.into()
}
