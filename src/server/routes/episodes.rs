//! Recorded episodes over HTTP.

use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::header;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use wildcity_episode::{EpisodeFile, list as list_dir, read_text};
use wildcity_scene::rig::is_name;

use crate::auth::{Grant, Role};
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
    grant.require(Role::Admin)?;
    let episodes = blocking(move || {
        let listed =
            list_dir(&state.episodes).map_err(|error| Fault::Internal(error.to_string()))?;
        let newest = listed.into_iter().take(limits::LISTED_EPISODES);
        // Files of other builds, and those whose first line is not written yet, are left out.
        let read = newest.filter_map(|listed| {
            let file = EpisodeFile::read(&listed.path).ok()?;
            grant.allows_twin(&file.header.twin).then_some(ListedEpisode { listed, file })
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
    grant.require(Role::Admin)?;
    let text = blocking(move || {
        // A name, and so no path to another file.
        let unknown = || Fault::NoEpisode { name: name.clone() };
        let stem = name.rsplit_once('-').map_or(name.as_str(), |(session, _)| session);
        if !is_name(stem) || name.contains(['/', '\\']) {
            return Err(unknown());
        }
        let path = state.episodes.join(format!("{name}.jsonl"));
        let file = EpisodeFile::read(&path).map_err(|_| unknown())?;
        grant.require_twin(&file.header.twin)?;
        match read_text(&path, limits::EPISODE_BYTES) {
            Ok(Some(text)) => Ok(text),
            Ok(None) => Err(Fault::OutOfRange {
                field: "episode".to_owned(),
                must: format!("larger than {} bytes: read its file", limits::EPISODE_BYTES),
            }),
            Err(_) => Err(unknown()),
        }
    });
    Ok(([(header::CONTENT_TYPE, "application/x-ndjson")], text.await?).into_response())
}
