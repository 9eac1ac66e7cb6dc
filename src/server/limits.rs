//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Size at which the audit log is rotated, in bytes: 300,000 lines of 200 B.
pub const AUDIT_BYTES: u64 = 64 << 20;

/// Rotated files of the audit log that are kept: 512 MiB, some 2.4 million lines.
pub const AUDIT_OLD_FILES: usize = 8;

/// Characters of a reason in the audit log; longer ones are cut.
pub const AUDIT_REASON_CHARS: usize = 500;

/// The address that `serve` listens on by default.
pub const LISTEN: &str = "127.0.0.1:8080";

/// WebSocket connections at once.
pub const CONNECTIONS: usize = 1024;

/// Sessions of one connection.
pub const CONNECTION_SESSIONS: usize = 64;

/// How long a connection may be silent between requests before it is closed.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(600);

/// How long a session outlives its connection, waiting for `resume`.
pub const RESUME_GRACE: Duration = Duration::from_secs(60);

/// Time between two returns of free memory to the operating system, while sections are evicted,
/// pushes run, or sessions begin and end. Each walks the whole heap: with 1.1 GiB of sections that
/// come and go it took 140 to 165 ms on two cores at a load of 9, which is less than 2 % of this
/// time; 8 ms where little was free.
pub const MEMORY_RELEASE: Duration = Duration::from_secs(10);

/// How long running steps may take to finish after SIGTERM.
pub const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// Connections in addition to [`CONNECTIONS`], which cannot become WebSockets. They are for HTTP
/// requests while all WebSocket connections are in use.
pub const SPARE_CONNECTIONS: usize = 64;

/// Connections that have not sent a request that a token allows. Each takes a file descriptor and
/// 20 kB.
pub const UNAUTHENTICATED_CONNECTIONS: usize = 512;

/// Unauthenticated connections of one address. Beyond this number the oldest one is closed when a
/// new one arrives.
pub const UNAUTHENTICATED_OF_ADDRESS: usize = 256;

/// Grace period of a new connection, in which it is not closed for another one. A client sends its
/// request with its connection, and 512 requests are read in a few milliseconds.
pub const UNAUTHENTICATED_GRACE: Duration = Duration::from_millis(250);

/// Bytes of pongs and of the close frame that a client has not read; each has at most 129 bytes.
pub const PONGS_BYTES: usize = 4 << 10;

/// Messages of a client that are read while its last request is carried out. They have at most 2
/// MiB together.
pub const EARLY_MESSAGES: usize = 64;

/// How long the last bytes of a refused client are read and discarded, so that it can read the
/// reason.
pub const LINGER: Duration = Duration::from_secs(2);

/// Silence after which TCP probes whether the peer still exists. The peer's kernel answers, so an
/// agent that computes for minutes without reading its socket stays connected. With
/// [`KEEPALIVE_INTERVAL`] and [`KEEPALIVE_PROBES`] a dead peer is noticed after 20 + 3 x 5 = 35 s.
pub const KEEPALIVE_IDLE: Duration = Duration::from_secs(20);

/// Time between two probes.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(5);

/// Unanswered probes that end the connection.
pub const KEEPALIVE_PROBES: u32 = 3;

/// Requests longer than this are parsed on a thread that may block: 16 KiB can decompress to an
/// overlay of 17 MB, which takes about 20 ms.
pub const INLINE_REQUEST_BYTES: usize = 16 << 10;

/// Messages of more than [`INLINE_REQUEST_BYTES`] that are parsed at once: one of 1 MiB takes 50 ms
/// and 48 MiB.
pub const PARSED_AT_ONCE: usize = 4;

/// Bytes of WebSocket messages that were begun and have not ended, on all connections.
pub const UNFINISHED_BYTES: usize = 256 << 20;

/// Messages up to this length are written into shared memory at once, on the thread of the
/// connection: 256 KiB take about 0.1 ms. Longer ones are written on a thread that may block.
pub const INLINE_MEMORY_BYTES: u64 = 256 << 10;

/// Uploads that a server keeps, finished or not: the blocks of a city, each in a file.
pub const UPLOADS: usize = 1024;

/// Longest name of an upload: the limit of file systems.
pub const UPLOAD_NAME_BYTES: usize = 255;

/// Longest name of a token.
pub const TOKEN_NAME_BYTES: usize = 255;

/// Largest file of an announcement: a digest, and the names of an upload and of a token. With all
/// their bytes escaped these have 2 x 6 x 255 = 3,060 bytes.
pub const ANNOUNCEMENT_BYTES: u64 = 16 << 10;

