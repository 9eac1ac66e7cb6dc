//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

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
pub const SIDE_FILE_BYTES: u64 = 16 << 20;

/// Objects that one garbage collection notes; what is beyond is noted by the next. Each takes 67 bytes
/// and a time of at most 20.
pub const GC_CANDIDATES: usize = (SIDE_FILE_BYTES / 88) as usize;

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

/// How often an object is read whose bytes are not those of its hash: damaged on the way, or there.
pub const SOUND_TRIES: u32 = 3;

/// Threads that wait for an object store's answers.
pub const REMOTE_THREADS: usize = 2;

/// Objects of one commit that are uploaded at once, each held in memory: cells of 10 MB.
pub const UPLOADS_AT_ONCE: usize = 8;

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

/// Squares that the search for a twin's worst place looks at. A square cell of 64 m of 20 km of road is
/// one of 320 in a row, and twice as many lie above them.
pub const WORST_CASE_SQUARES: usize = 4096;

/// Rigs whose worst place in a twin is remembered, so that sessions open at once.
pub const REMEMBERED_WORST_CASES: usize = 16;
