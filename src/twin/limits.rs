//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Most bytes that are set aside for the images of all sessions: as many as all answers may have
/// together.
pub const IMAGE_BYTES: u64 = 9 << 30;

/// Longest PLY header, in bytes. INRIA's with SH degree 3 has 1.5 kB.
pub const PLY_HEADER_BYTES: usize = 64 << 10;

/// Longest line of the body of a PLY file of text, in bytes. With SH degree 3 a line has about 700.
pub const PLY_LINE_BYTES: u64 = 64 << 10;

/// Longest safetensors header, in bytes. A gsplat checkpoint's has less than 1 kB.
pub const SAFETENSORS_HEADER_BYTES: usize = 1 << 20;

/// Bytes that any compressed scene may unpack to, however small it is: small tests have many equal
/// Gaussians.
pub const UNPACKED_FREE_BYTES: u64 = 16 << 20;

/// Bytes, beyond [`UNPACKED_FREE_BYTES`], that each compressed byte may unpack to. Scenes reach 2
/// to 8; deflate can reach 1032, and zstd more.
pub const UNPACKED_PER_BYTE: u64 = 64;

/// Largest archive, glTF buffer, or image of a scene, in bytes. They are held in memory whole; 100
/// million Gaussians in SOG take 2 GiB.
pub const SCENE_PART_BYTES: u64 = 4 << 30;

/// Largest JSON that describes a scene, in bytes. SOG's meta.json takes 15 kB, its lod-meta.json
/// 200 B per leaf.
pub const SCENE_JSON_BYTES: u64 = 64 << 20;

/// Largest file of the poses of training images, in bytes. COLMAP's images.bin has the points of
/// each image, 24 B each: 10,000 images of 5,000 points are 1.2 GB.
pub const CAPTURE_BYTES: u64 = 4 << 30;

/// The most files of one scene. A streamed SOG has eight per block.
pub const SCENE_PARTS: usize = 100_000;

/// Number of Gaussians that cover the triangles of a mesh; triangles smaller than one Gaussian's
/// share add at most as many again. A lorry with a surface of 60 m² gets one every 17 mm.
pub const MESH_GAUSSIANS: u32 = 200_000;

/// Largest asset of an actor, in bytes: 2 million Gaussians of SH degree 3 in f32 are 472 MB, and
/// the levels of detail as much again.
pub const ACTOR_BYTES: u64 = 1 << 30;

/// Largest header of an asset, in bytes. One has about 2 kB.
pub const ACTOR_HEADER_BYTES: usize = 64 << 10;

/// The most parts that the long triangles of a mesh are halved into. At 232 bytes each they take
/// 100 MB.
pub const MESH_PARTS: usize = 400_000;

/// The most values of a NuRec payload, not counting the content of arrays; each takes 32 bytes of
/// memory. The tracks of a log are 100,000.
pub const NUREC_VALUES: usize = 1 << 20;

/// The most layers of static Gaussians of a NuRec payload. NVIDIA's scenes have fewer than ten.
pub const NUREC_LAYERS: usize = 1024;

/// The most Gaussians of one import, because their order within the twin is stored as u32.
pub const IMPORT_GAUSSIANS: u64 = u32::MAX as u64;

/// Largest manifest, in bytes. The 20,000 chunks of a log are 7 MB, its 170,000 keyframes 30 MB.
pub const MANIFEST_BYTES: u64 = 64 << 20;

/// Cells beyond which one commit must have [`GAUSSIANS_PER_CELL`] in each on average. Each cell is
/// an object of 12 kB at least, so they take 50 MB.
pub const SPARSE_CELLS: usize = 4096;

/// Gaussians in each of many cells, on average. A cell of a street has tens of thousands.
pub const GAUSSIANS_PER_CELL: u64 = 16;

/// Largest table of contents of one chunk, in bytes. 16 blocks of 29 levels are 464 rows of 78
/// bytes, 36 kB.
pub const CHUNK_TABLE_BYTES: usize = 64 << 10;

/// Largest table of a whole twin, in bytes. A log's 20,000 chunks of 100 sections of 78 bytes are
/// 156 MB.
pub const TABLE_BYTES: u64 = 256 << 20;

/// Largest share of the Gaussians that may have their value of one field clamped when a twin is
/// stored.
pub const CLAMPED_SHARE: f64 = 1e-4;

/// Largest recorded image, in bytes: a PNG of 4 K in full noise.
pub const VIEW_IMAGE_BYTES: u64 = 64 << 20;

/// Largest table of recorded images, in bytes: 400,000 images of 500 bytes, 130 km of six cameras
/// every 2 m.
pub const VIEWS_TABLE_BYTES: u64 = 200 << 20;

/// Largest record of a twin's log, in bytes. One has about 150.
pub const LOG_RECORD_BYTES: u64 = 4 << 10;

/// The most attempts to publish a commit when other commits take its number first. Each time, one
/// of the competing commits succeeds, so 32 may compete at once.
pub const PUBLISH_TRIES: u32 = 32;

