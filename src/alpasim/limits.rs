//! Limits and defaults of this package.

use std::time::Duration;

/// Largest message: AlpaSim's client accepts as much. 16 raw 1920x1080 images have 100 MB, so that
/// large batches need an encoding.
pub const MESSAGE_BYTES: usize = 64 << 20;

/// How long a request may wait for its images. AlpaSim's renderer waits as long for its backend.
pub const RENDER_TIMEOUT: Duration = Duration::from_secs(300);

/// How long a twin's memory stays reserved after its last image.
pub const SCENE_IDLE: Duration = Duration::from_secs(600);

/// Versions with reserved memory at once.
pub const OPEN_SCENES: usize = 16;

/// Images of one request: a minute of a rig of 16 cameras at 4 Hz would be 3,840.
pub const BATCH_IMAGES: usize = 256;

/// Dynamic objects whose assets stay in memory between requests. A box has at most 1,280 Gaussians,
/// which take about 160 kB with their coarser levels: 384 boxes take 61 MB. All assets count
/// against the memory of twins.
pub const OBJECT_ASSETS: usize = 384;

/// Longest id of a track, in bytes.
pub const TRACK_ID_BYTES: usize = 256;

/// Longest message of a gRPC status, in bytes: HTTP/2 sends it as a header.
pub const STATUS_BYTES: usize = 4096;

/// Boxes that one request puts on the ground: a rollout of 20 s has 200 poses of the ego. At 1 ms
/// each, for 170,000 keyframes, they take 1 s.
pub const PHYSICS_BOXES: usize = 1024;

/// Requests that put boxes on the ground at once. Each takes a thread.
pub const PHYSICS_REQUESTS: usize = 8;

/// A box is moved by physics up to this far, in metres, as by AlpaSim's own service.
pub const PHYSICS_TRANSLATION_M: f64 = 1.5;

/// A box is turned by physics up to this far, in radians: 10 degrees, as by AlpaSim's own service.
pub const PHYSICS_ROTATION_RAD: f64 = 0.174_532_925_199_432_95;

/// Distance between two listed starts along a drive, in metres.
pub const SCENE_SPACING_M: f64 = 100.0;

/// Largest number of listed scenes: 1,000 km of drives.
pub const LISTED_SCENES: usize = 10_000;

/// Length of the trajectory of a scene, in seconds.
pub const SCENE_S: f64 = 20.0;

/// JPEG quality of a request that names none.
pub const JPEG_QUALITY: u8 = 95;

/// HTTP/2 connections at once.
pub const CONNECTIONS: usize = 256;

/// How long connections may take to send their last answers when the service stops.
pub const DRAIN: Duration = Duration::from_secs(2);

/// Time of the start of every scene, in microseconds since 1970: AlpaSim requires integers of this
/// size.
pub const EPOCH_US: u64 = 1_700_000_000_000_000;

/// How long a driver may take until it answers: networks of 20 GB are loaded from disk.
pub const DRIVER_START: Duration = Duration::from_secs(120);

/// How long a driver may take for one answer, unless told otherwise.
pub const DRIVER_ANSWER: Duration = Duration::from_secs(60);

/// Largest image that is sent to a driver: gRPC servers accept messages of 4 MiB by default, with
/// their other fields.
pub const DRIVER_IMAGE_BYTES: usize = (4 << 20) - 1024;

/// Poses of a plan that are used: the limit of a step's trajectory.
pub const PLAN_POSES: usize = 64;
