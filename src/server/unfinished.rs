//! Bytes of WebSocket messages that were begun and have not ended: a client may begin one on each
//! of its connections, and never end it.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::limits;

/// Bytes of the unfinished messages of all connections.
#[derive(Debug, Default)]
pub(crate) struct Unfinished(AtomicU64);

/// Bytes of the unfinished message of one connection.
#[derive(Debug)]
pub(crate) struct OwnUnfinished {
    all: Arc<Unfinished>,
    own: u64,
}

/// Bytes of a control frame of a client beside its payload: two, and four of the mask.
const CONTROL_FRAME: u64 = 6;

impl OwnUnfinished {
    pub(crate) fn new(all: Arc<Unfinished>) -> Self {
        Self { all, own: 0 }
    }

    /// Counts bytes that arrived.
    ///
    /// # Errors
    /// All connections together have begun too much, and this one more than a request usually has.
    pub(crate) fn received(&mut self, bytes: usize) -> io::Result<()> {
        self.own += bytes as u64;
        // Only the sum counts, and no other memory depends on it.
        let all = self.all.0.fetch_add(bytes as u64, Relaxed) + bytes as u64;
        let is_long = self.own > limits::INLINE_REQUEST_BYTES as u64;
        if is_long && all > limits::UNFINISHED_BYTES {
            return Err(io::Error::from(io::ErrorKind::QuotaExceeded));
        }
        Ok(())
    }

    /// A ping or a pong arrived, which may lie within a message.
    pub(crate) fn control_frame(&mut self, payload: usize) {
        self.free(payload as u64 + CONTROL_FRAME);
    }

    /// A message arrived whole.
    pub(crate) fn message_ended(&mut self) {
        self.free(self.own);
    }

    /// Whether a message was begun.
    pub(crate) fn is_within_message(&self) -> bool {
        self.own > 0
    }

    fn free(&mut self, bytes: u64) {
        // The bytes of a frame that HTTP had read ahead were never counted.
        let freed = bytes.min(self.own);
        self.own -= freed;
        self.all.0.fetch_sub(freed, Relaxed);
    }
}

impl Drop for OwnUnfinished {
    fn drop(&mut self) {
        self.message_ended();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_begun_counts_until_it_ends_or_its_connection_does() {
        let all = Arc::new(Unfinished::default());
        let most = limits::UNFINISHED_BYTES as usize;
        let mut long = OwnUnfinished::new(all.clone());
        long.received(most).unwrap();
        let mut next = OwnUnfinished::new(all.clone());
        // Short requests are still received, and a long one is not.
        next.received(limits::INLINE_REQUEST_BYTES).unwrap();
        let refused = next.received(1).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::QuotaExceeded);
        next.message_ended();
        assert!(!next.is_within_message());
        // A ping within a message is no part of it.
        long.received(CONTROL_FRAME as usize + 3).unwrap_err();
        long.control_frame(3);
        assert_eq!(all.0.load(Relaxed), limits::UNFINISHED_BYTES);
        drop(long);
        assert_eq!(all.0.load(Relaxed), 0);
        next.received(most).unwrap();
    }
}
