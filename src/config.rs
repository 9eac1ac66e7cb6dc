//! Every default and every limit, in one place, with the sum that gave it.

use std::time::Duration;

/// Where `serve` listens unless told otherwise.
pub const LISTEN: &str = "127.0.0.1:8080";

/// The server that clients talk to unless told otherwise.
pub const SERVER_URL: &str = "http://127.0.0.1:8080";

/// Simulated time per step, in microseconds: 10 Hz.
pub const DT_US: i64 = 100_000;

/// An episode with an observation whose images are believed less than this, on average, left the model:
/// 11.5 m beside what was recorded, two lanes behind the next.
pub const OFF_MODEL_TRUST: f64 = 0.1;

/// JPEG quality unless the session asks for another.
pub const JPEG_QUALITY: u8 = 90;

/// Largest message from a client. Poses and rigs are kilobytes; 1 MiB is room for 10,000 poses.
pub const INBOUND_MESSAGE_BYTES: usize = 1 << 20;

/// Largest observation a client accepts, 1.5 GiB: [`ANSWER_PIXELS`] at [`PIXEL_BYTES`] are
/// 1,476 MB; with normals, 12 bytes a pixel more, half as many fit. Six raw 1440x928 images with depth and opacity are 88 MB.
pub const OBSERVATION_BYTES: usize = 3 << 29;

/// Bytes of a pixel without normals at most: raw colour, f32 depth and opacity.
pub const PIXEL_BYTES: u64 = 3 + 4 + 4;

/// Largest header of an observation that a client accepts: 16 poses of 16 cameras are 256 images
/// of at most 3.5 kB, together 0.9 MB.
pub const OBSERVATION_HEADER_BYTES: u64 = 1 << 20;

/// Connections at once, WebSocket and HTTP together.
pub const CONNECTIONS: usize = 1024;

/// Sessions at once, open ones and ones waiting to be resumed.
pub const SESSIONS: usize = 256;

/// Poses of one `observe`.
pub const OBSERVE_POSES: usize = 16;

/// Pixels of one answer, all images together: 16 poses of six 1440x928 cameras are 128 MPx.
pub const ANSWER_PIXELS: u64 = 128 << 20;

// Whatever a server may answer, a client accepts.
const _: () =
    assert!(ANSWER_PIXELS * PIXEL_BYTES + OBSERVATION_HEADER_BYTES <= OBSERVATION_BYTES as u64);

/// How long the first message of a connection may take.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a connection may be silent between requests before it is closed.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(600);

/// How long a client may take to read an answer.
pub const SEND_TIMEOUT: Duration = Duration::from_secs(30);

/// How long one step may take, rendering and waiting for other sessions included.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a client waits for an answer: the longest step, and the longest time to send it.
pub const ANSWER_TIMEOUT: Duration = STEP_TIMEOUT.saturating_add(SEND_TIMEOUT);

/// How long a session outlives its connection, waiting for `resume`.
pub const RESUME_GRACE: Duration = Duration::from_secs(60);

/// How long running steps may finish after SIGTERM.
pub const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

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

/// Connections beside [`CONNECTIONS`] that no WebSocket can take, so that health checks and
/// refusals get through when all of those are taken.
pub const SPARE_CONNECTIONS: usize = 64;

/// Frames that may wait for the renderer. A session waits for one at a time; one whose deadline
/// passed can leave a dead one behind, hence twice.
pub const QUEUED_FRAMES: usize = 2 * SESSIONS;

/// Bytes of all answers that are being made, sent, or kept for a repeated `seq`, and of what lies over
/// the images of sessions, 134 MB each at worst: 100 sessions with
/// six raw 1440x928 images, depth and opacity (88 MB each), or every session with JPEGs.
pub const ANSWERS_BYTES: u64 = 9 << 30;

// One answer of any kind fits while nobody else has one.
const _: () = assert!(OBSERVATION_BYTES as u64 <= ANSWERS_BYTES);

/// Pongs that a client has not read, and the goodbye, of at most 129 bytes each.
pub const PONGS_BYTES: usize = 4 << 10;

/// Largest image, in bytes of RGB, whose room the renderer keeps for the next frame: 3840x2160.
/// 16 of them are 400 MB.
pub const SCRATCH_IMAGE_BYTES: usize = 3 * (8 << 20);

/// How long a refused client's last bytes are read and thrown away, so that it can read why.
pub const LINGER: Duration = Duration::from_secs(2);

/// Silence after which TCP asks whether the other side still exists, and how often it asks again;
/// three unanswered probes end the connection: 20 + 3 x 5 = 35 s. The peer's kernel answers, so an
/// agent that thinks for minutes without reading its socket stays connected.
pub const KEEPALIVE: (Duration, Duration, u32) =
    (Duration::from_secs(20), Duration::from_secs(5), 3);

