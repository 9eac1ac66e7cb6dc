//! Assets of actors: what other vehicles and pedestrians are drawn from.

use serde::{Deserialize, Serialize};

use super::PushFile;

/// `POST /v1/actors`: makes an asset of an actor from uploaded files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct NewActor {
    /// Name of the asset. An asset of another content must not have it.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::message::NAME_PATTERN)))]
    pub name: String,
    /// What the actor is.
    pub class: ActorClass,
    /// The files, which are merged into one scene. Their axes become the actor's: x forward, y
    /// left, z up.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 256)))]
    pub files: Vec<PushFile>,
    /// Number of flat Gaussians that cover the triangles of a mesh; small triangles add more. If
    /// absent, 200,000.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 1_000_000)))]
    pub gaussians: Option<u32>,
    /// Storage format of a Gaussian: `f32`, `h52`, `q32` or `q24`. If absent, `q32`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = "^(f32|h52|q32|q24)$")))]
    pub record: Option<String>,
}

/// The kind of an actor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ActorClass {
    /// A car, van, truck, bus or motorcycle.
    Vehicle,
    /// A person on foot.
    Pedestrian,
    /// A bicycle with its rider.
    Bicycle,
    /// Anything else.
    Object,
}

impl ActorClass {
    /// The name on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vehicle => "vehicle",
            Self::Pedestrian => "pedestrian",
            Self::Bicycle => "bicycle",
            Self::Object => "object",
        }
    }
}

/// The assets of a server: the answer to `GET /v1/actors`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ActorList {
    /// Those that can be read, in order of name and hash.
    pub actors: Vec<ActorAsset>,
    /// The others, in order of hash.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub damaged: Vec<DamagedActor>,
}

/// An asset that differs from what was stored, or cannot be read; or a folder of assets that cannot
/// be listed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct DamagedActor {
    /// Its hash, 64 hex digits; of a folder, the two digits that the hashes of its assets begin
    /// with.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = "^[0-9a-f]{2}([0-9a-f]{62})?$")))]
    pub hash: String,
    /// The name that it states, if that can be read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// What is wrong, for people.
    pub reason: String,
}

/// An asset of an actor: the answer to `POST /v1/actors` and `GET /v1/actors/{actor}`, and an entry
/// of `GET /v1/actors`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ActorAsset {
    /// BLAKE3 of the asset, in hex: its identity.
    pub hash: String,
    /// Its name.
    pub name: String,
    /// What the actor is.
    pub class: ActorClass,
    /// The box around the centres of its Gaussians.
    #[serde(rename = "box")]
    pub box_: ActorBox,
    /// What it was made from. Absent for a token that is limited to some twins, since it may name
    /// others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<ActorProvenance>,
    /// Number of Gaussians at full detail.
    pub gaussians: u64,
    /// Degree of the spherical harmonics.
    pub sh_degree: u8,
    /// Storage format of a Gaussian.
    pub record: String,
    /// Size of the stored asset, in bytes.
    pub bytes: u64,
    /// Its levels of detail, from full detail on.
    pub levels: Vec<ActorLevel>,
}

/// The box of an actor. The origin is on the ground under its middle; x points forward, y to the
/// left, z up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ActorBox {
    /// Extent along x, in metres.
    pub length_m: f64,
    /// Extent along y, in metres.
    pub width_m: f64,
    /// Extent along z, in metres.
    pub height_m: f64,
}

/// What an asset was made from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ActorProvenance {
    /// BLAKE3 of the files, as `blake3:` and hex digits, or the generator, or the twin that it was
    /// cut from.
    pub source: String,
    /// The program that made it.
    pub builder: String,
    /// The options, such as `axes=identity`.
    pub options: Vec<String>,
}

/// One level of detail of an asset.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ActorLevel {
    /// Number of Gaussians.
    pub gaussians: u64,
    /// Upper bound of the geometric error, in metres.
    pub error_m: f32,
    /// Size, in bytes.
    pub bytes: u64,
}
