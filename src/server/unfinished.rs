//! Bytes of WebSocket messages that were begun and have not ended: a client may begin one on each
//! of its connections, and never end it.

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::limits;

/// Bytes of the unfinished messages of all connections.
#[derive(Debug, Default)]
pub(crate) struct Unfinished(Mutex<Sums>);

#[derive(Debug, Default)]
struct Sums {
    all: usize,
    /// By token, those that have some.
    tokens: BTreeMap<String, usize>,
}

/// Bytes of the unfinished message of one connection.
#[derive(Debug)]
pub(crate) struct OwnUnfinished {
    all: Arc<Unfinished>,
    token: String,
    own: usize,
}

/// Bytes of a control frame of a client beside its payload: two, and four of the mask.
const CONTROL_FRAME: usize = 6;

impl OwnUnfinished {
    /// Of a connection of a token, whose name is empty on a server without tokens.
    pub(crate) fn new(all: Arc<Unfinished>, token: String) -> Self {
        Self { all, token, own: 0 }
    }

    /// Counts bytes that arrived.
    ///
    /// # Errors
    /// All connections together, or those of the token, have begun too much, and this one more than
    /// a request usually has.
    pub(crate) fn received(&mut self, bytes: usize) -> io::Result<()> {
        self.own += bytes;
        let mut sums = self.all.0.lock();
        sums.all += bytes;
        let of_token = sums.tokens.entry(self.token.clone()).or_default();
        *of_token += bytes;
        let is_over = *of_token > limits::share_of_token(&self.token, limits::UNFINISHED_BYTES)
            || sums.all > limits::UNFINISHED_BYTES;
        if is_over && self.own > limits::INLINE_REQUEST_BYTES {
            return Err(io::Error::from(io::ErrorKind::QuotaExceeded));
        }
        Ok(())
    }

    /// A ping or a pong arrived, which may lie within a message.
    pub(crate) fn control_frame(&mut self, payload: usize) {
        self.free(payload + CONTROL_FRAME);
    }

    /// A message arrived whole.
    pub(crate) fn message_ended(&mut self) {
        self.free(self.own);
    }

    /// Whether a message was begun.
    pub(crate) fn is_within_message(&self) -> bool {
        self.own > 0
    }

    fn free(&mut self, bytes: usize) {
        // The bytes of a frame that HTTP had read ahead were never counted.
        let freed = bytes.min(self.own);
        self.own -= freed;
        let mut sums = self.all.0.lock();
        sums.all -= freed;
        if let Some(token) = sums.tokens.get_mut(&self.token) {
            *token -= freed;
            // Names of tokens that have nothing do not stay.
            if *token == 0 {
                sums.tokens.remove(&self.token);
            }
        }
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
        let of = |token: &str| OwnUnfinished::new(all.clone(), token.to_owned());
        let most = limits::UNFINISHED_BYTES;
        let mut long = of("");
        long.received(most).unwrap();
        let mut next = of("");
        // Short requests are still received, and a long one is not.
        next.received(limits::INLINE_REQUEST_BYTES).unwrap();
        let refused = next.received(1).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::QuotaExceeded);
        next.message_ended();
        assert!(!next.is_within_message());
        // A ping within a message is no part of it.
        long.received(CONTROL_FRAME + 3).unwrap_err();
        long.control_frame(3);
        assert_eq!(all.0.lock().all, limits::UNFINISHED_BYTES);
        drop(long);
        assert_eq!(all.0.lock().all, 0);
        assert!(all.0.lock().tokens.is_empty());
        // A token leaves a quarter to others.
        let mut ann = of("ann");
        ann.received(most / 4 * 3).unwrap();
        ann.received(1).unwrap_err();
        of("bob").received(most / 5).unwrap();
    }
}
