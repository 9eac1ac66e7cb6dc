//! Metrics over HTTP.

use std::sync::Arc;

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};

use crate::auth::{Grant, Role};
use crate::fault::{Fault, WireCode};
use crate::metrics::GaugeValues;
use crate::state::ServerState;

use super::refusal::{HttpResult, Refusal};

/// The route of the metrics, the only one that a token with the role `metrics` may use.
pub(super) const PATH: &str = "/metrics";

/// `GET /metrics`, in OpenMetrics' text format.
pub(super) async fn show(
    state: State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    // They count what happens on all twins.
    if grant.has(Role::Admin) && !grant.allows_all_twins() {
        let reason = "it is limited to some twins, and metrics are of all; use one of role metrics";
        return Err(Fault::Forbidden { field: "authorization", reason: reason.to_owned() }.into());
    }
    show_all(state).await
}

/// The same for a client that need not show a token.
pub(super) async fn show_all(State(state): State<Arc<ServerState>>) -> HttpResult {
    let free_connections = state.websocket_permits.available_permits();
    let spooled = state.spool.as_ref().map(|spool| spool.usage()).unwrap_or_default();
    let gauges = GaugeValues {
        sessions: state.sessions.count(),
        // The semaphore began with as many permits as the limit, so the difference is not negative.
        connections: state.limits.connections - free_connections,
        frames_queued: state.engine.queued_frames(),
        answer_bytes: state.engine.answer_bytes(),
        uploads: spooled.uploads,
        spool_bytes: spooled.bytes,
        pushes_open: state.pushes.open_count(),
    };
    let text = state.metrics.text(gauges).map_err(|error| Fault::Internal(error.to_string()))?;
    let content_type = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(header::CONTENT_TYPE, content_type)], text).into_response())
}

/// Counts the requests that HTTP routes refuse.
pub(super) async fn count_refusals(
    State(state): State<Arc<ServerState>>,
    request: Request,
    next: Next,
) -> Response {
    let limit = wildcity_protocol::limits::INBOUND_MESSAGE_BYTES;
    let too_large =
        |bytes: usize| Refusal::from(Fault::MessageTooLarge { bytes, limit }).into_response();
    let announced = request
        .headers()
        .get(header::CONTENT_LENGTH)
        .and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    // Only the parts of an upload may be larger.
    let is_upload = request.method() == Method::PATCH;
    let mut response = match announced {
        Some(bytes) if bytes > limit && !is_upload => too_large(bytes),
        _ => next.run(request).await,
    };
    // A body of unknown length is refused by axum itself, without a code.
    if response.status() == StatusCode::PAYLOAD_TOO_LARGE
        && response.extensions().get::<WireCode>().is_none()
    {
        response = too_large(limit + 1);
    }
    if let Some(code) = response.extensions().get::<WireCode>() {
        state.metrics.refused(&code.0);
    }
    response
}
