//! Bodies of HTTP requests and answers: uploads, pushes, versions, sessions.
//!
//! As on the WebSocket, answers may gain fields and unknown fields of requests are mistakes.

use serde::{Deserialize, Serialize};

use super::error::Code;
use super::message::Pose;

/// `POST /v1/uploads`: announces a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct NewUpload {
    /// What the file is called, for reports.
    pub name: String,
    /// Its size, in bytes.
    pub size: u64,
    /// Its digest in hex, as `blake3:...` or `sha-256:...`.
    pub digest: String,
}

/// An upload: what `POST`, `GET` and `PATCH` of uploads answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Upload {
    /// Its id, made of the digest: the same content, the same upload.
    pub id: String,
    /// As announced.
    pub name: String,
    /// As announced, in bytes.
    pub size: u64,
    /// Bytes that have arrived: where to go on.
    pub offset: u64,
    /// Whether all have, and are what the digest promises.
    pub complete: bool,
}

/// `POST /v1/twins/{twin}/pushes`: makes a new version of uploaded files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct NewPush {
    /// Name for the push, so that it can be sent again; made of its content if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// The scenes, which become one.
    pub files: Vec<PushFile>,
    /// The version that it is made from; the latest if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base: Option<u64>,
    /// The 64 m cells that it replaces; those that its Gaussians touch, if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cells: Option<CellSelection>,
    /// In how many bits Gaussians are stored: `f32`, `h52`, `q32` or `q24`; the base's if absent,
    /// and `q32` in a new twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<String>,
    /// Whether levels of detail are made.
    #[serde(default = "yes")]
    pub levels: bool,
    /// How it must be rendered where that is not as the base, as `near=0.2`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub profile: Vec<String>,
    /// For people: what this version is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// Where to compare before and after.
    #[serde(default, rename = "golden")]
    pub preview: PreviewRequest,
}

/// One scene of a push.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PushFile {
    /// Id of its upload.
    pub upload: String,
    /// Which way its axes point: a preset, or nine numbers; as in `wildcity import --axes`.
    #[serde(default = "identity")]
    pub axes: String,
    /// Metres per unit of the file.
    #[serde(default = "one")]
    pub scale: f64,
}

/// Which cells a push replaces.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "schema", schemars(rename = "Cells"))]
pub enum CellSelection {
    /// `"all"`: the whole twin.
    All(AllCells),
    /// These, as (x, y); cell (i, j) is centred on (64 i, 64 j) m. Gaussians elsewhere are left out.
    Listed(Vec<[i32; 2]>),
}

/// The word `all`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "All"))]
pub enum AllCells {
    /// The whole twin.
    All,
}

/// Where a push is compared with what was there.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "schema", schemars(rename = "Golden"))]
pub struct PreviewRequest {
    /// `world_from_rig` each; if absent, a few along the twin's first trajectory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poses: Option<Vec<Pose>>,
    /// Refuses the push if a pose differs by more than this, in dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_psnr_db: Option<f64>,
}

/// A push: what `POST` and `GET` of pushes answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Push {
    /// Its id.
    pub id: String,
    /// The twin.
    pub twin: String,
    /// How far it is.
    pub state: PushState,
    /// How far it is within that state.
    pub progress: Progress,
    /// The version that it made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u64>,
    /// BLAKE3 of that version's manifest, in hex.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version_hash: Option<String>,
    /// What was found in the files, once that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub report: Option<PushReport>,
    /// Why it was refused, or failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<PushError>,
}

/// How far a push is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PushState {
    /// It waits for pushes before it.
    Queued,
    /// Its files are read.
    Ingesting,
    /// They are compared with what is there.
    Validating,
    /// The new version is written; nobody sees it yet.
    Committing,
    /// It is there, and is loaded for those who will ask for it.
    Prefetching,
    /// It is the latest version.
    Ready,
    /// Its content cannot be accepted; nothing changed.
    Refused,
    /// The server could not do it; nothing changed, and it can be sent again.
    Failed,
}

