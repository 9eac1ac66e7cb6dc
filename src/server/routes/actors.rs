//! Assets of actors over HTTP: lists the stored ones, and carries out pushes of new ones.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Path, State as Shared};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::IntoResponse as _;
use axum::{Extension, Json};
use tracing::Instrument as _;

use wildcity_push::{AssetRequest, Push, PushError, SourceFile};
use wildcity_twin::store::AddedActor;

use crate::audit::{Change, Made, Target};
use crate::auth::Grant;
use crate::blocking::{blocking, parsed};
use crate::convert;
use crate::fault::Fault;
use crate::idle_deadline::IdleDeadline;
use crate::state::ServerState;
use crate::token_counts::Counted;

use super::pushes::{find_uploads, outcome, stopped_before_commit};
use super::refusal::HttpResult;

/// `GET /v1/actors`: all assets, and the damaged ones.
pub(super) async fn list(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let catalog = state.engine.catalog().clone();
    let actors = blocking(move || catalog.actors()).await?;
    Ok(Json(convert::actors(&actors, grant.allows_all_twins())).into_response())
}

/// `GET /v1/actors/{actor}`: the asset of a name, of a hash, or of a hash that begins so.
pub(super) async fn show(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> HttpResult {
    let catalog = state.engine.catalog().clone();
    let actor = blocking(move || catalog.find_actor(&name)).await?;
    Ok(Json(convert::actor(&actor, grant.allows_all_twins())).into_response())
}

/// `POST /v1/actors`: makes an asset of uploads, and answers when it is stored: 201, or 200 if it
/// existed already. A client that disconnects earlier cancels the push.
pub(super) async fn push(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Extension(deadline): Extension<Arc<IdleDeadline>>,
    body: Bytes,
) -> HttpResult {
    // Any twin may show the asset, so a token for some twins must not add one.
    grant.require_all_twins()?;
    let request = parsed(body, convert::new_actor).await?;
    // The limit of the token first, and then that of the server, so that the error names the one
    // that is the client's own.
    let open = state.open_pushes.push(&grant)?;
    let push = state.pushes.begin_actor()?;
    let files = find_uploads(&state, &grant.name, &request.files)?;

    // axum drops this future when the client disconnects. The push runs in a task of its own, which
    // sees the cancellation.
    let _cancelling = CancelWhenDropped(push.clone());
    let polls = state.engine.polls().clone();
    let run = run(state, push, OwnedPush { grant, _open: open }, request, files);
    let making = polls.spawn("push of an asset", run);
    let made = deadline.extend_during(making).await.map_err(|_| PushError::Crashed)?;
    let AddedActor { actor, is_new } = made??;
    let status = if is_new { StatusCode::CREATED } else { StatusCode::OK };
    // The token is not limited to some twins.
    let mut response = (status, Json(convert::actor(&actor, true))).into_response();
    if let Ok(location) = HeaderValue::from_str(&format!("/v1/actors/{}", actor.hash)) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

/// Cancels a push whose request is dropped because its client went away.
struct CancelWhenDropped(Arc<Push>);

impl Drop for CancelWhenDropped {
    fn drop(&mut self) {
        // An error means that it has ended, or that its asset is being written.
        let _ = self.0.cancel();
    }
}

/// The token that owns a push, and its count.
struct OwnedPush {
    grant: Arc<Grant>,
    /// Counts among the token's pushes.
    _open: Counted,
}

/// Logs a push, runs it to its end and records the result.
///
/// # Errors
/// [`Fault::Audit`]: the push did not begin.
async fn run(
    state: Arc<ServerState>,
    push: Arc<Push>,
    owned: OwnedPush,
    request: AssetRequest,
    files: Vec<SourceFile>,
) -> Result<Result<AddedActor, PushError>, Fault> {
    let name = request.settings.name.clone();
    let change = Change { what: "actor", target: Target::Actor(name.clone()), id: None };
    if let Err(fault) = state.audit.begin(&owned.grant, &change).await {
        // Otherwise the push would stay open, and count for ever.
        push.end(Err(PushError::Abandoned { reason: fault.to_string() }));
        return Err(fault);
    }
    let catalog = state.engine.catalog();
    let published = wildcity_push::publish_asset(catalog, &state.pushes, &push, request, files)
        .instrument(tracing::debug_span!("push", actor = name));
    let result = tokio::select! {
        // A cancelled push does not wait for its reading to stop.
        biased;
        () = push.cancelled() => Err(PushError::Cancelled),
        result = published => result,
        () = stopped_before_commit(&state, &push) => Err(PushError::ShuttingDown),
    };
    let made = result.as_ref().map(|added| Made::Asset(added.actor.hash.clone()));
    state.audit.end(&owned.grant, &change, made).await;
    let ended = push.close(result.as_ref().map(drop));
    match &result {
        Ok(added) => tracing::info!(actor = name, hash = added.actor.hash, "stored"),
        Err(error) => tracing::warn!(actor = name, state = ?ended, "not stored: {error}"),
    }
    state.metrics.push_ended(outcome(ended));
    Ok(result)
}