/// Largest upload: 250 million Gaussians of 236 bytes are 59 GB.
pub const UPLOAD_BYTES: u64 = 64 << 30;

/// Bytes of all uploads: two of the largest.
pub const SPOOL_BYTES: u64 = 2 * UPLOAD_BYTES;

/// Part of the spool that each token may use, if several may: half of it, one of the largest
/// uploads.
pub const TOKEN_SHARE: u64 = 2;

/// Space that is reserved for an active upload in addition to the bytes that have arrived: many
/// times what a fast connection sends between two quota checks.
pub const RESERVED_BYTES: u64 = 16 << 20;

/// How long after its last byte, or its announcement, an upload keeps that room.
pub const RESERVED_FOR: Duration = Duration::from_secs(120);

/// How long after its last byte an upload may not be removed to make room for those of another
/// token.
pub const KEPT_FOR: Duration = Duration::from_secs(600);

/// How long an upload is kept after its last byte.
pub const UPLOAD_AGE: Duration = Duration::from_secs(24 * 3600);

/// How long an upload may pause before its connection is closed; another connection can continue
/// it.
pub const UPLOAD_SILENCE: Duration = Duration::from_secs(30);

/// Bytes of an upload that are written at once.
pub const UPLOAD_WRITE_BYTES: usize = 1 << 20;

/// Largest file of tokens: 200 B each.
pub const TOKENS_FILE_BYTES: u64 = 1 << 20;

/// How long a ticket is valid: a page uses it at once.
pub const TICKET_AGE: Duration = Duration::from_secs(30);

/// Largest number of unused tickets: one for each connection, and some for pages that were closed
/// meanwhile.
pub const TICKETS: usize = 2 * CONNECTIONS;

/// Largest number of unused tickets of one token; a page needs one or two at a time.
pub const TOKEN_TICKETS: usize = 32;

/// How long the result of a look at the list of twins answers `GET /readyz`, which needs no token.
pub const READY_AGE: Duration = Duration::from_secs(1);

/// Time between two observations that a watcher is sent; it misses those in between.
pub const WATCH_PERIOD: Duration = Duration::from_millis(100);

/// Bytes of all records. Notes of a megabyte a step would fill a disk at 10 MB/s: this is two hours
/// of it, and 2000 hours of driving at 10 Hz.
pub const RECORDS_BYTES: u64 = 64 << 30;

/// Bytes of the records of one token.
pub const TOKEN_RECORDS_BYTES: u64 = 32 << 30;

/// Bytes of the head of a request, and of what is read of a connection ahead.
pub const HEAD_BYTES: usize = 64 << 10;

/// Parts of drives that are made for HTTP at once. One of 10,000 poses took 45 ms of a
/// processor.
pub const DRIVES_AT_ONCE: usize = 2;

/// Time between two looks for records that are beyond a limit: each lists the directory.
pub const PRUNE_PERIOD: Duration = Duration::from_secs(60);

/// Share of all sessions, connections and unfinished messages that a token without a limit of its
/// own leaves to others: one in four.
pub const LEFT_TO_OTHERS: usize = 4;

/// What a token may have of `all` that there is. All clients of a server without tokens, where the
/// name is empty, are one owner and have all.
pub fn share_of_token(token: &str, all: usize) -> usize {
    if token.is_empty() { all } else { all - all / LEFT_TO_OTHERS }
}

/// Recorded episodes that are listed over HTTP: each file is read for it.
pub const LISTED_EPISODES: usize = 100;

/// Largest file of an episode that is sent over HTTP, as JSONL or MCAP: an hour at 10 Hz with six
/// cameras has 30 MB as JSONL.
pub const EPISODE_BYTES: u64 = 64 << 20;

/// How long a request for the MCAP file of an episode that just ended waits for it.
pub const MCAP_WAIT: Duration = Duration::from_secs(20);

// A client accepts every answer of a session, and waits for it long enough.
const _: () = {
    use wildcity_protocol::limits as wire;
    use wildcity_session::limits as session;
    // The session does not know the protocol, so each package has its own constant. They are equal
    // here, or nothing compiles.
    assert!(session::OBSERVATION_BYTES == wire::OBSERVATION_BYTES);
    assert!(session::OBSERVATION_HEADER_BYTES == wire::OBSERVATION_HEADER_BYTES);
    assert!(session::HISTORY_POSES == wire::HISTORY_POSES);
    assert!(session::STEP_TIMEOUT.as_millis() == wire::STEP_TIMEOUT.as_millis());
};