/// A part of a whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Progress {
    /// How much is done.
    pub done: u64,
    /// Of how much.
    pub total: u64,
}

/// Why a push was refused, or failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct PushError {
    /// What went wrong.
    pub code: Code,
    /// For people: what, and how to fix it.
    pub message: String,
    /// The cells at fault, as (x, y), where cells are.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cells: Vec<[i32; 2]>,
}

/// What was found in the files of a push.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct PushReport {
    /// The files, in order.
    pub files: Vec<FileReport>,
    /// Gaussians of all files.
    pub gaussians: u64,
    /// Gaussians outside the cells that were asked for: left out.
    pub left_out: u64,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Smallest and largest, of all Gaussians; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ranges: Option<Ranges>,
    /// The cells that are replaced.
    pub cells: Vec<CellReport>,
    /// How single poses look before and after.
    #[serde(rename = "golden")]
    pub previews: Vec<PsnrPreview>,
}

/// One file of a push.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct FileReport {
    /// Its name.
    pub name: String,
    /// Its Gaussians.
    pub gaussians: u64,
    /// How many of them cannot be used.
    pub bad: u64,
    /// The first of those.
    pub first_bad: Vec<BadGaussian>,
}

/// A Gaussian that cannot be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct BadGaussian {
    /// Which one of its file, from 0.
    pub index: u64,
    /// The field, as the file calls it.
    pub field: String,
    /// Its value.
    pub value: String,
    /// What must hold instead.
    pub must: String,
}

/// Smallest and largest values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ranges {
    /// Centres, smallest and largest (x, y, z), in metres.
    pub mean_m: [[f64; 3]; 2],
    /// Standard deviations along own axes, in metres.
    pub scale_m: [f64; 2],
    /// Opacities.
    pub opacity: [f64; 2],
    /// Lengths of quaternions before they are normalised.
    pub quat_length: [f64; 2],
}

/// A cell that a push replaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct CellReport {
    /// The cell (x, y).
    pub cell: [i32; 2],
    /// Gaussians in the base.
    pub before: u64,
    /// Gaussians in the push.
    pub after: u64,
}

/// One pose, before and after.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(rename = "GoldenReport"))]
pub struct PsnrPreview {
    /// `world_from_rig`.
    pub pose: Pose,
    /// How alike all images of the pose are, in dB; absent where they are equal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
}

/// A version of a twin: an entry of `GET /v1/twins/{twin}/versions`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct VersionInfo {
    /// Its number.
    pub version: u64,
    /// BLAKE3 of its manifest, in hex.
    pub version_hash: String,
    /// When it was committed, in microseconds since 1970.
    pub created_us: i64,
    /// How it came about: `import`, `push` or `rollback`.
    pub kind: String,
    /// Whether who opens the latest version may get it; not while a push still makes it ready.
    #[serde(default = "yes")]
    pub ready: bool,
    /// The version that it was made from: what a push changed, or what a rollback restored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<u64>,
}

/// `POST /v1/twins/{twin}/rollback`: makes an old version the latest again, as a new one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Rollback {
    /// The old version.
    pub version: u64,
}

/// A session: an entry of `GET /v1/sessions`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SessionInfo {
    /// Its name.
    pub session: String,
    /// The twin.
    pub twin: String,
    /// The version that it sees.
    pub version: u64,
    /// Steps done in the episode.
    pub step: u64,
    /// `world_from_rig`.
    pub pose: Pose,
    /// Whether a client is connected to it; else it waits to be resumed.
    pub connected: bool,
}

/// The body of every refusal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Refusal {
    /// What went wrong.
    pub code: Code,
    /// For people: what, and how to fix it.
    pub message: String,
    /// The field at fault, as `files[0].axes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// The cells at fault, as (x, y), where cells are.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cells: Vec<[i32; 2]>,
    /// Where an upload goes on, in bytes, where that is the matter.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<u64>,
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

fn identity() -> String {
    "identity".to_owned()
}
