//! Observations in memory that a server on the same machine shares, in place of the socket.
//!
//! They are copied out of that memory. A mapping would save the copy, but Rust has no safe one: the
//! server may write a slot again while a slice of it is alive.

use std::fs::File;
use std::sync::Arc;

use tokio::task::spawn_blocking;
use tokio_tungstenite::tungstenite::Bytes;

use wildcity_protocol::limits::OBSERVATION_BYTES;

use crate::error::ClientError;

/// Longest proof that is read.
const PROOF_BYTES: u64 = 1024;

/// Memory that a server shares with this client.
#[derive(Clone, Debug)]
pub(crate) struct SharedMemory {
    file: Arc<File>,
    size: u64,
}

/// The server's description of the memory that it offers.
pub(crate) struct Offer {
    pub(crate) path: String,
    pub(crate) target: String,
    pub(crate) proof_bytes: u64,
    pub(crate) size: u64,
}

impl SharedMemory {
    /// Opens the memory, and reads the text that proves it to the server.
    ///
    /// # Errors
    /// [`ClientError::SharedMemory`]: the server runs on another machine, in another container or
    /// as another user.
    pub(crate) fn open(offer: &Offer) -> Result<(Self, String), ClientError> {
        let failed = |reason: String| {
            ClientError::SharedMemory(format!(
                "cannot open the server's memory {}: {reason}. The server must run on this machine, in the same \
                 container and as the same user; connect without shared memory otherwise",
                offer.path
            ))
        };
        // If the server is on another machine or in another container, its path may be of another
        // file, which must not be opened.
        let found = std::fs::read_link(&offer.path).map_err(|error| failed(error.to_string()))?;
        if found.as_os_str() != offer.target.as_str() {
            return Err(failed(format!("it is {}, not {}", found.display(), offer.target)));
        }
        // The length comes from the peer, and is allocated below.
        if offer.proof_bytes > PROOF_BYTES {
            return Err(failed(format!("its proof has {} bytes", offer.proof_bytes)));
        }
        let file = File::open(&offer.path).map_err(|error| failed(error.to_string()))?;
        let mut proof = vec![0; offer.proof_bytes as usize];
        read_exact_at(&file, &mut proof, 0).map_err(|error| failed(error.to_string()))?;
        let proof = String::from_utf8(proof).map_err(|error| failed(error.to_string()))?;
        Ok((Self { file: Arc::new(file), size: offer.size }, proof))
    }

    /// Copies a message out of the memory.
    pub(crate) async fn read(&self, offset: u64, bytes: u64) -> Result<Bytes, ClientError> {
        // Both numbers come from the peer: their sum may overflow.
        let inside = offset.checked_add(bytes).is_some_and(|end| end <= self.size);
        if !inside || bytes > OBSERVATION_BYTES as u64 {
            let place = format!("{bytes} bytes at {offset} of {}", self.size);
            return Err(ClientError::SharedMemory(format!("a message is outside of it: {place}")));
        }
        let file = self.file.clone();
        // Copying tens of megabytes would hold up other tasks of this thread.
        let read = spawn_blocking(move || {
            let mut message = vec![0; bytes as usize];
            read_exact_at(&file, &mut message, offset).map(|()| Bytes::from(message))
        });
        let failed =
            |reason: String| ClientError::SharedMemory(format!("cannot read it: {reason}"));
        let read = read.await.map_err(|error| failed(error.to_string()))?;
        read.map_err(|error| failed(error.to_string()))
    }
}

#[cfg(unix)]
fn read_exact_at(file: &File, buffer: &mut [u8], offset: u64) -> std::io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, buffer, offset)
}

#[cfg(not(unix))]
fn read_exact_at(_: &File, _: &mut [u8], _: u64) -> std::io::Result<()> {
    Err(std::io::ErrorKind::Unsupported.into())
}
