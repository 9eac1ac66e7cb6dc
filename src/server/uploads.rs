//! Uploads over HTTP: announced, appended to from where they stand, checked at their end.

use std::pin::pin;
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::{Extension, Json};
use data_encoding::BASE64;
use http_body_util::BodyExt as _;
use sha2::{Digest as _, Sha256};
use tokio::time::timeout;

use crate::limits;

use super::auth::{Grant, Role};
use super::fault::Fault;
use super::listen::Patience;
use super::refusal::Answered;
use super::spool::{Spool, Upload, Writer};
use super::{Server, convert};

const UPLOAD_OFFSET: HeaderName = HeaderName::from_static("upload-offset");
const UPLOAD_LENGTH: HeaderName = HeaderName::from_static("upload-length");
const CONTENT_DIGEST: HeaderName = HeaderName::from_static("content-digest");

/// `POST /v1/uploads`: 201 if bytes are still to come, 200 if none is.
pub(super) async fn begin(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    body: Bytes,
) -> Answered {
    grant.may(Role::Push)?;
    let announced = convert::new_upload(&body)?;
    let spool = server.spool()?.clone();
    let upload = blocking(move || spool.begin(announced)).await?;
    server.metrics.uploads_begun.inc();
    let status = if upload.is_complete() { StatusCode::OK } else { StatusCode::CREATED };
    Ok(answer(status, &upload))
}

/// `GET` or `HEAD /v1/uploads/{id}`: how far it is.
pub(super) async fn look(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(id): Path<String>,
) -> Answered {
    grant.may(Role::Push)?;
    Ok(answer(StatusCode::OK, &*server.spool()?.get(&id)?))
}

/// `DELETE /v1/uploads/{id}`.
pub(super) async fn forget(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(id): Path<String>,
) -> Answered {
    grant.may(Role::Push)?;
    let upload = server.spool()?.get(&id)?;
    let writer = upload.write().await?;
    let spool = server.spool()?.clone();
    blocking(move || {
        spool.forget(&upload);
        drop(writer);
        Ok(())
    })
    .await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// `PATCH /v1/uploads/{id}`: appends at `Upload-Offset`. What arrives before a connection is lost
/// stays; of a body that is refused, nothing does.
pub(super) async fn append(
    State(server): State<Arc<Server>>,
    Extension(grant): Extension<Arc<Grant>>,
    Extension(patience): Extension<Arc<Patience>>,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Answered {
    grant.may(Role::Push)?;
    let spool = server.spool()?.clone();
    let upload = spool.get(&id)?;
    let offset = number(&headers, &UPLOAD_OFFSET)?;
    let length = match headers.contains_key(header::CONTENT_LENGTH) {
        true => number(&headers, &header::CONTENT_LENGTH)?,
        false => 0,
    };
    let digest = sha256_of_content(&headers)?;
    let writer = upload.write().await?;
    let held = upload.offset();
    if offset != held {
        return Err(Fault::UploadOffset { given: offset, held }.into());
    }
    let size = upload.announced().size;
    too_long(size, held.saturating_add(length))?;
    if upload.is_complete() {
        return Ok(answer(StatusCode::OK, &upload));
    }
    let (writer, found) = receive(&server, &upload, writer, &patience, body).await?;
    // All of a large upload is hashed here, while no byte comes.
    let settled = blocking(move || settle(&spool, upload, writer, (offset, digest, found)));
    Ok(answer(StatusCode::OK, &*patience.during(settled).await?))
}

/// Writes a body as it comes, and hashes it. Blocks nobody but its own connection.
async fn receive(
    server: &Server,
    upload: &Arc<Upload>,
    mut writer: Writer,
    patience: &Patience,
    mut body: Body,
) -> Result<(Writer, Sha256), Fault> {
    let (start, size) = (upload.offset(), upload.announced().size);
    let (mut found, mut gathered) = (Sha256::new(), Vec::new());
    let mut leave = pin!(upload.leave());
    loop {
        let frame = tokio::select! {
            frame = timeout(limits::UPLOAD_SILENCE, body.frame()) => frame,
            () = &mut leave => return Err(Fault::Replaced),
            () = server.stopped() => return Err(Fault::ShuttingDown),
        };
        let frame = match frame {
            Ok(Some(Ok(frame))) => frame.into_data().ok(),
            Ok(None) => None,
            // What came until here stays, for the client that comes back.
            Ok(Some(Err(_))) => {
                blocking(move || writer.append(&gathered)).await?;
                return Err(Fault::TimedOut("rest of the upload"));
            }
            Err(_) => {
                blocking(move || writer.append(&gathered)).await?;
                return Err(Fault::TimedOut("more of the upload"));
            }
        };
        patience.extend();
        let is_last = frame.is_none();
        gathered.extend_from_slice(&frame.unwrap_or_default());
        let arrived = upload.offset() + gathered.len() as u64;
        if let Err(fault) = too_long(size, arrived) {
            blocking(move || writer.cut(start)).await?;
            return Err(fault);
        }
        if is_last || gathered.len() >= limits::UPLOAD_WRITE_BYTES {
            let full = std::mem::take(&mut gathered);
            server.metrics.uploaded_bytes.inc_by(full.len() as u64);
            found.update(&full);
            let spool = server.spool()?.clone();
            let of = upload.clone();
            writer = blocking(move || match writer.append(&full) {
                Ok(()) => Ok(writer),
                Err(fault) => {
                    // A full disk: what is there of it would only keep it full.
                    spool.forget(&of);
                    Err(fault)
                }
            })
            .await?;
        }
        if is_last {
            return Ok((writer, found));
        }
    }
}

/// The end of a body: it is what its digest says, and if it was the last, so is the whole.
fn settle(
    spool: &Spool,
    upload: Arc<Upload>,
    mut writer: Writer,
    (offset, promised, found): (u64, Option<Vec<u8>>, Sha256),
) -> Result<Arc<Upload>, Fault> {
    let found = found.finalize();
    if let Some(promised) = promised
        && promised != found.as_slice()
    {
        writer.cut(offset)?;
        let [promised, found] = [&promised[..], &found].map(|hash| BASE64.encode(hash));
        return Err(Fault::UploadDigest { what: "the body's sha-256", promised, found });
    }
    if upload.offset() == upload.announced().size
        && let Err(fault) = writer.finish()
    {
        spool.forget(&upload);
        return Err(fault);
    }
    Ok(upload)
}

fn too_long(size: u64, arrives: u64) -> Result<(), Fault> {
    if arrives <= size {
        return Ok(());
    }
    Err(Fault::UploadDigest {
        what: "the size of what arrives",
        promised: format!("{size} bytes"),
        found: format!("at least {arrives} bytes"),
    })
}

/// Work that may wait for a disk.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Fault> + Send + 'static,
) -> Result<T, Fault> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|_| Fault::Internal("a task crashed; the server's log says where".to_owned()))?
}