/// Longest line of an episode file but the first: 256 image hashes of `observe` take 17 kB.
pub const EPISODE_LINE_BYTES: usize = 1 << 20;

/// Longest first line, which has the rig: its overlays, 2^24 pixels of 4 bytes which no PNG makes smaller,
/// are 90 MB in base64.
pub const EPISODE_HEAD_BYTES: usize = 96 << 20;

/// Longer requests are read on a thread that may take its time: what is 16 KiB unpacks to 17 MB of an
/// overlay at most, in some 20 ms.
pub const INLINE_REQUEST_BYTES: usize = 16 << 10;

/// Most render threads: above any machine's cores, below what exhausts a machine's processes.
pub const RENDER_THREADS: usize = 1024;

/// The rig of a session on a twin that has none, unless the session says otherwise.
pub const RIG: &str = "vehicle6";

/// Longest PLY header. INRIA's with degree 3 is 1.5 KB.
pub const PLY_HEADER_BYTES: usize = 64 << 10;

/// Longest safetensors header. A gsplat checkpoint's is under 1 KB.
pub const SAFETENSORS_HEADER_BYTES: usize = 1 << 20;

/// Bytes that a compressed scene may unpack to, however few it has: tests and toys of equal Gaussians.
pub const UNPACKED_FREE_BYTES: u64 = 16 << 20;

/// Bytes beyond those that every compressed byte may unpack to. Scenes reach 2 to 8; deflate can
/// reach 1032 and zstd more.
pub const UNPACKED_PER_BYTE: u64 = 64;

/// Largest archive, glTF buffer or image of a scene, which are held in memory whole: 100 million
/// Gaussians in SOG take 2 GiB.
pub const SCENE_PART_BYTES: u64 = 4 << 30;

/// Largest JSON that describes a scene: SOG's takes 15 kB, its index of levels 200 B per leaf.
pub const SCENE_JSON_BYTES: u64 = 64 << 20;

/// Files of one scene: eight per block of a streamed SOG.
pub const SCENE_PARTS: usize = 100_000;

/// Gaussians that cover the triangles of a mesh, and as many again for those smaller than one's share: a
/// lorry of 60 m² gets one every 17 mm.
pub const MESH_GAUSSIANS: u32 = 200_000;

/// Parts that long triangles of a mesh are halved into, all together, of 232 bytes: 100 MB.
pub const MESH_PARTS: usize = 400_000;

/// Most values beside arrays of a NuRec payload, of 32 bytes each in memory. A log's tracks are
/// 100,000.
pub const NUREC_VALUES: usize = 1 << 20;

/// Most Gaussians of one import: their order within the twin is kept as u32.
pub const IMPORT_GAUSSIANS: u64 = u32::MAX as u64;

/// Largest manifest: a log's 20,000 chunks are 7 MB, its 170,000 keyframes 30 MB.
pub const MANIFEST_BYTES: u64 = 64 << 20;

/// Largest table of contents of one chunk: 16 blocks of 29 levels are 464 rows of 78 bytes.
pub const CHUNK_TABLE_BYTES: usize = 64 << 10;

/// Largest table of a whole twin: a log's 20,000 chunks of 100 sections of 78 bytes are 156 MB.
pub const TABLE_BYTES: u64 = 256 << 20;

/// Share of the Gaussians that may have a value of one field clamped when a twin is stored.
pub const CLAMPED_SHARE: f64 = 1e-4;

/// Largest record of a twin's log. One is about 150 bytes.
pub const LOG_RECORD_BYTES: u64 = 4 << 10;

/// How often a commit is built upon the latest version, as long as somebody else is faster: each time
/// one of those who try succeeds, so that 32 may try at once.
pub const PUBLISH_TRIES: u32 = 32;

/// Largest lease or list of candidates for garbage collection: 20,000 hashes of 85 bytes are 1.7 MB.
pub const NOTE_BYTES: u64 = 16 << 20;

/// Objects that one garbage collection notes; what is beyond is noted by the next. Each takes 67 bytes
/// and a time of at most 20.
pub const GC_CANDIDATES: usize = (NOTE_BYTES / 88) as usize;

/// How long one request to an object store may take: a cell of 300 MB at 5 MB/s.
pub const REMOTE_TIMEOUT: Duration = Duration::from_secs(60);

/// How often such a request is made, at most.
pub const REMOTE_TRIES: u32 = 5;

