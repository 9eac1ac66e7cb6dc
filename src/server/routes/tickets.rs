//! Tickets over HTTP.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use crate::auth::Grant;
use crate::convert;
use crate::state::ServerState;

use super::refusal::HttpResult;

/// `POST /v1/tickets`: a ticket with the rights of the request's token.
pub(super) async fn issue(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let ticket = state.tickets.issue(grant)?;
    Ok((StatusCode::CREATED, Json(convert::ticket(ticket))).into_response())
}

/// The ticket in the address of a WebSocket. No other request can have one: a ticket opens one connection.
pub(super) fn of(request: &Request) -> Option<&str> {
    let path = request.uri().path();
    let is_socket = path == "/v1/session" || path.ends_with("/watch");
    let query = request.uri().query().filter(|_| is_socket)?;
    query.split('&').find_map(|pair| pair.strip_prefix("ticket="))
}
