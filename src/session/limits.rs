//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

use wildcity_scene::Rig;

/// Largest number of events of one observation.
pub const EVENTS: usize = 64;

/// Room in the header of an observation for its events and the route: 64 events of at most 600
/// bytes, 20 points of 80, and a text of a command of at most 1,000 bytes, each twice at worst,
/// since the metadata is a text within JSON.
// 2 x (64 x 600 + 20 x 80 + 1,000) = 82,000 bytes, of 98,304.
pub const SCENARIO_HEADER_BYTES: usize = 96 << 10;

/// Bytes of a map whose lanes a listing of scenarios has, and of all of them.
pub const PLANNED_MAP_BYTES: usize = 4 << 20;
pub const PLANNED_MAPS_BYTES: usize = 16 << 20;

/// Scenarios that a listing reads.
pub const PLANNED_SCENARIOS: usize = 256;

/// Room for an actor: a name of 64 bytes, 14 numbers of at most 24 digits, and the names of the
/// fields.
// 64 + 14 x 24 = 400 bytes, which leaves 240 for names of fields and punctuation.
pub const ACTOR_HEADER_BYTES: usize = 640;

/// Largest number of episodes that wait to be exported as MCAP: at 20 ms each, 20 s of work.
/// Further episodes are not exported, and the listing says so.
// 1,024 x 20 ms = 20.5 s.
pub const WAITING_EXPORTS: usize = 1024;

/// Largest record that is exported as MCAP by itself, in bytes: it is held in memory, several times
/// its size. A day at 10 Hz has 720 MB; `wildcity episode export` reads it.
pub const EXPORTED_RECORD_BYTES: u64 = 64 << 20;

/// Episodes whose failed export is remembered: more than a listing has.
pub const FAILED_EXPORTS: usize = 1024;

/// Longest time that a task may hold a thread that answers requests.
pub const LONGEST_POLL: Duration = Duration::from_millis(50);

/// Default simulated time per step, in microseconds: 10 Hz.
pub const DT_US: i64 = 100_000;

/// An episode ends as `off_model` if the trust of one of its poses, or the mean trust of one of its
/// observations, was below this. It is reached at a lateral offset of 11.5 m from the recorded
/// drive, two lanes beyond the neighbouring one.
pub const OFF_MODEL_TRUST: f64 = 0.1;

/// JPEG quality unless the session requests another.
pub const JPEG_QUALITY: u8 = 90;

/// Largest observation that a client accepts, 1.5 GiB: [`ANSWER_PIXELS`] at [`PIXEL_BYTES`] are
/// 1,476 MB. Normals add 12 bytes a pixel, so that half as many pixels fit with them; instances 2
/// and classes 1, so that three quarters fit with either or both. Six raw 1440x928 images with
/// depth and opacity are 88 MB.
// 2²⁷ pixels x 11 bytes = 1,476,395,008, of 1,610,612,736 bytes.
pub const OBSERVATION_BYTES: usize = 3 << 29;

/// Largest number of bytes per pixel without normals, instances and classes: raw colour, and depth
/// and opacity as f32.
pub const PIXEL_BYTES: u64 = 3 + 4 + 4;

/// Bytes per pixel of normals.
pub const NORMAL_BYTES: u64 = 12;

/// Bytes per pixel of instances.
pub const INSTANCE_BYTES: u64 = 2;

/// Bytes per pixel of classes.
pub const SEMANTICS_BYTES: u64 = 1;

/// Largest header of an observation that a client accepts: 16 poses of 16 cameras are 256 images
/// of at most 3.5 kB, together 0.9 MB.
// 16 x 16 x 3.5 kB = 896 kB.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// Open sessions, both connected ones and ones that wait for their client to resume.
pub const SESSIONS: usize = 256;

/// Largest number of steps of a plan, `until_us` of a step: a minute at 16 Hz. Each keeps a pose of
/// 64 bytes until the plan's end.
pub const PLAN_STEPS: usize = 1_000;