/// How long to wait before the second try, twice as long before each further one: 0.1 + 0.2 + 0.4 +
/// 0.8 = 1.5 s in all.
pub const REMOTE_BACKOFF: Duration = Duration::from_millis(100);

/// How long one request for a section may take, which steps wait for: 2 MB at 0.4 MB/s.
pub const SECTION_TIMEOUT: Duration = Duration::from_secs(5);

/// How often such a request is made, at most.
pub const SECTION_TRIES: u32 = 3;

// Whoever waits for a section that a store never answers for is told so before the step's time is over:
// 3 attempts of 3 x 5 s + 0.1 s + 0.2 s, and 0.25 s between them, are 46.2 s.
const _: () = {
    let pauses = (1 << (SECTION_TRIES - 1)) - 1;
    let attempt_ms =
        SECTION_TIMEOUT.as_millis() * SECTION_TRIES as u128 + REMOTE_BACKOFF.as_millis() * pauses;
    let between_ms = 5 * LOAD_BACKOFF.as_millis();
    assert!(LOAD_ATTEMPTS as u128 * attempt_ms + between_ms < STEP_TIMEOUT.as_millis());
};

/// How often an object is read whose bytes are not those of its hash: damaged on the way, or there.
pub const SOUND_TRIES: u32 = 3;

/// Threads that wait for an object store's answers.
pub const REMOTE_THREADS: usize = 2;

/// Objects of one commit that are uploaded at once, each held in memory: cells of 10 MB.
pub const UPLOADS_AT_ONCE: usize = 8;

/// What is kept on disk of twins from elsewhere, in GiB, unless told otherwise: half of a log's 32 GB.
pub const CACHE_GIB: u32 = 16;

/// Versions that garbage collection keeps, unless told otherwise: a day of hourly pushes, twice.
pub const GC_KEEP: u32 = 50;

/// How long a version stays in use for garbage collection after its server last said so, ...
pub const LEASE: Duration = Duration::from_secs(900);

/// ... and how often it says so: two may be lost.
pub const LEASE_RENEWAL: Duration = Duration::from_secs(300);

/// How long garbage stays, unless told otherwise: longer than any commit is in preparation.
pub const GC_GRACE: &str = "24h";

/// Largest rig or trajectory file: what fits a manifest.
pub const SETTINGS_FILE_BYTES: u64 = MANIFEST_BYTES;

/// Largest profile file: nine fields of at most 40 B.
pub const PROFILE_FILE_BYTES: u64 = 64 << 10;

/// Most stations of a report: with four offsets and six cameras, 1,536 windows of the reference.
pub const REPORT_STATIONS: i64 = 64;

/// Largest window of a report, in pixels: with the most stations, 100 million pixels of 40 B.
pub const REPORT_WINDOW_PX: i64 = 256;

/// Largest camera list: 300 B per camera, so 50,000 cameras.
pub const CAMERA_LIST_BYTES: u64 = 16 << 20;

/// Largest file of a sky: six faces of 1536 x 1536 pixels of RGB are 42 MB uncompressed. A network's
/// weights are 50 kB.
pub const SKY_FILE_BYTES: u64 = 64 << 20;

/// Memory that decoding a sky's image may take: a cross of such faces is 85 MB, or 170 MB with 16 bits.
pub const SKY_IMAGE_BYTES: u64 = 256 << 20;

/// Memory of all twins in use where the machine does not say how much it has; else they may take
/// three quarters of it. The demo street is 439,000 Gaussians of 92 bytes, 40 MB.
pub const RESIDENT_BYTES: u64 = 16 << 30;

/// Threads that load sections. A core reads and decodes 100 MB/s of records and more, ten times what
/// 30 m/s need; eight keep a remote store's answers of 50 ms coming, and one that hangs stops no other.
pub const LOADERS: usize = 8;

/// How often a section is tried before the frames that wait for it are told.
pub const LOAD_ATTEMPTS: u32 = 3;

/// Pause before the second attempt; the third comes after four times as long, together 0.25 s.
pub const LOAD_BACKOFF: Duration = Duration::from_millis(50);

/// Loads whose times are remembered: 256 give the 99th percentile, and are some seconds of driving.
pub const LOAD_TIMES: usize = 256;

/// How soon a load that waits for room looks again if nobody says that there is some: whoever
/// draws does say.
pub const ROOM_POLL: Duration = Duration::from_secs(1);

/// Sections in the queue beyond which nothing more is prefetched: 40 B each, so 10 MB; a frame of
/// 300 m around is some thousands.
pub const QUEUED_SECTIONS: usize = 1 << 18;

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
pub const STANDING_M: f64 = 0.01;

