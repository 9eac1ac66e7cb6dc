//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Where `serve` listens unless told otherwise.
pub const LISTEN: &str = "127.0.0.1:8080";

/// Connections at once, WebSocket and HTTP together.
pub const CONNECTIONS: usize = 1024;

/// How long a connection may be silent between requests before it is closed.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(600);

/// How long a session outlives its connection, waiting for `resume`.
pub const RESUME_GRACE: Duration = Duration::from_secs(60);

/// How long running steps may finish after SIGTERM.
pub const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// Connections beside [`CONNECTIONS`] that no WebSocket can take, so that health checks and
/// refusals get through when all of those are taken.
pub const SPARE_CONNECTIONS: usize = 64;

/// Pongs that a client has not read, and the goodbye, of at most 129 bytes each.
pub const PONGS_BYTES: usize = 4 << 10;

/// How long a refused client's last bytes are read and thrown away, so that it can read why.
pub const LINGER: Duration = Duration::from_secs(2);

/// Silence after which TCP asks whether the other side still exists, and how often it asks again;
/// three unanswered probes end the connection: 20 + 3 x 5 = 35 s. The peer's kernel answers, so an
/// agent that thinks for minutes without reading its socket stays connected.
pub const KEEPALIVE: (Duration, Duration, u32) =
    (Duration::from_secs(20), Duration::from_secs(5), 3);

/// Longer requests are read on a thread that may take its time: what is 16 KiB unpacks to 17 MB of an
/// overlay at most, in some 20 ms.
pub const INLINE_REQUEST_BYTES: usize = 16 << 10;

/// Uploads that a server keeps, finished or not: a city's blocks, each in a file.
pub const UPLOADS: usize = 1024;

/// Longest name of an upload: what file systems allow.
pub const UPLOAD_NAME_BYTES: usize = 255;

/// Largest upload: 250 million Gaussians of 236 bytes are 59 GB.
pub const UPLOAD_BYTES: u64 = 64 << 30;

/// Bytes of all uploads, as announced: two of the largest.
pub const SPOOL_BYTES: u64 = 2 * UPLOAD_BYTES;

/// How long an upload is kept after its last byte.
pub const UPLOAD_AGE: Duration = Duration::from_secs(24 * 3600);

/// How long an upload may stand still before its connection is closed; it can go on later.
pub const UPLOAD_SILENCE: Duration = Duration::from_secs(30);

/// Bytes of an upload that are written at once.
pub const UPLOAD_WRITE_BYTES: usize = 1 << 20;

/// Pushes that wait or run. Each holds its request, and nothing of its files.
pub const PUSHES: usize = 16;

/// Pushes whose end is remembered: 100,000 cells of a report are 3 MB, most have a hundred.
pub const PUSHES_REMEMBERED: usize = 64;

/// Files of one push.
pub const PUSH_FILES: usize = 256;

/// Gaussians of one push, all its files together: 248 B each in memory at SH degree 3 are 62 GB, and
/// as much again while files are joined. The largest upload holds no more, unless it is packed.
pub const PUSH_GAUSSIANS: u64 = 250_000_000;

/// Poses at which a push is compared: 32 small images before, and 32 after.
pub const GOLDEN_POSES: usize = 32;

/// Gaussians of a push that is compared: in memory beside it, 92 B each at SH degree 1, 1.8 GB.
pub const GOLDEN_GAUSSIANS: usize = 20_000_000;

/// Characters of a push's note.
pub const NOTE_CHARS: usize = 1000;

/// A cell that a push shrinks to less than this share, without naming it, is taken for one that it
/// only touched: stray Gaussians of a neighbour's margin.
pub const SHRUNK_SHARE: f64 = 0.1;

/// Largest file of tokens: 200 B each.
pub const TOKENS_FILE_BYTES: u64 = 1 << 20;

// A client accepts every answer of a session, and waits for it long enough.
const _: () = {
    use wildcity_protocol::limits as wire;
    use wildcity_session::limits as session;
    assert!(session::OBSERVATION_BYTES == wire::OBSERVATION_BYTES);
    assert!(session::OBSERVATION_HEADER_BYTES == wire::OBSERVATION_HEADER_BYTES);
    assert!(session::HISTORY_POSES == wire::HISTORY_POSES);
    assert!(session::STEP_TIMEOUT.as_millis() == wire::STEP_TIMEOUT.as_millis());
};