/// How long a render queue that is dropped waits for the frames that are being rendered. 128 Mi
/// pixels at 15 ns each (two cores, BENCHMARKS.md) take 2.0 s. A frame that takes longer is
/// abandoned: on a GPU in software, or if a driver hangs.
pub const LAST_FRAME_TIMEOUT: Duration = Duration::from_secs(10);

/// Sub-steps of actors and the ego that a simulation takes without a turn: 0.1 s of 256 actors, or
/// 25 s of an ego alone. They take about 10 ms.
pub const SHORT_WORK: u64 = 2_570;

/// Rigs whose overlays are decoded at once: each takes up to 200 MB while it is decoded, and a
/// second of a processor.
pub const OVERLAYS_AT_ONCE: usize = 2;

/// Scenarios that are read and resolved at once on a machine of few processors; on others half of
/// them: one of 1 MiB takes 80 MB and 0.1 s, and one with a
/// map of 16 MiB 115 MiB and 0.5 s.
pub const SCENARIOS_AT_ONCE: usize = 2;

/// Records that are read whole at once, for branches and results: each takes several times the size
/// of the commands in it.
pub const RECORDS_AT_ONCE: usize = 2;

/// Longest plan, in microseconds: as long as the longest trajectory.
pub const PLAN_US: i64 = wildcity_sim::limits::PATH_US;

/// Largest notes of a step, in bytes of JSON. A line of the record has room for them.
pub const NOTES_BYTES: usize = 64 << 10;

/// Snapshots of one session. A snapshot holds the last frames of a bundle, which count against
/// [`ANSWERS_BYTES`], and the poses of 1.5 s.
pub const SNAPSHOTS: usize = 64;

/// Poses of one `observe` request.
pub const OBSERVE_POSES: usize = 16;

/// Pixels of one answer, all images together: 16 poses of six 1440x928 cameras are 128 MPx.
// 16 x 6 x 1440 x 928 = 128,286,720 pixels, of 134,217,728.
pub const ANSWER_PIXELS: u64 = 128 << 20;

/// How long one step may take, including rendering and time in queues.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Poses of the ego history: 1.6 s at 10 Hz, the input of the Alpamayo driving model.
pub const HISTORY_POSES: usize = 16;

/// Time between two poses of the ego history, in microseconds.
pub const HISTORY_STEP_US: i64 = 100_000;

/// Largest number of frames of each camera in one observation: 1.5 s at 10 Hz, the length of the
/// ego history.
pub const BUNDLE_FRAMES: usize = HISTORY_POSES;

/// Longest time between two frames of a camera, or between two decisions, in microseconds. A longer
/// step raises it to the step.
pub const BUNDLE_PERIOD_US: i64 = 10_000_000;

/// Largest lateral jitter of a random start, in metres: the other side of a wide road.
pub const START_LATERAL_M: f64 = 20.0;

/// How old the picture of a camera with effects may be, in microseconds. The track keeps the poses
/// of that time: at 1 kHz these are 10,000 poses of 64 bytes.
pub const SENSOR_REACH_US: i64 = 10_000_000;

/// After this number of lost frames in a row the camera delivers the oldest of them: at one in two,
/// every 500th frame.
pub const SENSOR_DROPS: i64 = 8;

/// Shortest and longest time between two values of a drifting exposure or bias, in microseconds: up
/// to an hour.
pub const DRIFT_PERIOD_US: std::ops::RangeInclusive<i64> = 1_000..=3_600_000_000;

/// Time between two biases of an inertial measurement unit unless the session names another, in
/// microseconds.
pub const BIAS_PERIOD_US: i64 = 60_000_000;

/// Largest number of spots of dirt on a lens. Each is computed for each image.
pub const DIRT_SPOTS: u64 = 256;

/// Longest warm-up, in microseconds: sixteen frames at 1 Hz, and more than twice what any known
/// agent reads. At 100 Hz these are 2,000 poses of a recorded drive.
pub const WARM_UP_US: i64 = 20_000_000;

/// Shortest simulated time of a step, in microseconds: at 1 kHz the ego history needs 1,500 poses.
pub const DT_MIN_US: i64 = 1_000;

/// Longest simulated time of a step, in microseconds.
pub const DT_MAX_US: i64 = 10_000_000;

