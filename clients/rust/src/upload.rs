//! Resumable uploads: a file is announced by its digest, and only the bytes that the server lacks
//! are sent.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use futures_util::stream;
use http_body::Frame;
use http_body_util::StreamBody;
use reqwest::header::CONTENT_LENGTH;
use reqwest::{Body, Method};

use wildcity_protocol::http::{NewUpload, Upload};

use crate::http::{HttpClient, HttpError};
use crate::limits;

impl HttpClient {
    /// Uploads a file, or the part of it that the server lacks. `on_progress` gets the bytes on the
    /// server and the size of the file.
    ///
    /// # Errors
    /// The file cannot be read, or changes during the upload; the server refuses; or
    /// [`limits::HTTP_ATTEMPTS`] attempts in a row fail without transferring a byte.
    pub async fn upload(
        &self,
        path: &Path,
        on_progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Upload, HttpError> {
        // The digest names the upload: the server finds by it what an earlier attempt has left.
        let announcement = self.announce(path).await?;
        let mut failures = 0;
        let mut furthest = 0;
        loop {
            let failure = match self.send_rest(path, &announcement, on_progress).await {
                Ok(upload) if upload.complete => return Ok(upload),
                Ok(_) => self.no_answer(&"the upload stopped in the middle"),
                Err(error) if is_transient(&error) => error,
                Err(error) => return Err(error),
            };
            // An attempt that transferred something starts the count of failures again.
            let offset = match self.start_upload(&announcement).await {
                Ok(upload) => upload.offset,
                Err(error) if is_transient(&error) => furthest,
                Err(error) => return Err(error),
            };
            failures = if offset > furthest { 0_u32 } else { failures + 1 };
            furthest = furthest.max(offset);
            if failures >= limits::HTTP_ATTEMPTS {
                return Err(failure);
            }
            // `failures` is less than HTTP_ATTEMPTS here, so that the power stays small.
            let waits = 2_u32.pow(failures.saturating_sub(1));
            tokio::time::sleep(limits::HTTP_RETRY_DELAY * waits).await;
        }
    }

    /// Reads the whole file for its size and digest.
    async fn announce(&self, path: &Path) -> Result<NewUpload, HttpError> {
        // Hashing a large file takes minutes, in which this thread has to serve other tasks.
        let owned_path = path.to_owned();
        let announcement = tokio::task::spawn_blocking(move || announcement(&owned_path)).await;
        announcement
            .map_err(|error| self.no_answer(&error))?
            .map_err(|cause| unreadable_file(path, cause))
    }

    /// Announces the upload to the server, and returns how many of its bytes the server has.
    async fn start_upload(&self, announcement: &NewUpload) -> Result<Upload, HttpError> {
        self.request_json(Method::POST, &["v1", "uploads"], Some(announcement)).await
    }

    /// Sends the bytes that the server does not have yet.
    async fn send_rest(
        &self,
        path: &Path,
        announcement: &NewUpload,
        on_progress: &mut (dyn FnMut(u64, u64) + Send),
    ) -> Result<Upload, HttpError> {
        let upload = self.start_upload(announcement).await?;
        on_progress(upload.offset, upload.size);
        if upload.complete {
            return Ok(upload);
        }

        let mut file = File::open(path).map_err(|cause| unreadable_file(path, cause))?;
        file.seek(SeekFrom::Start(upload.offset)).map_err(|cause| unreadable_file(path, cause))?;
        let remaining = upload.size - upload.offset;
        // Shared with the body, which is moved into the request and cannot be asked.
        let sent = Arc::new(AtomicU64::new(upload.offset));
        let request = self
            .request(Method::PATCH, &["v1", "uploads", &upload.id])
            .header("Upload-Offset", upload.offset)
            .header(CONTENT_LENGTH, remaining)
            .body(file_body(file, remaining, sent.clone()));

        // Twice the size: the server hashes the whole file after its last byte.
        let transfer_s = 2 * upload.size / limits::UPLOAD_BYTES_PER_S;
        let time_limit = limits::HTTP_TIMEOUT + Duration::from_secs(transfer_s);
        let sending = self.send(request, time_limit);
        tokio::pin!(sending);
        let answer = loop {
            tokio::select! {
                answer = &mut sending => break answer?,
                () = tokio::time::sleep(limits::PUSH_POLL_INTERVAL) => {
                    on_progress(sent.load(Ordering::Relaxed), upload.size);
                }
            }
        };
        on_progress(upload.size, upload.size);
        serde_json::from_slice(&answer).map_err(|error| self.no_answer(&error))
    }
}

/// Whether the same request may succeed later.
fn is_transient(error: &HttpError) -> bool {
    match error {
        HttpError::NoAnswer { .. } => true,
        // Another client, or an earlier connection of this one, has sent more.
        HttpError::Refused { offset: Some(_), .. } => true,
        HttpError::Refused { status, .. } => matches!(status, 408 | 503),
        _ => false,
    }
}

/// Name, size and digest of a file.
fn announcement(path: &Path) -> io::Result<NewUpload> {
    let mut file = File::open(path)?;
    let mut hasher = blake3::Hasher::new();
    let mut buffer = vec![0; limits::UPLOAD_CHUNK_BYTES];
    let mut size = 0;
    loop {
        let read = file.read(&mut buffer)?;
        if read == 0 {
            break;
        }
        hasher.update(&buffer[..read]);
        size += read as u64;
    }
    // The server takes a name, not a path: a separator of either system is none of it.
    let name = path.file_name().unwrap_or_default().to_string_lossy().replace(['/', '\\'], "_");
    Ok(NewUpload { name, size, digest: format!("blake3:{}", hasher.finalize().to_hex()) })
}

/// The next `remaining` bytes of a file. `sent` is increased as they are sent.
fn file_body(file: File, remaining: u64, sent: Arc<AtomicU64>) -> Body {
    let chunks = stream::try_unfold((file, remaining, sent), async |(file, remaining, sent)| {
        if remaining == 0 {
            return Ok(None);
        }
        let read = tokio::task::spawn_blocking(move || read_chunk(file, remaining)).await;
        let (file, bytes) = read.map_err(io::Error::other)??;
        let remaining = remaining - bytes.len() as u64;
        sent.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok::<_, io::Error>(Some((Frame::data(bytes), (file, remaining, sent))))
    });
    Body::wrap(StreamBody::new(chunks))
}

/// At most [`limits::UPLOAD_CHUNK_BYTES`] of a file.
fn read_chunk(mut file: File, remaining: u64) -> io::Result<(File, Bytes)> {
    let mut bytes = vec![0; remaining.min(limits::UPLOAD_CHUNK_BYTES as u64) as usize];
    let read = file.read(&mut bytes)?;
    if read == 0 {
        return Err(io::Error::other("the file became shorter during the upload"));
    }
    // A read may give less than was asked for, in the middle of a file as well.
    bytes.truncate(read);
    Ok((file, bytes.into()))
}

fn unreadable_file(path: &Path, cause: io::Error) -> HttpError {
    HttpError::File { path: path.display().to_string(), cause }
}
