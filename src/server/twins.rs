//! Twins and their versions over HTTP.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::response::IntoResponse as _;
use axum::{Extension, Json};

use super::auth::{Grant, Role};
use super::fault::Fault;
use super::refusal::Answered;
use super::uploads::blocking;
use super::{Server, convert};

/// `GET /v1/twins`: the latest version of every twin that the token sees.
pub(super) async fn list(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
) -> Answered {
    let mut twins = server.engine.twins().await?;
    twins.retain(|twin| grant.sees(&twin.name));
    Ok(Json(convert::twins(&twins)).into_response())
}

/// `GET /v1/twins/{twin}`: the same of one.
pub(super) async fn look(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> Answered {
    grant.reaches(&name)?;
    let twins = server.engine.twins().await?;
    match twins.iter().find(|twin| twin.name == name) {
        Some(twin) => Ok(Json(convert::twin(twin)).into_response()),
        None => {
            // Why it is not among them.
            let catalog = server.engine.catalog().clone();
            blocking(move || Ok(catalog.version(&name, None)?)).await?;
            Err(Fault::Internal("the twin came while it was looked for; ask again".into()).into())
        }
    }
}

/// `GET /v1/twins/{twin}/versions`: all of them, the latest last.
pub(super) async fn versions(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
) -> Answered {
    grant.reaches(&name)?;
    let engine = server.engine.clone();
    let (versions, held) = blocking(move || {
        let versions = engine.catalog().versions(&name)?;
        // After the log: a push holds the latest before it commits.
        let held = engine.pinned_latest(&name);
        Ok((versions, held))
    })
    .await?;
    Ok(Json(convert::versions(&versions, held)).into_response())
}

/// `POST /v1/twins/{twin}/rollback`: makes an old version the latest again.
pub(super) async fn rollback(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(name): Path<String>,
    body: Bytes,
) -> Answered {
    grant.may(Role::Admin)?;
    grant.reaches(&name)?;
    let number = convert::rollback(&body)?;
    let engine = server.engine.clone();
    let version = blocking(move || {
        let version = engine.catalog().rollback(&name, number)?;
        // A push that is on its way to be ready does not keep it back.
        engine.move_latest_pin(&name, version.number);
        tracing::info!(twin = name, version = version.number, "rolled back to {number}");
        Ok(version)
    });
    Ok(Json(convert::version(&version.await?)).into_response())
}
