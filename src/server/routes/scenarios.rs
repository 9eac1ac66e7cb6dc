//! The scenarios of a server over HTTP.

use std::sync::Arc;

use axum::extract::{Path, State as Shared};
use axum::response::IntoResponse as _;
use axum::{Extension, Json};
use serde_json::json;

use crate::auth::Grant;
use crate::blocking::blocking;
use crate::fault::Fault;
use crate::state::ServerState;

use super::refusal::HttpResult;
use wildcity_twin::store::StoreError;

/// `GET /v1/scenarios`: names that `open` knows. A token that is limited to some twins gets none,
/// because a name may tell of others.
pub(super) async fn list(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let scenarios = state.engine.scenarios().clone();
    let names = blocking(move || Ok::<_, Fault>(scenarios.names())).await?;
    let shown = if grant.allows_all_twins() { names } else { Vec::new() };
    Ok(Json(json!({ "scenarios": shown })).into_response())
}

/// `GET /v1/twins/{twin}/scenarios`: those that play in a twin, with the lanes of their maps.
pub(super) async fn in_twin(
    Shared(state): Shared<Arc<ServerState>>,
    Path(twin): Path<String>,
) -> HttpResult {
    let scenarios = state.engine.scenarios().clone();
    let catalog = state.engine.catalog().clone();
    // One listing at a time: each parses files of the server.
    let _turn = state.scenario_listing.lock().await;
    let listing = blocking(move || {
        // A misspelt twin is an error, and not one without scenarios.
        catalog.version(&twin, None)?;
        Ok::<_, StoreError>(scenarios.in_twin(&twin))
    });
    Ok(Json(listing.await?).into_response())
}
