//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Largest message from a client. Poses and rigs are kilobytes; 1 MiB has room for 10,000 poses.
pub const INBOUND_MESSAGE_BYTES: usize = 1 << 20;

/// Largest observation that a client accepts, 1.5 GiB. An answer has at most 134,217,728 pixels of
/// 11 bytes (colour, depth and opacity), which are 1,476 MB; with normals, 12 more bytes a pixel,
/// half as many fit. Six raw 1440x928 images with depth and opacity are 88 MB.
pub const OBSERVATION_BYTES: usize = 3 << 29;

/// Largest header of an observation that a client accepts. 16 poses of 16 cameras are 256 images of
/// at most 3.5 kB, together 0.9 MB.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// Slots of a shared memory: the observation that an agent processes, the previous one, and the one
/// that is written.
pub const MEMORY_SLOTS: usize = 3;

/// How long the first message of a connection may take.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a client may take to read an answer.
pub const SEND_TIMEOUT: Duration = Duration::from_secs(30);

/// How long one step may take, including rendering and waiting for other sessions.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Number of poses of the ego history: 1.6 s at 10 Hz, which is what Alpamayo reads.
pub const HISTORY_POSES: usize = 16;
