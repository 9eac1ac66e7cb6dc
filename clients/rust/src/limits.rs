//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

use wildcity_protocol::limits::{SEND_TIMEOUT, STEP_TIMEOUT};

/// How long a client waits for an answer on the WebSocket: the longest step (60 s) plus the longest
/// time to send its answer (30 s).
pub const ANSWER_TIMEOUT: Duration = STEP_TIMEOUT.saturating_add(SEND_TIMEOUT);

/// Bytes of an upload that are read from the file and sent at a time.
pub const UPLOAD_CHUNK_BYTES: usize = 1 << 20;

/// How long a client waits for a TCP and TLS connection to an HTTP server.
pub const HTTP_CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a client waits for an HTTP answer. The server answers at once: no HTTP request but that
/// for an asset of an actor waits for a push or a rendered image.
pub const HTTP_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a client waits until an asset of an actor is stored: as long as a server reads by
/// default (30 minutes), and time for earlier pushes.
pub const ACTOR_TIMEOUT: Duration = Duration::from_secs(3600);

/// Lowest rate, in bytes per second, at which an upload is sent and at which the server hashes it.
/// A client that meets a lower rate gives up.
pub const UPLOAD_BYTES_PER_S: u64 = 1 << 20;

/// Largest HTTP answer that a client reads: the report of a push to 100,000 cells takes 5 MB.
pub const HTTP_ANSWER_BYTES: usize = 64 << 20;

/// How many successive attempts may fail before a client gives up. An attempt that transfers at
/// least one byte starts the count again.
pub const HTTP_ATTEMPTS: u32 = 6;

/// How long a client waits before it repeats a failed attempt. The wait doubles with every further
/// attempt (0.2 s, 0.4 s, ...), to 12 s in total.
pub const HTTP_RETRY_DELAY: Duration = Duration::from_millis(200);

/// How often a client asks for the state of a push, and reports the progress of an upload.
pub const PUSH_POLL_INTERVAL: Duration = Duration::from_millis(100);
