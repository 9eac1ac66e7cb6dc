//! The list of sessions over HTTP.

use std::sync::Arc;

use axum::extract::State;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use crate::auth::Grant;
use crate::convert;
use crate::state::ServerState;

use super::refusal::HttpResult;

/// `GET /v1/sessions`: where every session is.
pub(super) async fn list(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let mut sessions = state.sessions.list();
    sessions.retain(|session| grant.allows_twin(&session.view.twin));
    Ok(Json(convert::sessions(&sessions)).into_response())
}
