//! HTTP routes.

mod actors;
mod cors;
mod episodes;
mod metrics;
mod openapi;
mod pushes;
mod refusal;
mod sessions;
mod table;
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
use axum::{Json, Router};

use crate::auth::Grant;
use crate::convert;
use crate::fault::Fault;
use crate::newcomers::ConnectionSlot;
use crate::state::ServerState;

use refusal::Refusal;
use table::Row;

/// The routes of a server.
pub(crate) fn router(state: Arc<ServerState>) -> Router {
    let json_limit = DefaultBodyLimit::max(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES);
    let all = |rows: Vec<Row>| {
        rows.into_iter()
            .fold(Router::new(), |router, row| router.route(row.operation.path, row.handler))
    };
    all(table::guarded())
        .route_layer(from_fn_with_state(state.clone(), authorize))
        .merge(all(table::open()))
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
