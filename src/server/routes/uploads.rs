//! Uploads over HTTP: announced with their digest, appended to at an offset, checked after the last
//! byte.

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

use crate::auth::Grant;
use crate::blocking::{blocking, parsed};
use crate::convert;
use crate::fault::Fault;
use crate::idle_deadline::IdleDeadline;
use crate::limits;
use crate::spool::{Spool, Upload, Writer};
use crate::state::ServerState;

use super::refusal::HttpResult;

const UPLOAD_OFFSET: HeaderName = HeaderName::from_static("upload-offset");
const UPLOAD_LENGTH: HeaderName = HeaderName::from_static("upload-length");
const CONTENT_DIGEST: HeaderName = HeaderName::from_static("content-digest");

/// `POST /v1/uploads`: 201 if bytes are still missing, 200 if none are.
pub(super) async fn begin(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    body: Bytes,
) -> HttpResult {
    let announced = parsed(body, convert::new_upload).await?;
    let spool = state.spool()?.clone();
    let upload = blocking(move || spool.begin(&grant.name, announced)).await?;
    state.metrics.uploads_begun.inc();
    // The client sees from the status whether it has anything to send.
    let status = if upload.is_complete() { StatusCode::OK } else { StatusCode::CREATED };
    Ok(answer(status, &upload))
}

/// `GET` or `HEAD /v1/uploads/{id}`: how many bytes have arrived.
pub(super) async fn show(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(id): Path<String>,
) -> HttpResult {
    Ok(answer(StatusCode::OK, &*state.spool()?.get(&grant.name, &id)?))
}