/// The renderer's intermediate buffers may use 1/`FRAME_SHARE` of the memory for twins. A frame
/// that needs more is rendered in parts, which costs little: 128 MiB of 1 GiB are a million
/// Gaussians at once.
pub const FRAME_SHARE: u64 = 8;

/// Solid Gaussians, with which contact is looked for, may use 1/`SOLID_SHARE` of the memory for
/// twins in addition to it: 32 MiB of 1 GiB are 2 million places of 10 cm, the surfaces of 300
/// blocks of 16 m. Nine blocks are near an ego.
pub const SOLID_SHARE: u64 = 32;

/// Solid Gaussians are read ahead up to this far from the ego, in metres: 2 s at 20 m/s.
pub const SOLIDS_AHEAD_M: f64 = 40.0;

/// Bytes per pixel of a JPEG file for which memory is set aside: twice those of a street of quality
/// 90.
pub const JPEG_PIXEL_BYTES: u64 = 1;

/// Frames that may wait for the renderer. A session waits for one at a time, and may leave an
/// abandoned one in the queue after its deadline: hence twice the sessions.
// 2 x 256 = 512.
pub const QUEUED_FRAMES: usize = 2 * SESSIONS;

/// Bytes of a return of a LiDAR in an answer: position, intensity, row, column, instance, class.
pub const POINT_BYTES: u64 = 4 * 4 + 3 * 2 + 1;

/// A frame of more samples takes a second and more on processors, so small frames are rendered at
/// the same time. Sixteen 1440x928 images, of a sample a pixel, are 21 million.
// 16 x 1440 x 928 = 21,381,120 samples are below 24 x 2²⁰ = 25,165,824.
pub const LARGE_SAMPLES: u64 = 24 << 20;

/// Bytes of all answers that are being made, sent, or kept for a repeated `seq`, and of the
/// sessions' overlays, which take 134 MB per session at worst. Enough for 100 sessions with six raw
/// 1440x928 images, depth and opacity (88 MB each), or for JPEGs to every session.
// 100 x 88 MB = 8.8 GB, of 9.66 GB.
pub const ANSWERS_BYTES: u64 = 9 << 30;

/// Largest memory of an answer, in bytes, that is kept for the next answer: six raw 1440x928 images
/// take 24 MB.
pub const SPARE_ANSWER_BYTES: usize = 32 << 20;

/// Largest memory that a render thread keeps for the next frame, in bytes: RGB and opacity of six
/// 1440x928 images take 56 MB.
// Six images have 8,017,920 pixels, of 3 bytes of colour and 4 of opacity.
pub const SCRATCH_BYTES: usize = 64 << 20;

/// The rig preset of a session that requests no rig, on a twin that has none.
pub const RIG: &str = "vehicle6";

/// How long a lease keeps garbage collection from an open version after its last renewal.
pub const LEASE: Duration = Duration::from_secs(900);

/// Time between two renewals of a lease. Two in a row may fail before the lease ends.
pub const LEASE_RENEWAL: Duration = Duration::from_secs(300);

/// How long the number of a twin's latest version answers the sessions that ask for it after every
/// step.
pub const LATEST_AGE: Duration = Duration::from_secs(1);

/// The same for a twin in an object store, where each look is a request that costs money.
pub const REMOTE_LATEST_AGE: Duration = Duration::from_secs(10);

/// Distances from a viewpoint to a block that a frame computes on the thread of its session, to
/// find the sections that it draws: 0.1 ms. More of them, as in a city, are computed on another
/// thread.
pub const DEMAND_IN_PLACE: usize = 1 << 14;

/// Shortest and longest time that prefetching looks ahead. Between them it is three times the 99th
/// percentile of the load times. 1 s, for a local disk, is 30 m at 30 m/s; 5 s cover a slow remote
/// store.
pub const PREFETCH_AHEAD: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(5));

/// How many of the next steps are prefetched at their exact poses: a second at 10 Hz.
pub const IMMINENT_STEPS: usize = 10;

