//! Twins and their versions over HTTP.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Path, RawQuery, State};
use axum::http::header;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use wildcity_push::PushError;
use wildcity_scene::rig::is_name;
use wildcity_twin::store::StoreError;

use crate::audit::{Change, Made, Target};
use crate::auth::Grant;
use crate::blocking::{blocking, parsed};
use crate::convert;
use crate::fault::Fault;
use crate::state::ServerState;

use super::episodes::counted;
use super::refusal::HttpResult;

/// `GET /v1/twins`: the latest version of every twin that the token may use, and the damaged ones
/// of them.
pub(super) async fn list(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let mut twins = state.engine.twins().await?;
    twins.twins.retain(|twin| grant.allows_twin(&twin.name));
    // Names of damaged twins are as secret as those of the others.
    twins.damaged.retain(|twin| grant.allows_twin(&twin.name));
    Ok(Json(convert::twins(&twins)).into_response())
}

/// `GET /v1/twins/{twin}`: the latest version of one twin.
pub(super) async fn show(
    State(state): State<Arc<ServerState>>,
    Path(name): Path<String>,
) -> HttpResult {
    let twins = state.engine.twins().await?;
    match twins.twins.iter().find(|twin| twin.name == name) {
        Some(twin) => Ok(Json(convert::twin(twin)).into_response()),
        None => {
            // A twin that is not listed may be damaged: opening it gives the reason.
            let catalog = state.engine.catalog().clone();
            blocking(move || catalog.version(&name, None)).await?;
            let reason = "the twin was created during this request; try again";
            Err(Fault::Internal(reason.to_owned()).into())
        }
    }
}

/// `GET /v1/twins/{twin}/versions`: all versions, the latest last.
pub(super) async fn versions(
    State(state): State<Arc<ServerState>>,
    Path(name): Path<String>,
) -> HttpResult {
    let engine = state.engine.clone();
    let listed = blocking(move || {
        let versions = engine.catalog().versions(&name)?;
        // Read after the log: a push pins the latest version before it commits the next one.
        let held = engine.pinned_latest(&name);
        Ok::<_, StoreError>((versions, held))
    });
    let (versions, held) = listed.await?;
    Ok(Json(convert::versions(&versions, held)).into_response())
}

/// `GET /v1/twins/{twin}/trajectories/{name}`: poses of a recorded drive.
pub(super) async fn trajectory(
    State(state): State<Arc<ServerState>>,
    Path((twin, name)): Path<(String, String)>,
    RawQuery(query): RawQuery,
) -> HttpResult {
    let (version, section) = convert::drive_query(name, query.as_deref().unwrap_or_default())?;
    // The version that a session would open now, which is not yet the one that a push has just
    // committed.
    let version = version.or_else(|| state.engine.pinned_latest(&twin));
    // The turn belongs to the work, which goes on when the client leaves.
    let turn = state.drive_turns.clone().acquire_owned().await;
    let turn = turn.map_err(|error| Fault::Internal(error.to_string()))?;
    let body = blocking(move || {
        let _turn = turn;
        let version = state.engine.catalog().version(&twin, version).map_err(Fault::from)?;
        let json = convert::drive_body(&version, &section)?;
        // Counted until the client has taken the answer.
        let share = state.engine.reserve_answer_bytes(json.len() as u64).map_err(Fault::from)?;
        Ok::<_, Fault>(counted(json, share))
    });
    Ok(([(header::CONTENT_TYPE, "application/json")], body.await?).into_response())
}

/// `GET /v1/twins/{twin}/ground`: where the latest version is, and the ground that it seems to
/// stand on.
pub(super) async fn ground(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> HttpResult {
    // It reads the whole twin, as a push does.
    let _open = state.open_pushes.push(&grant)?;
    // As for drives: the version that a session would open now.
    let version = state.engine.pinned_latest(&name);
    let survey = wildcity_push::survey(&state.engine, &state.pushes, name, version).await?;
    Ok(Json(convert::survey(&survey)).into_response())
}

/// `POST /v1/twins/{twin}/edits`: a version on level ground, with a drive and a rig.
pub(super) async fn edit(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
    body: Bytes,
) -> HttpResult {
    check_twin(&name)?;
    let request = parsed(body, |body| convert::new_edit(name, body)).await?;
    let open = state.open_pushes.push(&grant)?;
    // If the client disconnects, the edit is still completed, so that there is never a part of a
    // version.
    let polls = state.engine.polls().clone();
    let edited = polls
        .spawn("edit", async move {
            let _open = open;
            let target = Target::Twin(request.twin.clone());
            let change = Change { what: "edit", target, id: None };
            state.audit.begin(&grant, &change).await?;
            let viewpoints = |twin: &str| state.sessions.viewpoints_on(twin);
            let edited =
                wildcity_push::publish_edit(&state.engine, &state.pushes, request, &viewpoints)
                    .await;
            let made = edited.as_ref().map(|version| Made::Version(version.number));
            state.audit.end(&grant, &change, made).await;
            Ok::<_, Fault>(edited?)
        })
        .await
        .map_err(|_| PushError::Crashed)?;
    Ok(Json(convert::edited(&edited?)).into_response())
}

/// `POST /v1/twins/{twin}/rollback`: makes an old version the latest again.
pub(super) async fn rollback(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
    body: Bytes,
) -> HttpResult {
    check_twin(&name)?;
    let number = parsed(body, convert::rollback).await?;
    let version = blocking(move || {
        let engine = &state.engine;
        let change = Change { what: "rollback", target: Target::Twin(name.clone()), id: None };
        state.audit.begin_now(&grant, &change)?;
        let rolled_back = engine.catalog().rollback(&name, number);
        let made = rolled_back.as_ref().map(|version| Made::Version(version.number));
        // On one thread, so that a client that disconnects stops nothing between the rollback and
        // its line in the log.
        state.audit.end_now(&grant, &change, made);
        let version = rolled_back?;
        // A push that is still loading its version has pinned the previous one; move this pin, so
        // that the rollback becomes the latest at once.
        engine.move_latest_pin(&name, version.number);
        tracing::info!(twin = name, version = version.number, "rolled back to {number}");
        Ok::<_, Fault>(version)
    });
    Ok(Json(convert::version(&version.await?)).into_response())
}

/// Refuses invalid names of twins, so that they do not get into the audit log.
fn check_twin(name: &str) -> Result<(), Fault> {
    if is_name(name) {
        Ok(())
    } else {
        Err(Fault::InvalidName { field: "twin".to_owned(), name: name.to_owned() })
    }
}
