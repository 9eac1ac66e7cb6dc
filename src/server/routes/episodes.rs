//! Recorded episodes over HTTP.

use std::path::PathBuf;
use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::header;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};
use bytes::Bytes;

use wildcity_episode::{
    Overview, RecordHead, list as list_dir, mcap_path, read_mcap, read_text, record_bytes,
};
use wildcity_scene::rig::is_name;
use wildcity_session::BudgetShare;

use crate::auth::Grant;
use crate::blocking::blocking;
use crate::convert::{self, ListedEpisode};
use crate::fault::Fault;
use crate::limits;
use crate::state::ServerState;

use super::refusal::HttpResult;

/// `GET /v1/episodes`: the newest recorded episodes, the newest first.
pub(super) async fn list(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    let episodes = blocking(move || {
        let listed =
            list_dir(&state.episodes).map_err(|error| Fault::Internal(error.to_string()))?;
        let newest = listed.into_iter().take(limits::LISTED_EPISODES);
        // Files of other builds, and those whose first line is not written yet, are left out.
        let read = newest.filter_map(|listed| {
            let overview = Overview::read(&listed.path).ok()?;
            // The export runs after the episode, so that its failure is not in the record.
            let mcap_error = state.engine.export_failure(&listed.name);
            let is_allowed = grant.allows_twin(&overview.head.twin);
            is_allowed.then_some(ListedEpisode { listed, overview, mcap_error })
        });
        Ok::<_, Fault>(read.collect::<Vec<_>>())
    });
    Ok(Json(convert::episodes(&episodes.await?)).into_response())
}

/// `GET /v1/episodes/{episode}`: the record, a JSON object a line.
pub(super) async fn show(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> HttpResult {
    let text = blocking(move || {
        let path = find_record(&state, &grant, &name)?;
        let share = reserve(&state, &path)?;
        match read_text(&path, limits::EPISODE_BYTES) {
            Ok(Some(text)) => Ok(counted(text, share)),
            Ok(None) => Err(too_large()),
            Err(_) => Err(Fault::NoEpisode { name }),
        }
    });
    Ok(([(header::CONTENT_TYPE, "application/x-ndjson")], text.await?).into_response())
}

/// `GET /v1/episodes/{episode}/mcap`: the record as MCAP. Waits for an export that is under way.
pub(super) async fn mcap(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> HttpResult {
    // The token is checked before the wait, which takes up to 20 s.
    let checked = state.clone();
    let its_name = name.clone();
    let record = blocking(move || find_record(&checked, &grant, &its_name)).await?;
    let is_over = state.engine.wait_for_exports(Some(&name), limits::MCAP_WAIT).await;
    let bytes = blocking(move || {
        // The file counts, and not what the engine knows: it may be of an earlier server.
        let share = reserve(&state, &mcap_path(&record))?;
        if let Ok(bytes) = read_mcap(&record, limits::EPISODE_BYTES) {
            return bytes.map(|bytes| counted(bytes, share)).ok_or_else(too_large);
        }
        let reason = match state.engine.export_failure(&name) {
            Some(reason) => reason,
            // From the reason that is certain to the one that is left.
            None if !is_over => "it waits for others to be exported".to_owned(),
            None if !state.engine.exports_mcap() => "this server writes none (--mcap)".to_owned(),
            None => "it has not ended, or the server that drove it was killed".to_owned(),
        };
        Err(Fault::NoMcap { name, reason })
    });
    Ok(([(header::CONTENT_TYPE, "application/vnd.mcap")], bytes.await?).into_response())
}

/// The file of an episode whose twin the token may use.
fn find_record(state: &ServerState, grant: &Grant, name: &str) -> Result<PathBuf, Fault> {
    // A name, and so no path to another file.
    let unknown = || Fault::NoEpisode { name: name.to_owned() };
    // An episode is named SESSION-NUMBER. A session's name may have a `-`, so the last one counts.
    let stem = name.rsplit_once('-').map_or(name, |(session, _)| session);
    if !is_name(stem) || name.contains(['/', '\\']) {
        return Err(unknown());
    }
    let path = state.episodes.join(format!("{name}.jsonl"));
    let head = RecordHead::read(&path).map_err(|_| unknown())?;
    // The same answer as for a name that is not there, so that no token learns what others have
    // driven.
    if grant.allows_twin(&head.twin) { Ok(path) } else { Err(unknown()) }
}

/// Reserves the memory of a file that is sent, as long as the client has not taken all of it.
fn reserve(state: &ServerState, path: &std::path::Path) -> Result<BudgetShare, Fault> {
    // One that is too large, or not there, is refused when it is read.
    let bytes = record_bytes(path).min(limits::EPISODE_BYTES);
    state.engine.reserve_answer_bytes(bytes).map_err(Fault::from)
}

/// Bytes with their share of the memory for answers.
struct CountedFile {
    bytes: Vec<u8>,
    _share: BudgetShare,
}

impl AsRef<[u8]> for CountedFile {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

pub(super) fn counted(bytes: Vec<u8>, share: BudgetShare) -> Bytes {
    Bytes::from_owner(CountedFile { bytes, _share: share })
}

fn too_large() -> Fault {
    Fault::OutOfRange {
        field: "episode".to_owned(),
        must: format!("larger than {} bytes: read its file", limits::EPISODE_BYTES),
    }
}