/// Distance between two prefetched poses beyond those steps, in metres. Along the path, the level
/// of detail of a block at the side changes every 16 m or more.
pub const PREFETCH_SPACING_M: f64 = 8.0;

/// Number of poses that are prefetched after a step, and the same number along the agent's hint:
/// 512 m. Each takes 0.2 ms in a city.
// 64 x 8 m.
pub const PREFETCH_PLACES: usize = 64;

/// Poses of one `prefetch` request: 2 km of a polyline.
pub const PREFETCH_POSES: usize = 256;

/// The ego counts as following a recorded drive within this distance, in metres: the other side of
/// a wide road.
pub const ROUTE_NEAR_M: f64 = 15.0;

/// The ego counts as standing if its last step was shorter than this, in metres.
pub const STANDSTILL_STEP_M: f64 = 0.01;

/// How far along a recorded drive is prefetched for an ego that stands on it, in metres: five
/// seconds at urban speed.
pub const STANDSTILL_AHEAD_M: f64 = 50.0;

/// Largest number of steps that prefetching looks ahead, even if the agent steps much faster than
/// real time.
pub const STEPS_AHEAD: usize = 256;

/// How long a push may preload its version for the running sessions. After that the version counts
/// as ready even if something is still missing.
pub const PRELOAD_TIMEOUT: Duration = Duration::from_secs(60);

/// Time between two checks whether the preload is complete. Twenty checks a second add little to
/// seconds of loading.
pub const PRELOAD_POLL: Duration = Duration::from_millis(50);

// The memory for answers is the memory that is set aside for images.
const _: () = assert!(ANSWERS_BYTES == wildcity_twin::limits::IMAGE_BYTES);

// The largest answer fits the budget while no other session has one.
const _: () = assert!(OBSERVATION_BYTES as u64 <= ANSWERS_BYTES);

// A path may be as long as the longest step.
const _: () = assert!(wildcity_sim::limits::PATH_US >= DT_MAX_US);

// A session that waits for a section which a store never delivers gets an error before its step
// times out: 3 attempts of 3 x 5 s + 0.1 s + 0.2 s, and 0.25 s between them, are 46.2 s.
const _: () = {
    use wildcity_twin::limits::{
        LOAD_ATTEMPTS, LOAD_BACKOFF, REMOTE_BACKOFF, SECTION_TIMEOUT, SECTION_TRIES,
    };
    // Pauses double: between three tries they are 1 + 2 of the first.
    let pauses = (1 << (SECTION_TRIES - 1)) - 1;
    let attempt_ms =
        SECTION_TIMEOUT.as_millis() * SECTION_TRIES as u128 + REMOTE_BACKOFF.as_millis() * pauses;
    // Pauses grow by a factor of four: between three attempts they are 1 + 4 of the first.
    let between_ms = 5 * LOAD_BACKOFF.as_millis();
    assert!(LOAD_ATTEMPTS as u128 * attempt_ms + between_ms < STEP_TIMEOUT.as_millis());
};

// The largest answer of a session fits a message, with normals at half of the pixels, and with
// instances and classes at three quarters of them; each beside the largest sweeps.
const _: () = {
    let sweeps_bytes = POINT_BYTES * Rig::MAX_BEAMS as u64;
    let room_bytes = OBSERVATION_BYTES as u64 - OBSERVATION_HEADER_BYTES - sweeps_bytes;
    assert!(ANSWER_PIXELS * PIXEL_BYTES <= room_bytes);
    let with_owners = PIXEL_BYTES + INSTANCE_BYTES + SEMANTICS_BYTES;
    assert!(ANSWER_PIXELS / 2 * (PIXEL_BYTES + NORMAL_BYTES) <= room_bytes);
    assert!(ANSWER_PIXELS * 3 / 4 * with_owners <= room_bytes);
    // Both at once: three quarters of one half.
    assert!(ANSWER_PIXELS * 3 / 8 * (with_owners + NORMAL_BYTES) <= room_bytes);
};

/// Distance along a drive between two frames whose images are compared for flicker, in metres: 8
/// m/s and ten frames a second.
pub const FRAME_M: f64 = 0.8;