/// What is loaded ahead of an ego that stands on a recorded drive, in metres: five seconds of a town's
/// speed.
pub const STANDING_AHEAD_M: f64 = 50.0;

/// Steps ahead at most, however much faster than the clock they come.
pub const STEPS_AHEAD: usize = 256;

/// Squares that the search for a twin's worst place looks at. A square cell of 64 m of 20 km of road is
/// one of 320 in a row, and twice as many lie above them.
pub const WORST_PLACES: usize = 4096;

/// Rigs whose worst place in a twin is remembered, so that sessions open at once.
pub const REMEMBERED_LENSES: usize = 16;

/// Most Gaussians of a street of `wildcity bench gpu`: 200 B each while it is made.
pub const BENCH_GAUSSIANS: i64 = 100_000_000;

/// Frames that a GPU has in hand at once: one is drawn, one is encoded, and one is ready to be drawn
/// the moment the first is done. Six JPEGs take longer than a fast GPU takes to draw them. Each
/// holds its images, 27 MB of six full cameras.
pub const GPU_FRAMES: usize = 3;

/// Frames that did not fit a GPU at once, and are known in which parts they do: a few kB, for more
/// rigs than drive at once.
pub const REMEMBERED_CUTS: usize = 64;

/// Smallest limit of a binding that the gpu backend is made to live with: one cluster of SH degree 3
/// takes 34 kB of one.
pub const BINDING_BYTES_MIN: u64 = 64 << 10;

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

/// Bad Gaussians that are named of one file; the others are counted.
pub const BAD_GAUSSIANS: usize = 16;

/// Poses at which a push is compared: 32 small images before, and 32 after.
pub const GOLDEN_POSES: usize = 32;

/// Poses along the twin's trajectory at which a push is compared, unless it names others.
pub const GOLDEN_STATIONS: usize = 4;

/// Longest side of the images that are compared, in pixels.
pub const GOLDEN_SIDE_PX: u32 = 320;

/// Gaussians of a push that is compared: in memory beside it, 92 B each at SH degree 1, 1.8 GB.
pub const GOLDEN_GAUSSIANS: usize = 20_000_000;

/// How long a push may load what its version changes where sessions drive, before it is ready all the
/// same.
pub const PREFETCH_TIMEOUT: Duration = Duration::from_secs(60);

/// How often it is looked whether that is loaded: twenty times a second add nothing to seconds of
/// loading.
pub const PREPARE_POLL: Duration = Duration::from_millis(50);

/// Characters of a push's note.
pub const NOTE_CHARS: usize = 1000;

/// A cell that a push shrinks to less than this share, without naming it, is taken for one that it
/// only touched: stray Gaussians of a neighbour's margin.
pub const SHRUNK_SHARE: f64 = 0.1;

/// Largest file of tokens: 200 B each.
pub const TOKENS_FILE_BYTES: u64 = 1 << 20;

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

/// Most that an action asks for, in m/s²: Alpamayo's, what tyres hold on a dry road.
pub const EGO_ACCELERATION_M_S2: f64 = 9.8;

/// Tightest curvature that an action asks for, in 1/m: Alpamayo's, a turning circle of 10 m.
pub const EGO_CURVATURE_1_M: f64 = 0.2;

/// Largest angle of the front wheels, in radians: the tightest curvature at a crawl, 0.2 of a wheelbase of
/// 2.85 m. A fast car, which understeers, reaches less curvature.
pub const EGO_STEERING_RAD: f64 = EGO_CURVATURE_1_M * 2.85;

/// Fastest forwards, in m/s: 216 km/h.
pub const EGO_SPEED_M_S: f64 = 60.0;

/// Fastest backwards, in m/s: 36 km/h. From 12.8 on, steering would resonate with its lag, and from 28.6
/// on a car that understeers is unstable backwards.
pub const EGO_REVERSE_M_S: f64 = 10.0;

/// Poses of a trajectory that an ego follows: 6.4 s at 10 Hz, what Alpamayo writes.
pub const PATH_POSES: usize = 64;

/// Latest time of such a trajectory, in microseconds: a minute.
pub const PATH_US: i64 = 60_000_000;

/// How often an ego that follows a trajectory is told what to do, in microseconds: ten times within the
/// lag of its steering.
pub const TRACKER_TICK_US: u64 = 10_000;

/// How far a recorded drive tells of the ground, in metres: across a street and its pavements.
pub const GROUND_NEAR_M: f64 = 25.0;

/// The least vertical part of a ground's normal: 45 degrees, steeper than any street.
pub const GROUND_UP: f64 = std::f64::consts::FRAC_1_SQRT_2;

// The longest step has a path that reaches its end.
const _: () = assert!(PATH_US >= DT_MAX_US);
