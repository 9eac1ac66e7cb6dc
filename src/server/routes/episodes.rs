//! Recorded episodes over HTTP.

use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::header;
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use wildcity_episode::{EpisodeFile, Listed};

use crate::auth::{Grant, Role};
use crate::blocking::blocking;
use crate::convert;
use crate::fault::Fault;
use crate::limits;
use crate::state::ServerState;

use super::refusal::HttpResult;

/// `GET /v1/episodes`: the newest recorded episodes, of the twins that the token may use.
pub(super) async fn list(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> HttpResult {
    grant.require(Role::Admin)?;
    let dir = state.engine.episodes().to_owned();
    let episodes = blocking(move || {
        let mut listed = wildcity_episode::list(&dir).map_err(|cause| unreadable(&cause))?;
        listed.truncate(limits::LISTED_EPISODES);
        // A file that cannot be read as an episode is left out, so that it does not hide the others.
        let read = |listed: Listed| Some((EpisodeFile::read(&listed.path).ok()?, listed));
        let mut episodes: Vec<(EpisodeFile, Listed)> =
            listed.into_iter().filter_map(read).collect();
        episodes.retain(|(episode, _)| grant.allows_twin(&episode.header.twin));
        Ok::<_, Fault>(episodes)
    });
    Ok(Json(convert::episodes(&episodes.await?)).into_response())
}

/// `GET /v1/episodes/{episode}`: the record of an episode, as JSON lines.
pub(super) async fn show(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> HttpResult {
    grant.require(Role::Admin)?;
    let dir = state.engine.episodes().to_owned();
    let text = blocking(move || {
        // The names of the list are those of files: any other name is none, whatever it looks like as a path.
        let listed = wildcity_episode::list(&dir).map_err(|cause| unreadable(&cause))?;
        let found = listed.into_iter().find(|listed| listed.name == name);
        let unknown = || Fault::UnknownEpisode { name: name.clone() };
        let found = found.ok_or_else(unknown)?;
        let episode = EpisodeFile::read(&found.path).map_err(|_| unknown())?;
        if !grant.allows_twin(&episode.header.twin) {
            return Err(unknown());
        }
        wildcity_episode::text(&found.path).map_err(|cause| unreadable(&cause))
    });
    Ok(([(header::CONTENT_TYPE, "application/x-ndjson")], text.await?).into_response())
}

fn unreadable(cause: &std::io::Error) -> Fault {
    Fault::Internal(format!("the records cannot be read: {cause}"))
}
