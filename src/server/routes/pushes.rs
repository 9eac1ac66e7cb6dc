//! Pushes over HTTP: passes requests to the package `wildcity-push`, and answers with the push's
//! status.

use std::future::pending;
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Path, State as Shared};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::{Extension, Json};
use tracing::Instrument as _;

use wildcity_push::{Begun, Push, PushError, PushRequest, RequestedFile, SourceFile, State};

use crate::audit::{Change, Made, Target};
use crate::auth::Grant;
use crate::blocking::{blocking, parsed};
use crate::convert;
use crate::fault::Fault;
use crate::state::ServerState;
use crate::token_counts::Counted;

use super::refusal::HttpResult;

/// `POST /v1/twins/{twin}/pushes`: answers 202 and carries the push out. A known push is answered
/// with its status.
pub(super) async fn begin(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(twin): Path<String>,
    body: Bytes,
) -> HttpResult {
    let request = parsed(body, |body| convert::new_push(twin, body)).await?;
    // Before the push is begun: a conflict that is certain now needs no upload to be read.
    let latest = {
        let catalog = state.engine.catalog().clone();
        let request = request.clone();
        blocking(move || wildcity_push::check_base(&catalog, &request)).await?
    };
    let id = request.id.clone().unwrap_or_else(|| wildcity_push::default_id(&request, latest));
    let twin = request.twin.clone();
    // Counted only for a new push: asking for a known one must not fail because the token has too
    // many.
    let mut open = None;
    let files = || {
        open = Some(state.open_pushes.push(&grant)?);
        find_uploads(&state, &grant.name, &request.files)
    };
    let push = match state.pushes.begin(&request, &id, files)? {
        Begun::Known(push) => push,
        Begun::New { push, files } => {
            let target = Target::Twin(twin.clone());
            let change = Change { what: "push", target, id: Some(id.clone()) };
            let owned = OwnedPush { grant, change, _open: open };
            // A task of its own: a client that disconnects drops this future, but not the push,
            // which is in the queue by then.
            let polls = state.engine.polls().clone();
            let run = log_and_run(state, push.clone(), owned, request, files);
            let logged = polls.spawn("push", run);
            logged.await.map_err(|_| PushError::Crashed)??;
            push
        }
    };
    Ok(answer(StatusCode::ACCEPTED, &id, &twin, &push))
}

/// `GET /v1/twins/{twin}/pushes/{id}`: the status of a push.
pub(super) async fn show(
    Shared(state): Shared<Arc<ServerState>>,
    Path((twin, id)): Path<(String, String)>,
) -> HttpResult {
    let push = state.pushes.get(&twin, &id).map_err(Fault::from)?;
    Ok(answer(StatusCode::OK, &id, &twin, &push))
}

/// `DELETE /v1/twins/{twin}/pushes/{id}`: cancels a push, and answers with its last status.
pub(super) async fn cancel(
    Shared(state): Shared<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path((twin, id)): Path<(String, String)>,
) -> HttpResult {
    let push = state.pushes.get(&twin, &id).map_err(Fault::from)?;
    let cancelling = push.clone();
    let change =
        Change { what: "cancel", target: Target::Twin(twin.clone()), id: Some(id.clone()) };
    // On one thread from the first line of the log to the last, so that a client that disconnects
    // leaves no line without its end.
    let cancelled = blocking(move || {
        state.audit.begin_now(&grant, &change)?;
        let cancelled = cancelling.cancel();
        state.audit.end_now(&grant, &change, cancelled.map(|()| Made::Nothing));
        Ok::<_, Fault>(cancelled)
    });
    cancelled.await?.map_err(|why| PushError::TooLate { id: id.clone(), why })?;
    Ok(answer(StatusCode::OK, &id, &twin, &push))
}

/// The token that owns a push, and its count.
struct OwnedPush {
    grant: Arc<Grant>,
    change: Change,
    /// Counts among the token's pushes.
    _open: Option<Counted>,
}

