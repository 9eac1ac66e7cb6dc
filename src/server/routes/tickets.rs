//! Tickets over HTTP.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use crate::auth::Grant;
use crate::convert;
use crate::fault::Fault;
use crate::state::ServerState;

use super::refusal::HttpResult;
use super::websocket;

/// `POST /v1/tickets`: a ticket with the rights of the request's token.
pub(super) async fn issue(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let ticket = state.tickets.issue(grant)?;
    Ok((StatusCode::CREATED, Json(convert::ticket(ticket))).into_response())
}

/// The ticket in the address of a WebSocket. Requests of other routes cannot have one: a ticket
/// opens one connection.
///
/// # Errors
/// The request has a ticket, but is not a handshake of a WebSocket. The ticket stays valid.
pub(super) fn from_request<'a>(
    request: &'a Request,
    route: &str,
) -> Result<Option<&'a str>, Fault> {
    let Some(protocol) = websocket::subprotocol(route) else { return Ok(None) };
    let query = request.uri().query().unwrap_or_default();
    // Not decoded: a ticket has hex digits only, which no client escapes.
    let ticket = query.split('&').find_map(|pair| pair.strip_prefix("ticket="));
    if ticket.is_some() {
        websocket::check_handshake(request.headers(), protocol)?;
    }
    Ok(ticket)
}
