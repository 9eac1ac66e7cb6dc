//! Every default and every limit, in one place, with the sum that gave it.

use std::time::Duration;

/// Where `serve` listens unless told otherwise.
pub const LISTEN: &str = "127.0.0.1:8080";

/// Simulated time per step, in microseconds: 10 Hz.
pub const DT_US: i64 = 100_000;

/// JPEG quality unless the session asks for another.
pub const JPEG_QUALITY: u8 = 90;

/// Largest message from a client. Poses and rigs are kilobytes; 1 MiB is room for 10,000 poses.
pub const INBOUND_MESSAGE_BYTES: usize = 1 << 20;

/// Largest observation a client accepts: 16 raw 4K images with depth and opacity would be 2.9 GB;
/// six 1440x928 raw images with both are 88 MB.
pub const OBSERVATION_BYTES: usize = 1 << 30;

/// Largest header of an observation: 16 poses of 16 cameras are 256 images of 0.7 kB of metadata
/// and 0.3 kB of tensor table, a quarter of this.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// Connections at once, WebSocket and HTTP together.
pub const CONNECTIONS: usize = 1024;

/// Sessions at once, open ones and ones waiting to be resumed.
pub const SESSIONS: usize = 256;

/// Poses of one `observe`.
pub const OBSERVE_POSES: usize = 16;

/// Pixels of one answer, all images together: 16 images of 8 MPx.
pub const ANSWER_PIXELS: u64 = 16 * (8 << 20);

/// How long the first message of a connection may take.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a connection may be silent between requests before it is closed.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(600);

/// How long a client may take to read an answer.
pub const SEND_TIMEOUT: Duration = Duration::from_secs(30);

/// How long one step may take, rendering and waiting for other sessions included.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a client waits for an answer: the longest step, and the longest time to send it.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(60 + 30);

/// How long a session outlives its connection, waiting for `resume`.
pub const RESUME_GRACE: Duration = Duration::from_secs(60);

/// How long running steps may finish after SIGTERM.
pub const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// Poses of the ego history: 1.6 s at 10 Hz, what Alpamayo reads.
pub const HISTORY_POSES: usize = 16;

/// Spacing of the ego history, in microseconds.
pub const HISTORY_STEP_US: i64 = 100_000;
