//! Bodies of HTTP requests and answers: uploads, pushes, assets of actors, versions, sessions.
//!
//! As on the WebSocket, unknown fields of requests are refused, and answers may gain fields.

mod actor;

use serde::{Deserialize, Serialize};

use crate::error::Code;
use crate::message::{Pose, TwinInfo};

pub use actor::{
    ActorAsset, ActorBox, ActorClass, ActorLevel, ActorList, ActorProvenance, DamagedActor,
    NewActor,
};

/// `POST /v1/uploads`: announces a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct NewUpload {
    /// Name of the file, for reports.
    #[cfg_attr(
        feature = "schema",
        schemars(regex(pattern = r"^[^/\\\x00-\x1F\x7F-\x9F]{1,255}$"))
    )]
    pub name: String,
    /// Size of the file, in bytes.
    pub size: u64,
    /// Digest of the file, as `blake3:` or `sha-256:` followed by 64 hex digits.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = "^(blake3|sha-256):[0-9a-f]{64}$")))]
    pub digest: String,
}

/// State of an upload: the answer to `POST`, `GET` and `PATCH` of uploads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Upload {
    /// Id of the upload. It is made from the digest, so the same content is the same upload.
    pub id: String,
    /// Name, as announced.
    pub name: String,
    /// Size, as announced, in bytes.
    pub size: u64,
    /// Number of bytes received: the offset at which the upload continues.
    pub offset: u64,
    /// Whether all bytes were received and match the digest.
    pub complete: bool,
}

/// `POST /v1/twins/{twin}/pushes`: makes a new version of a twin from uploaded files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct NewPush {
    /// Id of the push, so that it can be sent again safely. If absent, it is made from the content.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::message::NAME_PATTERN)))]
    pub id: Option<String>,
    /// The scene files, which are merged into one scene.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 256)))]
    pub files: Vec<PushFile>,
    /// The frame of the files, after their axes and scale, and of `golden.poses`. If absent, that
    /// of the twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<PushFrame>,
    /// The version that the push is based on. If absent, the latest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base: Option<u64>,
    /// The 64 m cells to replace. If absent, those that contain Gaussians of the push.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cells: Option<CellSelection>,
    /// Storage format of a Gaussian: `f32`, `h52`, `q32` or `q24`. If absent, that of the base
    /// version; `q32` in a new twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = "^(f32|h52|q32|q24)$")))]
    pub record: Option<String>,
    /// Whether to build levels of detail.
    #[serde(default = "yes")]
    pub levels: bool,
    /// Changes of the render profile from the base version's, for example `near=0.2`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schemars(inner(regex(pattern = "^[a-z_]+=.+$"))))]
    pub profile: Vec<String>,
    /// A description of the version, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(length(max = 1_000)))]
    pub note: Option<String>,
    /// Where to compare the images before and after the push.
    #[serde(default, rename = "golden")]
    pub preview: PreviewRequest,
    /// Whether invalid Gaussians are left out. Otherwise the push is refused if there are any.
    #[serde(default, skip_serializing_if = "is_false")]
    pub drop_bad: bool,
}

/// The axes of a file: a preset, or nine numbers.
#[cfg(feature = "schema")]
const AXES_PATTERN: &str = "^(identity|y-down-z-forward|y-up-z-back|y-up-z-forward|\
    -?[0-9]+([.][0-9]+)?([ ,]-?[0-9]+([.][0-9]+)?){8})$";

/// One scene file of a push, or of an actor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PushFile {
    /// Id of the upload.
    pub upload: String,
    /// Axis convention of the file: a preset or nine numbers, as in `wildcity import --axes`. If
    /// absent, that which the file records; else, in a push, that with which the twin was imported;
    /// else `identity`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = AXES_PATTERN)))]
    pub axes: Option<String>,
    /// Metres per unit of the file. If absent, in a push, that with which the twin was imported;
    /// else 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(extend("exclusiveMinimum" = 0)))]
    pub scale: Option<f64>,
    /// The name by which other files of the request name this one, such as `textures/paint.png`. If
    /// absent, that of the upload.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 1_024)))]
    pub name: Option<String>,
}

/// The frame of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PushFrame {
    /// The axes and metres of the base version.
    Twin,
    /// The axes and the unit with which the capture was imported, before the twin was aligned.
    /// Those of the twin if it never was.
    Capture,
}

