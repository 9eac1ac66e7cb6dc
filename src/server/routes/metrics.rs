//! Metrics over HTTP.

use std::sync::Arc;

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};

use crate::auth::{Grant, Role};
use crate::convert::WireCode;
use crate::fault::Fault;
use crate::metrics::GaugeValues;
use crate::state::ServerState;

use super::refusal::{HttpResult, Refusal};

/// `GET /metrics`, in OpenMetrics' text format.
pub(super) async fn show(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    grant.require(Role::Admin)?;
    let free_connections = state.websocket_permits.available_permits();
    let spooled = state.spool.as_ref().map(|spool| spool.usage()).unwrap_or_default();
    let gauges = GaugeValues {
        sessions: state.sessions.count(),
        connections: state.limits.connections - free_connections,
        frames_queued: state.engine.queued_frames(),
        uploads: spooled.uploads,
        spool_bytes: spooled.bytes,
        pushes_open: state.pushes.open_count(),
    };
    let text = state.metrics.text(gauges);
    let text = text.map_err(|error| Fault::Internal(error.to_string()))?;
    let content_type = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(header::CONTENT_TYPE, content_type)], text).into_response())
}

/// Counts the requests that HTTP routes refuse.
pub(super) async fn count_refusals(
    State(state): State<Arc<ServerState>>,
    request: Request,
    next: Next,
) -> Response {
    let length = request.headers().get(header::CONTENT_LENGTH).cloned();
    let mut response = next.run(request).await;
    // The body that axum itself refuses has no code yet.
    if response.status() == StatusCode::PAYLOAD_TOO_LARGE
        && response.extensions().get::<WireCode>().is_none()
    {
        let limit = wildcity_protocol::limits::INBOUND_MESSAGE_BYTES;
        let announced = length.and_then(|length| length.to_str().ok()?.parse().ok());
        let bytes = announced.unwrap_or(limit + 1);
        response = Refusal::from(Fault::MessageTooLarge { bytes, limit }).into_response();
    }
    if let Some(code) = response.extensions().get::<WireCode>() {
        state.metrics.refused(&code.0);
    }
    response
}
