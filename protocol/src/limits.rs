//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Largest message from a client. Poses and rigs are kilobytes; 1 MiB is room for 10,000 poses.
pub const INBOUND_MESSAGE_BYTES: usize = 1 << 20;

/// Largest observation a client accepts, 1.5 GiB: [`ANSWER_PIXELS`] at [`PIXEL_BYTES`] are
/// 1,476 MB; with normals, 12 bytes a pixel more, half as many fit. Six raw 1440x928 images with depth and opacity are 88 MB.
pub const OBSERVATION_BYTES: usize = 3 << 29;

/// Largest header of an observation that a client accepts: 16 poses of 16 cameras are 256 images
/// of at most 3.5 kB, together 0.9 MB.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// How long the first message of a connection may take.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a client may take to read an answer.
pub const SEND_TIMEOUT: Duration = Duration::from_secs(30);

/// How long one step may take, rendering and waiting for other sessions included.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Poses of the ego history: 1.6 s at 10 Hz, what Alpamayo reads.
pub const HISTORY_POSES: usize = 16;
