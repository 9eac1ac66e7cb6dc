//! HTTP routes.

mod actors;
mod cors;
#[cfg(test)]
mod costs;
mod episodes;
mod metrics;
mod openapi;
mod pushes;
mod refusal;
mod scenarios;
mod sessions;
mod table;
mod tickets;
mod twins;
mod uploads;
mod viewer;
mod websocket;

use std::sync::Arc;

use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{DefaultBodyLimit, RawPathParams, Request, State};
use axum::http::{HeaderName, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Json, RequestExt as _, Router};

use crate::admission::ConnectionSlot;
use crate::auth::{Access, Grant};
use crate::fault::Fault;
use crate::state::ServerState;

use refusal::Refusal;
use table::{Operation, Row};

/// The routes of a server.
pub(crate) fn router(state: Arc<ServerState>) -> Router {
    let json_limit = DefaultBodyLimit::max(wildcity_protocol::limits::INBOUND_MESSAGE_BYTES);
    let mut router = Router::new();
    for Row { operation, handler } in table::rows() {
        let Operation { path, access, .. } = operation;
        let handler = match access {
            Access::Public => handler,
            // A layer for each route and not for the router: `authorize` needs the row of the
            // table, and paths that do not exist need no token.
            access => {
                let guard = Guard { state: state.clone(), path, access };
                handler.route_layer(from_fn_with_state(guard, authorize))
            }
        };
        router = router.route(path, handler);
    }
    router
        .fallback(no_route)
        .method_not_allowed_fallback(no_method)
        // The last layer runs first: CORS answers a preflight, then refusals are counted, and then
        // the body is limited.
        .layer(json_limit)
        .layer(from_fn_with_state(state.clone(), metrics::count_refusals))
        .layer(from_fn_with_state(state.clone(), cors::answer))
        .with_state(state)
}

/// The routes of the listener for metrics, which takes no tokens.
pub(crate) fn open_router(state: Arc<ServerState>) -> Router {
    Router::new()
        .route(metrics::PATH, get(metrics::show_all))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(ready))
        .fallback(no_route)
        .method_not_allowed_fallback(no_method)
        .with_state(state)
}

/// Access control of a route.
#[derive(Clone)]
struct Guard {
    state: Arc<ServerState>,
    /// The route's path, as the table has it.
    path: &'static str,
    access: Access,
}

/// Refuses requests without a token that may use the route and the twin in its path. Passes the
/// token's [`Grant`] to the route.
async fn authorize(
    State(Guard { state, path, access }): State<Guard>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    check_once(&request, header::HOST, "host")?;
    check_once(&request, header::ORIGIN, "origin")?;
    check_once(&request, header::AUTHORIZATION, "authorization")?;
    // An absolute address in the request counts more than the header (RFC 9112, section 3.2.2).
    let header = request.headers().get(header::HOST).map(|host| host.to_str().unwrap_or_default());
    let host = request.uri().authority().map(|authority| authority.as_str()).or(header);
    let has_tokens = state.tokens.is_some();
    state.origins.check_page(request.headers(), has_tokens, host)?;
    // Before the ticket, which only a request that is otherwise good may use up.
    state.origins.check_host(has_tokens, host)?;
    let grant = match &state.tokens {
        // A ticket counts more than a header, which browsers cannot set for a WebSocket.
        Some(tokens) => match tickets::from_request(&request, path)? {
            Some(ticket) => state.tickets.redeem(ticket)?,
            None => {
                let authorization = request.headers().get(header::AUTHORIZATION);
                tokens.get().grant(authorization.map(|value| value.as_bytes()))?
            }
        },
        None => Grant::everything(),
    };
    if let Some(slot) = request.extensions().get::<Arc<ConnectionSlot>>() {
        // Only now, so that a connection without a token keeps counting as unauthenticated.
        slot.mark_authenticated()?;
    }
    grant.require(access)?;
    // Handlers do not check it again, so that none can forget to.
    for (name, twin) in &request.extract_parts::<RawPathParams>().await.map_err(no_text)? {
        if name == "twin" {
            grant.require_twin(twin)?;
        }
    }
    request.extensions_mut().insert(grant);
    Ok(next.run(request).await)
}

/// Refuses a header that occurs more than once, because its values may contradict each other.
fn check_once(request: &Request, name: HeaderName, header: &'static str) -> Result<(), Fault> {
    match request.headers().get_all(name).iter().count() {
        0 | 1 => Ok(()),
        _ => Err(Fault::HeaderTwice { header }),
    }
}

/// `GET /readyz`: whether sessions can be opened, which needs the list of twins.
async fn ready(State(state): State<Arc<ServerState>>) -> Response {
    if state.sessions.is_ending() {
        return Refusal::from(Fault::Ending).into_response();
    }
    match state.readiness.refusal(&state.engine).await {
        None => "ready\n".into_response(),
        Some(body) => (StatusCode::SERVICE_UNAVAILABLE, Json(body)).into_response(),
    }
}

/// A path whose escaped bytes are no text.
fn no_text(error: RawPathParamsRejection) -> Fault {
    Fault::InvalidRequest { field: None, reason: error.body_text() }
}

async fn no_route(uri: Uri) -> Refusal {
    Fault::NoRoute { path: uri.path().to_owned() }.into()
}

async fn no_method(method: Method, uri: Uri) -> Refusal {
    Fault::NoMethod { method: method.to_string(), path: uri.path().to_owned() }.into()
}
