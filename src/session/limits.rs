//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Simulated time per step, in microseconds: 10 Hz.
pub const DT_US: i64 = 100_000;

/// An episode with an observation whose images are believed less than this, on average, left the model:
/// 11.5 m beside what was recorded, two lanes behind the next.
pub const OFF_MODEL_TRUST: f64 = 0.1;

/// JPEG quality unless the session asks for another.
pub const JPEG_QUALITY: u8 = 90;

/// Largest observation a client accepts, 1.5 GiB: [`ANSWER_PIXELS`] at [`PIXEL_BYTES`] are
/// 1,476 MB; with normals, 12 bytes a pixel more, half as many fit. Six raw 1440x928 images with depth and opacity are 88 MB.
pub const OBSERVATION_BYTES: usize = 3 << 29;

/// Bytes of a pixel without normals at most: raw colour, f32 depth and opacity.
pub const PIXEL_BYTES: u64 = 3 + 4 + 4;

/// Largest header of an observation that a client accepts: 16 poses of 16 cameras are 256 images
/// of at most 3.5 kB, together 0.9 MB.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// Sessions at once, open ones and ones waiting to be resumed.
pub const SESSIONS: usize = 256;

/// Poses of one `observe`.
pub const OBSERVE_POSES: usize = 16;

/// Pixels of one answer, all images together: 16 poses of six 1440x928 cameras are 128 MPx.
pub const ANSWER_PIXELS: u64 = 128 << 20;

/// How long one step may take, rendering and waiting for other sessions included.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Poses of the ego history: 1.6 s at 10 Hz, what Alpamayo reads.
pub const HISTORY_POSES: usize = 16;

/// Spacing of the ego history, in microseconds.
pub const HISTORY_STEP_US: i64 = 100_000;

/// Last frames of each camera in one observation: 1.5 s at 10 Hz, as far as the ego history reaches.
pub const BUNDLE_FRAMES: usize = HISTORY_POSES;

/// Longest time between two frames of a camera, or two decisions, in microseconds: unless a step is
/// longer.
pub const BUNDLE_PERIOD_US: i64 = 10_000_000;

/// Longest warm-up, in microseconds: sixteen frames of a second each, and more than twice what any
/// agent reads. Of a log at 100 Hz these are 2,000 poses.
pub const WARM_UP_US: i64 = 20_000_000;

/// Shortest simulated time of a step, in microseconds: at 1 kHz the ego history needs 1,500 poses.
pub const DT_MIN_US: i64 = 1_000;

/// Longest simulated time of a step, in microseconds.
pub const DT_MAX_US: i64 = 10_000_000;

/// Frames that may wait for the renderer. A session waits for one at a time; one whose deadline
/// passed can leave a dead one behind, hence twice.
pub const QUEUED_FRAMES: usize = 2 * SESSIONS;

/// Bytes of all answers that are being made, sent, or kept for a repeated `seq`, and of what lies over
/// the images of sessions, 134 MB each at worst: 100 sessions with
/// six raw 1440x928 images, depth and opacity (88 MB each), or every session with JPEGs.
pub const ANSWERS_BYTES: u64 = 9 << 30;

/// Largest image, in bytes of RGB, whose room the renderer keeps for the next frame: 3840x2160.
/// 16 of them are 400 MB.
pub const SCRATCH_IMAGE_BYTES: usize = 3 * (8 << 20);

/// Longest line of an episode file but the first: 256 image hashes of `observe` take 17 kB.
pub const EPISODE_LINE_BYTES: usize = 1 << 20;

/// Longest first line, which has the rig: its overlays, 2^24 pixels of 4 bytes which no PNG makes smaller,
/// are 90 MB in base64.
pub const EPISODE_HEAD_BYTES: usize = 96 << 20;

/// The rig of a session on a twin that has none, unless the session says otherwise.
pub const RIG: &str = "vehicle6";

/// How long a version stays in use for garbage collection after its server last said so, ...
pub const LEASE: Duration = Duration::from_secs(900);

/// ... and how often it says so: two may be lost.
pub const LEASE_RENEWAL: Duration = Duration::from_secs(300);

/// How far ahead is loaded: three times what all but one of a hundred loads take, within these. A
/// disk's 1 s at 30 m/s are 30 m; 5 s cover a remote store on a bad day.
pub const PREFETCH_AHEAD: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(5));

/// Steps whose own places are looked at: a second at 10 Hz.
pub const IMMINENT_STEPS: usize = 10;

/// Distance of places beyond those, in metres: a level of detail changes every 16 m and more where it
/// is not on the next steps' way.
pub const PREFETCH_SPACING_M: f64 = 8.0;

/// Places that are looked at after a step, and as many of a hint: 512 m, 0.2 ms each in a city.
pub const PREFETCH_PLACES: usize = 64;

/// Poses of one `prefetch` request: 2 km of a polyline.
pub const PREFETCH_POSES: usize = 256;

/// Distance from a recorded drive within which the ego is taken to follow it, in metres: the other
/// side of a wide road.
pub const ROUTE_NEAR_M: f64 = 15.0;

/// A step that is shorter is none, in metres.
pub const STANDSTILL_STEP_M: f64 = 0.01;

/// What is loaded ahead of an ego that stands on a recorded drive, in metres: five seconds of a town's
/// speed.
pub const STANDSTILL_AHEAD_M: f64 = 50.0;

/// Steps ahead at most, however much faster than the clock they come.
pub const STEPS_AHEAD: usize = 256;

/// Poses along the twin's trajectory at which a push is compared, unless it names others.
pub const PREVIEW_POSES: usize = 4;

/// Longest side of the images that are compared, in pixels.
pub const PREVIEW_SIDE_PX: u32 = 320;

/// How long a push may load what its version changes where sessions drive, before it is ready all the
/// same.
pub const PREFETCH_TIMEOUT: Duration = Duration::from_secs(60);

/// How often it is looked whether that is loaded: twenty times a second add nothing to seconds of
/// loading.
pub const PREPARE_POLL: Duration = Duration::from_millis(50);

// A session's answer of any kind fits the budget while no other session has one.
const _: () = assert!(OBSERVATION_BYTES as u64 <= ANSWERS_BYTES);

// The longest step has a path that reaches its end.
const _: () = assert!(wildcity_sim::limits::PATH_US >= DT_MAX_US);

// A session that waits for a section which a store never answers for is told so before the step's time
// is over: 3 attempts of 3 x 5 s + 0.1 s + 0.2 s, and 0.25 s between them, are 46.2 s.
const _: () = {
    use wildcity_twin::limits::{
        LOAD_ATTEMPTS, LOAD_BACKOFF, REMOTE_BACKOFF, SECTION_TIMEOUT, SECTION_TRIES,
    };
    let pauses = (1 << (SECTION_TRIES - 1)) - 1;
    let attempt_ms =
        SECTION_TIMEOUT.as_millis() * SECTION_TRIES as u128 + REMOTE_BACKOFF.as_millis() * pauses;
    let between_ms = 5 * LOAD_BACKOFF.as_millis();
    assert!(LOAD_ATTEMPTS as u128 * attempt_ms + between_ms < STEP_TIMEOUT.as_millis());
};

// The largest answer that a session gives fits a message.
const _: () =
    assert!(ANSWER_PIXELS * PIXEL_BYTES + OBSERVATION_HEADER_BYTES <= OBSERVATION_BYTES as u64);