/// Largest side file (a lease, or the state of garbage collection), in bytes. 20,000 hashes of 85
/// bytes are 1.7 MB.
pub const SIDE_FILE_BYTES: u64 = 16 << 20;

/// The most objects that one garbage collection notes as candidates; the next run notes more. Each
/// takes 67 bytes, and up to 20 for the time.
pub const GC_CANDIDATES: usize = (SIDE_FILE_BYTES / 88) as usize;

/// Time-out of one request to an object store: a cell of 300 MB at 5 MB/s.
pub const REMOTE_TIMEOUT: Duration = Duration::from_secs(60);

/// The most attempts of such a request.
pub const REMOTE_TRIES: u32 = 5;

/// Pause before the second attempt; it doubles before each further one: 0.1 + 0.2 + 0.4 + 0.8 = 1.5
/// s in all.
pub const REMOTE_BACKOFF: Duration = Duration::from_millis(100);

/// Time-out of one request for a section, which steps wait for: 2 MB at 0.4 MB/s.
pub const SECTION_TIMEOUT: Duration = Duration::from_secs(5);

/// The most attempts of such a request.
pub const SECTION_TRIES: u32 = 3;

/// The most attempts to read an object if its bytes do not have its hash: damaged in transit, or in
/// the store.
pub const VERIFIED_READ_TRIES: u32 = 3;

/// Number of threads that wait for an object store's answers.
pub const REMOTE_THREADS: usize = 2;

/// Number of objects of one commit that are uploaded at once. Each is held in memory; a cell has 10
/// MB.
pub const UPLOADS_AT_ONCE: usize = 8;

/// Largest camera list, in bytes: 50,000 cameras of 300 B.
pub const CAMERA_LIST_BYTES: u64 = 16 << 20;

/// Largest file of a sky, in bytes. Six faces of 1536 x 1536 pixels of RGB are 42 MB uncompressed;
/// the weights of a network are 50 kB.
pub const SKY_FILE_BYTES: u64 = 64 << 20;

/// Memory that decoding a sky's image may take, in bytes. A cross of such faces is 85 MB, or 170 MB
/// with 16 bits.
pub const SKY_IMAGE_BYTES: u64 = 256 << 20;

/// Memory that all open twins may take if the size of the machine's memory is unknown, in bytes;
/// otherwise they may take three quarters of it. The demo street has 426,000 Gaussians of 92 bytes,
/// 40 MB.
pub const RESIDENT_BYTES: u64 = 16 << 30;

/// Number of threads that load sections. A core reads and decodes at least 100 MB/s of records, ten
/// times what driving at 30 m/s needs. Eight threads hide a remote store's latency of 50 ms, and
/// one that hangs does not stop the others.
pub const LOADERS: usize = 8;

/// Memory of evicted sections that is kept for the next ones. A load evicts just before it reads,
/// so that what is kept and what is in memory were in memory together before, within the limit. The
/// largest section of a dense capture has 140 MB; what is given back to the heap instead stays with
/// the threads that took it.
pub const FREE_PAGES_BYTES: usize = 256 << 20;

/// Number of attempts to load a section before the frames that wait for it get the error.
pub const LOAD_ATTEMPTS: u32 = 3;

/// Pause before the second attempt; it is four times as long before the third, 0.25 s in all.
pub const LOAD_BACKOFF: Duration = Duration::from_millis(50);

/// Number of load durations that are remembered: 256 are enough for the 99th percentile, and are
/// some seconds of driving.
pub const LOAD_TIMES: usize = 256;

/// Interval at which a load that waits for free memory checks again without a notification. The
/// end of a frame does notify.
pub const ROOM_POLL: Duration = Duration::from_secs(1);

/// Length of the queue beyond which nothing more is prefetched: at 40 B each, 10 MB. A frame with a
/// reach of 300 m has some thousands of sections.
pub const QUEUED_SECTIONS: usize = 1 << 18;

/// Bytes, as stored, of the sections that are read at once; a larger one is read alone. They are
/// in memory until they are decoded, beyond the limit of memory: those of a dense capture have 50
/// MB and more, those of a street 100 kB.
pub const READING_BYTES: u64 = 16 << 20;

/// How long a section waits for others that are being read: longer than 140 MB take from an object
/// store of 20 MB/s.
pub const READING_WAIT: Duration = Duration::from_secs(10);

/// How often a section that waits for others asks whether it is still wanted.
pub const READING_POLL: Duration = Duration::from_millis(50);

/// Most areas that the search for a twin's worst frame halves. It is within the cells of 64 m: 20
/// km of road have 320 of them in a row.
pub const WORST_CASE_AREAS: usize = 4096;

/// Number of worst frames, by rig and profile, that are remembered of a twin, so that further
/// sessions open without the search.
pub const REMEMBERED_WORST_CASES: usize = 16;