/// The cells that a push replaces.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "schema", schemars(rename = "Cells"))]
pub enum CellSelection {
    /// `"all"`: every cell of the twin.
    All(AllCells),
    /// A list of cells (x, y). Cell (i, j) is centred on (64 i, 64 j) m. Gaussians in other cells
    /// are left out.
    Listed(#[cfg_attr(feature = "schema", schemars(length(min = 1)))] Vec<[i32; 2]>),
}

/// The string `all`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "All"))]
pub enum AllCells {
    /// Every cell of the twin.
    All,
}

/// Where a push is compared with its base version: images of both are rendered from some poses, and
/// their PSNR is reported.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "schema", schemars(rename = "Golden"))]
pub struct PreviewRequest {
    /// Poses of the rig, `world_from_rig`. If absent, four along the twin's trajectories. The
    /// report leaves out poses from which no Gaussian is seen.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(length(max = 32)))]
    pub poses: Option<Vec<Pose>>,
    /// Refuse the push if the PSNR at any pose is below this, in dB, or no pose sees a Gaussian.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_psnr_db: Option<f64>,
}

/// State of a push: the answer to `POST` and `GET` of pushes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Push {
    /// Id of the push.
    pub id: String,
    /// Name of the twin.
    pub twin: String,
    /// The stage that the push has reached.
    pub state: PushState,
    /// Progress within that stage.
    pub progress: Progress,
    /// Number of the new version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u64>,
    /// BLAKE3 of the version's manifest, in hex.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version_hash: Option<String>,
    /// What the server found in the files, once it has read them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub report: Option<PushReport>,
    /// Why the push was refused or failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<PushError>,
}

/// Stage of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PushState {
    /// It waits for earlier pushes.
    Queued,
    /// Its files are read.
    Ingesting,
    /// They are checked, and compared with the base version.
    Validating,
    /// The new version is written. No session sees it yet.
    Committing,
    /// The version exists, and is loaded into memory for the sessions that will open it.
    Prefetching,
    /// It is the latest version.
    Ready,
    /// Its content was refused. Nothing changed.
    Refused,
    /// The server failed. Nothing changed, unless the error's message says otherwise, and the push
    /// can be sent again.
    Failed,
}

/// Progress within a stage; what is counted depends on the stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Progress {
    /// Number of items done.
    pub done: u64,
    /// Number of items in total.
    pub total: u64,
}

/// Why a push was refused or failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct PushError {
    /// Error code.
    pub code: Code,
    /// What went wrong and how to fix it, for people.
    pub message: String,
    /// The cells (x, y) at fault, if the error concerns cells.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cells: Vec<[i32; 2]>,
}

/// What the server found in the files of a push.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct PushReport {
    /// The files, in the order of the request.
    pub files: Vec<FileReport>,
    /// Number of Gaussians in all files.
    pub gaussians: u64,
    /// Number of Gaussians left out because they are outside the requested cells.
    pub left_out: u64,
    /// Degree of the spherical harmonics.
    pub sh_degree: u8,
    /// The frame that the files were taken to be in. Older servers do not say it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<PushFrame>,
    /// Whether the base version was aligned: the frame of the capture is then another one than that
    /// of the twin.
    #[serde(default)]
    pub aligned: bool,
    /// Smallest and largest values over all Gaussians. Absent if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ranges: Option<Ranges>,
    /// The replaced cells.
    pub cells: Vec<CellReport>,
    /// Comparison of the images before and after the push, pose by pose.
    #[serde(rename = "golden")]
    pub previews: Vec<PsnrPreview>,
}

/// What the server found in one file of a push.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct FileReport {
    /// Name of the file.
    pub name: String,
    /// Number of Gaussians.
    pub gaussians: u64,
    /// Number of invalid Gaussians.
    pub bad: u64,
    /// The first of the invalid Gaussians.
    pub first_bad: Vec<BadGaussian>,
    /// Number of invalid Gaussians that were left out.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub dropped: u64,
    /// What of the file was not read, or is drawn in another way than it says; for people.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// What was taken where the request gives nothing, such as the axes of the twin; for people.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub assumed: Vec<String>,
}

/// An invalid Gaussian.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct BadGaussian {
    /// Index in the file, from 0.
    pub index: u64,
    /// Name of the invalid field in the file.
    pub field: String,
    /// Value of the field.
    pub value: String,
    /// The condition that the value must meet.
    pub must: String,
}

/// Smallest and largest values of the Gaussians' fields.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ranges {
    /// Smallest and largest (x, y, z) of the centres, in metres.
    pub mean_m: [[f64; 3]; 2],
    /// Standard deviations along the Gaussians' own axes, in metres.
    pub scale_m: [f64; 2],
    /// Opacities.
    pub opacity: [f64; 2],
    /// Lengths of the quaternions before normalisation.
    pub quat_length: [f64; 2],
}

/// A cell that a push replaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct CellReport {
    /// The cell (x, y).
    pub cell: [i32; 2],
    /// Number of Gaussians in the base version.
    pub before: u64,
    /// Number of Gaussians in the push.
    pub after: u64,
}

/// Comparison of the images before and after the push at one pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(rename = "GoldenReport"))]
pub struct PsnrPreview {
    /// `world_from_rig`.
    pub pose: Pose,
    /// PSNR over all images of the pose, in dB. Absent if the images are equal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
}

/// The twins of a server that a token may use: the answer to `GET /v1/twins`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct TwinList {
    /// Those that can be opened, in order of name.
    pub twins: Vec<TwinInfo>,
    /// The others, in order of name.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub damaged: Vec<DamagedTwin>,
}

/// A twin whose latest version cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct DamagedTwin {
    /// Its name.
    pub name: String,
    /// What is wrong, for people.
    pub reason: String,
}

