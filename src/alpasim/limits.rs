//! Limits and defaults of this package.

use std::time::Duration;

/// Largest message: AlpaSim's client accepts as much. 16 raw 1920x1080 images have 100 MB, so that
/// large batches need an encoding.
pub const MESSAGE_BYTES: usize = 64 << 20;

/// Messages in one request: 256 images with 250 objects each. One takes up to 700 bytes in memory,
/// and two on the wire.
pub const SUBMESSAGES: usize = 1 << 16;

/// Bytes of all requests that are being received, and of those of one connection, in KiB.
pub const REQUESTS_KIB: usize = 256 << 10;
/// Bytes of the requests of one connection, in KiB: see [`REQUESTS_KIB`].
pub const CONNECTION_KIB: usize = 96 << 10;

/// How long a client may take to send one request. 64 MiB take 54 s at 10 Mbit/s.
pub const RECEIVE: Duration = Duration::from_secs(60);

/// How long a connection may take to its first request.
pub const HELLO: Duration = Duration::from_secs(10);

/// How long a connection may be without a request afterwards. gRPC clients connect again by
/// themselves.
pub const CONNECTION_IDLE: Duration = Duration::from_secs(600);

/// Longest id of a scene: two names of 64 bytes, and two numbers. Rust writes an f64 with up to 327
/// characters.
pub const SCENE_ID_BYTES: usize = 512;

/// Scenes of one version that are remembered as drawn.
pub const DRAWN_SCENES: usize = 1000;

/// How long a request may wait for its images. AlpaSim's renderer waits as long for its backend.
pub const RENDER_TIMEOUT: Duration = Duration::from_secs(300);

/// How long a twin's memory stays reserved after its last image.
pub const SCENE_IDLE: Duration = Duration::from_secs(600);

/// Versions with reserved memory at once.
pub const OPEN_SCENES: usize = 16;

/// Images of one request: a minute of a rig of 16 cameras at 4 Hz would be 3,840.
pub const BATCH_IMAGES: usize = 256;

/// Most sweeps of one request: the largest has 460,800 points of 32 bytes, and an answer 64 MiB.
pub const BATCH_SWEEPS: usize = 4;

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