/// Logs that a push begins, and starts it. Returns when it is logged. A client that disconnects
/// does not stop it.
///
/// # Errors
/// [`Fault::Audit`]: the push did not begin.
async fn log_and_run(
    state: Arc<ServerState>,
    push: Arc<Push>,
    owned: OwnedPush,
    request: PushRequest,
    files: Vec<SourceFile>,
) -> Result<(), Fault> {
    if let Err(fault) = state.audit.begin(&owned.grant, &owned.change).await {
        push.end(Err(PushError::Abandoned { reason: fault.to_string() }));
        return Err(fault);
    }
    let polls = state.engine.polls().clone();
    polls.spawn("push", run(state, push, owned, request, files));
    Ok(())
}

/// Runs a push to its end and records the result.
async fn run(
    state: Arc<ServerState>,
    push: Arc<Push>,
    owned: OwnedPush,
    request: PushRequest,
    files: Vec<SourceFile>,
) {
    // `_open` counts until this function returns.
    let OwnedPush { grant, change, _open } = owned;
    let twin = request.twin.clone();
    let viewpoints = |twin: &str| state.sessions.viewpoints_on(twin);
    let published =
        wildcity_push::publish(&state.engine, &state.pushes, &push, request, files, &viewpoints)
            .instrument(tracing::debug_span!("push", twin, id = change.id));
    let result = tokio::select! {
        // A cancelled push does not wait for its reading to stop.
        biased;
        () = push.cancelled() => Err(PushError::Cancelled),
        result = published => result,
        () = stopped_before_commit(&state, &push) => Err(PushError::ShuttingDown),
    };
    // The log before the status: a client that sees the push as ready finds its line.
    let made = result.as_ref().map(|version| Made::Version(version.number));
    state.audit.end(&grant, &change, made).await;
    let reason = result.as_ref().err().map(ToString::to_string);
    let ended = push.end(result);
    if let Some(reason) = reason {
        tracing::warn!(state = ?ended, "a push ended: {reason}");
    }
    state.metrics.push_ended(outcome(ended));
}

/// Completes when the server stops, unless the push can no longer be cancelled: then its result
/// counts.
pub(super) async fn stopped_before_commit(state: &ServerState, push: &Push) {
    // `cancel` decides: if it fails, the version is being written, and the push runs to its end.
    state.stopped().await;
    if push.cancel().is_err() {
        pending().await
    }
}

/// The outcome of a push that ended, as metrics count it.
pub(super) fn outcome(ended: State) -> &'static str {
    match ended {
        State::Ready => "ready",
        State::Refused => "refused",
        _ => "failed",
    }
}

/// The finished uploads of a push, which belong to its token. An upload is not removed while its
/// file is held.
pub(super) fn find_uploads(
    state: &ServerState,
    owner: &str,
    requested: &[RequestedFile],
) -> Result<Vec<SourceFile>, Fault> {
    let spool = state.spool()?;
    let mut files = Vec::with_capacity(requested.len());
    for (index, file) in requested.iter().enumerate() {
        let field = format!("files[{index}].upload");
        // The spool does not know in which field the id was.
        let upload = spool.get(owner, &file.upload).map_err(|fault| match fault {
            Fault::UnknownUpload { id, .. } => Fault::UnknownUpload { id, field: Some(field) },
            fault => fault,
        })?;
        let size = upload.announced().size;
        if !upload.is_complete() {
            let held = upload.offset();
            let must = format!("an upload with {held} of {size} bytes: finish it first");
            return Err(Fault::OutOfRange { field: format!("files[{index}].upload"), must });
        }
        files.push(SourceFile {
            name: file.name.clone().unwrap_or_else(|| upload.announced().name.clone()),
            path: upload.path(),
            bytes: size,
            // The reference keeps the spool from removing the file while it is read.
            guard: upload,
        });
    }
    Ok(files)
}

fn answer(status: StatusCode, id: &str, twin: &str, push: &Push) -> Response {
    let body = Json(convert::push(id, twin, &push.status()));
    let mut response = (status, body).into_response();
    if let Ok(location) = HeaderValue::from_str(&format!("/v1/twins/{twin}/pushes/{id}")) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}
