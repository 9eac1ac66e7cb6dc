//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// How long a client waits for an answer: the longest step, and the longest time to send it.
pub const ANSWER_TIMEOUT: Duration =
    wildcity_protocol::limits::STEP_TIMEOUT.saturating_add(wildcity_protocol::limits::SEND_TIMEOUT);

/// Bytes of an upload that are written at once.
pub const UPLOAD_WRITE_BYTES: usize = 1 << 20;

/// How long a client waits for a connection.
pub const HTTP_CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a client waits for an answer of HTTP: none of them waits for a push or a render.
pub const HTTP_TIMEOUT: Duration = Duration::from_secs(60);

/// Slowest way of an upload, and slowest hashing of it, that a client waits for, in bytes per second.
pub const UPLOAD_BYTES_PER_S: u64 = 1 << 20;

/// Largest answer of HTTP that a client reads: the report of 100,000 cells is 5 MB.
pub const HTTP_ANSWER_BYTES: usize = 64 << 20;

/// How often a client tries again without a byte getting through.
pub const HTTP_TRIES: u32 = 6;

/// How long it waits before the first of those tries; twice as long before each further one, 12 s in
/// all.
pub const HTTP_RETRY: Duration = Duration::from_millis(200);

/// How often a client asks how it stands with a push.
pub const PUSH_POLL: Duration = Duration::from_millis(100);