/// The handler of `DELETE /v1/uploads/{id}`.
pub(super) async fn delete(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Path(id): Path<String>,
) -> HttpResult {
    let spool = state.spool()?.clone();
    let upload = spool.get(&grant.name, &id)?;
    // Taking the upload over ends the connection that writes to it: its file must not be removed
    // under its hands.
    let writer = spool.write(&upload).await?;
    blocking(move || {
        spool.remove(&upload);
        drop(writer);
        Ok::<_, Fault>(())
    })
    .await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// `PATCH /v1/uploads/{id}`: appends at `Upload-Offset`. Bytes that arrive before a connection is
/// lost are kept; nothing is kept of a body that is refused.
pub(super) async fn append(
    State(state): State<Arc<ServerState>>,
    Extension(grant): Extension<Arc<Grant>>,
    Extension(deadline): Extension<Arc<IdleDeadline>>,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> HttpResult {
    let spool = state.spool()?.clone();
    let upload = spool.get(&grant.name, &id)?;

    // The announced bytes must continue the upload.
    let start = number(&headers, &UPLOAD_OFFSET)?;
    // A body of unknown length is checked as it arrives.
    let length = if headers.contains_key(header::CONTENT_LENGTH) {
        number(&headers, &header::CONTENT_LENGTH)?
    } else {
        0
    };
    let announced_sha256 = sha256_of_content(&headers)?;
    let writer = spool.write(&upload).await?;
    // Read after the take-over: until then another connection could append.
    let held = upload.offset();
    if start != held {
        return Err(Fault::UploadOffset { given: start, held }.into());
    }
    check_length(upload.announced().size, held.saturating_add(length))?;
    // A repetition of the last part, whose answer was lost.
    if upload.is_complete() {
        return Ok(answer(StatusCode::OK, &upload));
    }

    let received = receive(&state, &upload, writer, &deadline, body).await?;
    // Hashing a large upload after its last byte takes a while, in which no bytes arrive.
    let finished = blocking(move || {
        let Received { mut writer, sha256 } = received;
        check_content_digest(&mut writer, start, announced_sha256, sha256)?;
        finish(&spool, upload, writer)
    });
    Ok(answer(StatusCode::OK, &*deadline.extend_during(finished).await?))
}

/// A body that was written.
struct Received {
    writer: Writer,
    /// SHA-256 of the body.
    sha256: Sha256,
}

/// Writes and hashes a body as it arrives. A slow body delays no other connection.
async fn receive(
    state: &ServerState,
    upload: &Arc<Upload>,
    mut writer: Writer,
    deadline: &IdleDeadline,
    mut body: Body,
) -> Result<Received, Fault> {
    let start = upload.offset();
    let size = upload.announced().size;
    // Of this body, for `Content-Digest`. The digest of the whole file is computed from the disk,
    // after its last byte.
    let mut sha256 = Sha256::new();
    let mut buffer = Vec::new();
    // Made once before the loop, so that a take-over during a write is not missed.
    let mut released = pin!(upload.released());
    loop {
        let frame = tokio::select! {
            frame = timeout(limits::UPLOAD_SILENCE, body.frame()) => frame,
            () = &mut released => return Err(Fault::Replaced),
            () = state.stopped() => return Err(Fault::ShuttingDown),
        };
        let frame = match frame {
            // Trailers are no data, and come after the last byte.
            Ok(Some(Ok(frame))) => frame.into_data().ok(),
            Ok(None) => None,
            // Keep the bytes that have arrived for a client that continues the upload.
            Ok(Some(Err(_))) => {
                blocking(move || writer.append(&buffer)).await?;
                return Err(Fault::TimedOut("rest of the upload"));
            }
            Err(_) => {
                blocking(move || writer.append(&buffer)).await?;
                return Err(Fault::TimedOut("more of the upload"));
            }
        };
        deadline.extend();
        let is_last = frame.is_none();
        buffer.extend_from_slice(&frame.unwrap_or_default());
        // `offset` is at most the announced size, and the buffer is at most 1 MiB and one frame.
        let arrived = upload.offset() + buffer.len() as u64;
        if let Err(fault) = check_length(size, arrived) {
            blocking(move || writer.truncate(start)).await?;
            return Err(fault);
        }
        // A write for each frame of some KiB would change threads a hundred times as often.
        if is_last || buffer.len() >= limits::UPLOAD_WRITE_BYTES {
            let full = std::mem::take(&mut buffer);
            state.metrics.uploaded_bytes.inc_by(full.len() as u64);
            sha256.update(&full);
            let spool = state.spool()?.clone();
            let upload = upload.clone();
            writer = blocking(move || {
                // The writer moves to the thread and back: it blocks, and has one user at a time.
                spool.make_room(&upload, full.len() as u64)?;
                match writer.append(&full) {
                    Ok(()) => Ok(writer),
                    Err(fault) => {
                        // The disk is full: keeping the upload would keep it full.
                        spool.remove(&upload);
                        Err(fault)
                    }
                }
            })
            .await?;
        }
        if is_last {
            return Ok(Received { writer, sha256 });
        }
    }
}

/// Refuses a body that does not match its `Content-Digest`, and discards it.
fn check_content_digest(
    writer: &mut Writer,
    start: u64,
    announced: Option<Vec<u8>>,
    received: Sha256,
) -> Result<(), Fault> {
    let received = received.finalize();
    // An absent digest is no mistake: the whole file has one that is checked.
    if let Some(announced) = announced
        && announced != received.as_slice()
    {
        writer.truncate(start)?;
        return Err(Fault::UploadDigest {
            what: "the body's sha-256",
            promised: BASE64.encode(&announced),
            found: BASE64.encode(&received),
        });
    }
    Ok(())
}

/// After the last byte of the upload: checks the whole file, and removes it if it does not match
/// its digest.
fn finish(spool: &Spool, upload: Arc<Upload>, mut writer: Writer) -> Result<Arc<Upload>, Fault> {
    // Bytes are missing otherwise, and the next request continues.
    if upload.offset() == upload.announced().size
        && let Err(fault) = writer.finish()
    {
        // If the disk only failed to read, keep the upload: a request without bytes checks it
        // again.
        if !matches!(fault, Fault::SpoolRead { .. }) {
            spool.remove(&upload);
        }
        return Err(fault);
    }
    Ok(upload)
}

/// Refuses more bytes than were announced.
fn check_length(announced: u64, arrived: u64) -> Result<(), Fault> {
    if arrived <= announced {
        return Ok(());
    }
    Err(Fault::UploadDigest {
        what: "the size of what arrives",
        promised: format!("{announced} bytes"),
        found: format!("at least {arrived} bytes"),
    })
}

fn number(headers: &HeaderMap, name: &HeaderName) -> Result<u64, Fault> {
    let value = headers.get(name).and_then(|value| value.to_str().ok()?.trim().parse().ok());
    value.ok_or_else(|| Fault::InvalidRequest {
        field: Some(name.to_string()),
        reason: format!("the header {name} is missing, or is not a number of bytes"),
    })
}

/// The `sha-256` of `Content-Digest` (RFC 9530, section 2), if there is one. Other algorithms are
/// ignored, as the standard requires.
fn sha256_of_content(headers: &HeaderMap) -> Result<Option<Vec<u8>>, Fault> {
    let values = headers.get_all(CONTENT_DIGEST).into_iter().flat_map(|value| value.to_str());
    let mut entries = values.flat_map(|value| value.split(','));
    let Some(digest) = entries.find_map(|entry| entry.trim().strip_prefix("sha-256=")) else {
        return Ok(None);
    };
    let base64 = digest.strip_prefix(':').and_then(|rest| rest.strip_suffix(':'));
    let bytes = base64
        .and_then(|base64| BASE64.decode(base64.as_bytes()).ok())
        .filter(|bytes| bytes.len() == 32);
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
    // A cached offset would be that of an earlier moment.
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if let Ok(location) = location.parse() {
        headers.insert(header::LOCATION, location);
    }
    response
}