/// A version of a twin: an entry of `GET /v1/twins/{twin}/versions`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct VersionInfo {
    /// Number of the version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// Time of the commit, in microseconds since 1970-01-01 UTC.
    pub created_us: i64,
    /// What made the version: `import`, `edit`, `push` or `rollback`.
    pub kind: String,
    /// Whether sessions that open the latest version can get this one. False while a push is still
    /// preparing it.
    #[serde(default = "yes")]
    pub ready: bool,
    /// The version that this one was made from: the base of a push, or the version that a rollback
    /// restored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<u64>,
}

/// A version that was just made: the answer to `POST` of rollbacks and edits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct MadeVersion {
    /// Number of the version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
}

/// Where a twin is, and its ground: the answer to `GET /v1/twins/{twin}/ground`. All points are in
/// the axes and the unit of the version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ground {
    /// Number of the version.
    pub version: u64,
    /// The middle of a ball that has most of the scene.
    pub middle: [f64; 3],
    /// The radius of the ball.
    pub radius: f64,
    /// The ground that the scene seems to stand on, as an edit takes it; null if none was found.
    pub ground: Option<EditGround>,
}

/// `POST /v1/twins/{twin}/rollback`: makes an old version the latest again, as a new version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Rollback {
    /// Number of the old version.
    pub version: u64,
}

/// `POST /v1/twins/{twin}/edits`: makes a new version with the same Gaussians on level ground, in
/// metres, with a drive and a rig. All points are in the axes and the unit of the base version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(extend("anyOf" = [
    { "required": ["ground"] }, { "required": ["scale"] }, { "required": ["drive"] }, { "required": ["rig"] }
])))]
#[serde(deny_unknown_fields)]
pub struct NewEdit {
    /// The version that is edited. If absent, the latest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base: Option<u64>,
    /// The ground: it becomes z = 0. If absent, the axes stay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ground: Option<EditGround>,
    /// A known distance, which makes the unit a metre. If absent, the unit stays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<EditScale>,
    /// A drive through points. If absent, there is no new one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drive: Option<EditDrive>,
    /// Name of a preset that becomes the twin's rig. If absent, the rig stays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<String>,
}

/// The ground of a twin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct EditGround {
    /// Three points of it, not on one line.
    pub points: [[f64; 3]; 3],
    /// A point above it.
    pub above: [f64; 3],
}

/// A known distance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct EditScale {
    /// Two points.
    pub points: [[f64; 3]; 2],
    /// Their distance, in metres.
    #[cfg_attr(feature = "schema", schemars(extend("exclusiveMinimum" = 0)))]
    pub distance_m: f64,
}

/// A drive through points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct EditDrive {
    /// Its name. A drive of this name is replaced.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::message::NAME_PATTERN)))]
    pub name: String,
    /// The points, on the ground.
    #[cfg_attr(feature = "schema", schemars(length(min = 2, max = 1_000)))]
    pub points: Vec<[f64; 3]>,
    /// Its speed, in m/s.
    #[serde(default = "five")]
    #[cfg_attr(feature = "schema", schemars(extend("exclusiveMinimum" = 0)))]
    pub speed: f64,
}

/// A session: an entry of `GET /v1/sessions`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SessionInfo {
    /// Name of the file.
    pub session: String,
    /// Name of the twin.
    pub twin: String,
    /// The version that the session shows.
    pub version: u64,
    /// Steps done in the episode.
    pub step: u64,
    /// `world_from_rig`.
    pub pose: Pose,
    /// Whether a client is connected. If not, the session waits to be resumed.
    pub connected: bool,
}

/// Body of the answer to a refused request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Refusal {
    /// Error code.
    pub code: Code,
    /// What went wrong and how to fix it, for people.
    pub message: String,
    /// The field at fault, for example `files[0].axes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// The cells (x, y) at fault, if the error concerns cells.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cells: Vec<[i32; 2]>,
    /// The offset at which the upload continues, in bytes, if the request had another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<u64>,
}

fn yes() -> bool {
    true
}

fn five() -> f64 {
    5.0
}

fn is_false(value: &bool) -> bool {
    !value
}

fn is_zero(value: &u64) -> bool {
    *value == 0
}

/// `POST /v1/tickets`: stands for the request's token in the address of one WebSocket, as
/// `?ticket=`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ticket {
    /// The ticket.
    pub ticket: String,
    /// How long it can be used, in milliseconds.
    pub expires_ms: u64,
}

/// A recorded episode: an entry of `GET /v1/episodes`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct EpisodeInfo {
    /// Name of the episode.
    pub episode: String,
    /// Name of the twin.
    pub twin: String,
    /// The version that it began with.
    pub version: u64,
    /// Steps done.
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Size of the record, in bytes.
    pub bytes: u64,
    /// Size of the MCAP file of the record, in bytes; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mcap_bytes: Option<u64>,
    /// Why there is no MCAP file, if its export failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mcap_error: Option<String>,
    /// When the record was last written, in microseconds since 1970.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub modified_us: Option<u64>,
    /// Name of the scenario, if there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenario: Option<String>,
    /// Why it ended; absent while it is driven, and if the server was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outcome: Option<String>,
    /// The judgement of the drive, if it had a scenario.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<String>,
}
