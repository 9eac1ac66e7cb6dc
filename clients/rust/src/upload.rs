//! Uploading a file: announced by its digest, sent from where the server stands, taken up again after
//! a cut.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use futures_util::stream;
use http_body_util::{BodyExt as _, StreamBody};
use hyper::body::Frame;
use hyper::header::CONTENT_LENGTH;
use hyper::{Method, Request};

use crate::limits;
use wildcity_protocol::http::{NewUpload, Upload};

use super::http::{Body, HttpClient, HttpError};

impl HttpClient {
    /// Uploads a file, or what the server lacks of it. `progress` gets bytes done and bytes in all.
    ///
    /// # Errors
    /// The file cannot be read, or changes meanwhile; the server refuses; or it is lost again and
    /// again without a byte getting through.
    pub async fn upload(
        &self,
        path: &Path,
        progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Upload, HttpError> {
        let named = path.to_owned();
        let announced = tokio::task::spawn_blocking(move || announce(&named)).await;
        let announced = announced.map_err(|error| self.lost(&error))?;
        let announced = announced.map_err(|cause| unreadable(path, cause))?;
        let (mut tries, mut furthest) = (0, 0);
        loop {
            let failed = match self.send_rest(path, &announced, progress).await {
                Ok(upload) if upload.complete => return Ok(upload),
                Ok(_) => self.lost(&"the upload stopped in the middle"),
                Err(error) if is_passing(&error) => error,
                Err(error) => return Err(error),
            };
            // Anything that got through gives hope.
            let known: Result<Upload, _> =
                self.json(Method::POST, "/v1/uploads", Some(&announced)).await;
            let offset = match known {
                Ok(upload) => upload.offset,
                Err(error) if is_passing(&error) => furthest,
                Err(error) => return Err(error),
            };
            tries = if offset > furthest { 0 } else { tries + 1 };
            furthest = furthest.max(offset);
            if tries >= limits::HTTP_TRIES {
                return Err(failed);
            }
            tokio::time::sleep(limits::HTTP_RETRY * 2_u32.pow(tries)).await;
        }
    }

    /// Sends everything that the server does not have yet.
    async fn send_rest(
        &self,
        path: &Path,
        announced: &NewUpload,
        progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Upload, HttpError> {
        let upload: Upload = self.json(Method::POST, "/v1/uploads", Some(announced)).await?;
        progress(upload.offset, upload.size);
        if upload.complete {
            return Ok(upload);
        }
        let rest = upload.size - upload.offset;
        let request = Request::builder()
            .method(Method::PATCH)
            .uri(format!("/v1/uploads/{}", upload.id))
            .header("upload-offset", upload.offset)
            .header(CONTENT_LENGTH, rest);
        let sent = Arc::new(AtomicU64::new(upload.offset));
        let mut file = File::open(path).map_err(|cause| unreadable(path, cause))?;
        let sought = file.seek(SeekFrom::Start(upload.offset));
        sought.map_err(|cause| unreadable(path, cause))?;
        let body = body(file, rest, sent.clone());
        // The server hashes all of it after the last byte.
        let patience = limits::HTTP_TIMEOUT
            + std::time::Duration::from_secs(2 * upload.size / limits::UPLOAD_BYTES_PER_S);
        let sending = self.send(request, body, patience);
        tokio::pin!(sending);
        let answer = loop {
            tokio::select! {
                answer = &mut sending => break answer?,
                () = tokio::time::sleep(limits::PUSH_POLL) => {
                    progress(sent.load(Ordering::Relaxed), upload.size);
                }
            }
        };
        progress(upload.size, upload.size);
        serde_json::from_slice(&answer).map_err(|error| self.lost(&error))
    }
}

/// Whether the same may succeed later.
fn is_passing(error: &HttpError) -> bool {
    match error {
        HttpError::Lost { .. } => true,
        // Somebody else, or an earlier connection of ours, is further.
        HttpError::Refused { offset: Some(_), .. } => true,
        HttpError::Refused { status, .. } => matches!(status, 408 | 503),
        _ => false,
    }
}

/// Its name, size and digest; reads all of it.
fn announce(path: &Path) -> io::Result<NewUpload> {
    let mut file = File::open(path)?;
    let mut hasher = blake3::Hasher::new();
    let mut buffer = vec![0; limits::UPLOAD_WRITE_BYTES];
    let mut size = 0;
    loop {
        let read = file.read(&mut buffer)?;
        if read == 0 {
            break;
        }
        hasher.update(&buffer[..read]);
        size += read as u64;
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy().replace(['/', '\\'], "_");
    Ok(NewUpload { name, size, digest: format!("blake3:{}", hasher.finalize().to_hex()) })
}

/// The next `rest` bytes of a file, counted as they leave.
fn body(file: File, rest: u64, sent: Arc<AtomicU64>) -> Body {
    let frames = stream::try_unfold((file, rest, sent), async |(file, rest, sent)| {
        if rest == 0 {
            return Ok(None);
        }
        let read = tokio::task::spawn_blocking(move || read_some(file, rest)).await;
        let (file, bytes) = read.map_err(io::Error::other)??;
        let rest = rest - bytes.len() as u64;
        sent.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok::<_, io::Error>(Some((Frame::data(bytes), (file, rest, sent))))
    });
    StreamBody::new(frames).boxed_unsync()
}

fn read_some(mut file: File, rest: u64) -> io::Result<(File, Bytes)> {
    let mut bytes = vec![0; rest.min(limits::UPLOAD_WRITE_BYTES as u64) as usize];
    let read = file.read(&mut bytes)?;
    if read == 0 {
        return Err(io::Error::other("the file became shorter while it was sent"));
    }
    bytes.truncate(read);
    Ok((file, bytes.into()))
}

fn unreadable(path: &Path, cause: io::Error) -> HttpError {
    HttpError::File { path: path.display().to_string(), cause }
}