fn number(headers: &HeaderMap, name: &HeaderName) -> Result<u64, Fault> {
    let value = headers.get(name).and_then(|value| value.to_str().ok()?.trim().parse().ok());
    value.ok_or_else(|| Fault::InvalidRequest {
        field: Some(name.to_string()),
        reason: format!("the header {name} must be there, and a number of bytes"),
    })
}

/// The `sha-256` of `Content-Digest` (RFC 9530, section 2), if it is there; others are left aside,
/// as the standard asks.
fn sha256_of_content(headers: &HeaderMap) -> Result<Option<Vec<u8>>, Fault> {
    let values = headers.get_all(CONTENT_DIGEST).into_iter().flat_map(|value| value.to_str());
    let mut entries = values.flat_map(|value| value.split(','));
    let Some(digest) = entries.find_map(|entry| entry.trim().strip_prefix("sha-256=")) else {
        return Ok(None);
    };
    let bytes = digest.strip_prefix(':').and_then(|rest| rest.strip_suffix(':'));
    let bytes = bytes.and_then(|base64| BASE64.decode(base64.as_bytes()).ok());
    let bytes = bytes.filter(|bytes| bytes.len() == 32);
    bytes.map(Some).ok_or_else(|| Fault::InvalidRequest {
        field: Some(CONTENT_DIGEST.to_string()),
        reason: format!("{digest:?} is not base64 of 32 bytes between colons"),
    })
}

fn answer(status: StatusCode, upload: &Upload) -> Response {
    let location = format!("/v1/uploads/{}", upload.id());
    let mut response = (status, Json(convert::upload(upload))).into_response();
    let headers = response.headers_mut();
    headers.insert(UPLOAD_OFFSET, upload.offset().into());
    headers.insert(UPLOAD_LENGTH, upload.announced().size.into());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if let Ok(location) = location.parse() {
        headers.insert(header::LOCATION, location);
    }
    response
}
