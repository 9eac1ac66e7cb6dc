//! The scenarios of a server over HTTP.

use std::sync::Arc;

use axum::extract::{Path, State as Shared};
use axum::response::IntoResponse as _;
use axum::{Extension, Json};
use serde_json::json;
use tokio::time::{Instant, timeout_at};

use wildcity_session::SessionError;

use crate::auth::Grant;
use crate::blocking::blocking;
use crate::fault::Fault;
use crate::idle_deadline::IdleDeadline;
use crate::state::ServerState;

use super::refusal::HttpResult;

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
    Extension(deadline): Extension<Arc<IdleDeadline>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(twin): Path<String>,
) -> HttpResult {
    let scenarios = state.engine.scenarios().clone();
    let catalog = state.engine.catalog().clone();
    let end = Instant::now() + state.limits.step;
    let listing = async {
        // One listing at a time: each parses files of the server. The turn belongs to the work and
        // not to this future, which ends when the client leaves, while the work goes on for a
        // moment.
        let turn = timeout_at(end, state.scenario_listing.clone().lock_owned()).await;
        let turn = turn.map_err(|_| SessionError::DeadlineExceeded)?;
        let request = Arc::new(());
        let asked = Arc::downgrade(&request);
        let listed = blocking(move || {
            let _turn = turn;
            // A misspelt twin is an error, and not one without scenarios.
            catalog.version(&twin, None).map_err(Fault::from)?;
            let is_wanted = || asked.strong_count() > 0 && Instant::now() < end;
            let mut listed = scenarios
                .in_twin(&twin, &is_wanted)
                .ok_or_else(|| Fault::from(SessionError::DeadlineExceeded))?;
            // They may be of twins that the token may not see.
            if !grant.allows_all_twins() {
                listed.omitted_scenarios = 0;
            }
            Ok::<_, Fault>(listed)
        });
        let listed = listed.await;
        // Until here, so that the work is wanted as long as this future waits for it.
        drop(request);
        listed
    };
    Ok(Json(deadline.extend_during(listing).await?).into_response())
}
