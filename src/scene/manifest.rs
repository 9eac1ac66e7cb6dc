//! The manifest: everything one version of a twin consists of.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::geometry::Bounds;

use super::{RecordFormat, RenderProfile, Rig, Trajectory};

/// One immutable version of a twin. Its canonical JSON bytes are its identity (BLAKE3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this layout.
    pub format: u32,
    /// The twin's name, `[a-z0-9._-]+`.
    pub twin: String,
    /// How it must be rendered.
    pub profile: RenderProfile,
    /// Spherical-harmonic degree of every chunk.
    pub sh_degree: u8,
    /// How Gaussians are stored.
    pub record: RecordFormat,
    /// The object that holds [`ChunkEntry::sections`] of all chunks.
    pub table: ObjectRef,
    /// The chunks in order of (cell y, cell x): the order of global ids.
    pub chunks: Vec<ChunkEntry>,
    /// The vehicle that recorded it, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    /// RoundTrip drives.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trajectories: Vec<Trajectory>,
    /// What is behind everything, if it has a sky.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sky: Option<SkyRef>,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// One chunk of the table: a 64 m cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChunkEntry {
    /// Grid cell (x, y); cell (i, j) is centred on (64 i, 64 j) m.
    pub cell: [i32; 2],
    /// BLAKE3 of the object that holds it, 64 lower-case hex digits.
    pub object: String,
    /// Gaussians in it at full detail.
    pub count: u64,
    /// Size of the object, in bytes.
    pub bytes: u64,
    /// Box of the Gaussians' 3-sigma boxes, in metres.
    pub bounds: Bounds,
    /// Where the chunk's zero lies in the world, in metres.
    pub origin_m: DVec3,
    /// What the object consists of, in order of (block, level). A route of 20 km has 100,000 of them
    /// and more: they travel in [`Manifest::table`], 78 bytes each, not in the manifest's JSON.
    #[serde(skip)]
    pub sections: Vec<Section>,
}

/// One level of detail of one 16 m block of a cell: what is read, decoded and drawn as one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// The block within the cell: 4 y + x, from the south-west.
    pub block: u8,
    /// Level of detail: 0 is everything, higher ones are coarser.
    pub level: u8,
    /// Gaussians in it.
    pub count: u32,
    /// How far anything was moved or cut short, at most, in metres; rising with the level.
    pub error_m: f32,
    /// Smallest corner of the 3-sigma boxes relative to the chunk's origin, in metres.
    pub min_m: [f32; 3],
    /// Largest corner of the 3-sigma boxes relative to the chunk's origin, in metres.
    pub max_m: [f32; 3],
    /// Where it lies in the object, in bytes from the start.
    pub offset_bytes: u64,
    /// How long it is there, in bytes.
    pub bytes: u32,
    /// BLAKE3 of those bytes.
    pub hash: [u8; 32],
}

/// An object of the store.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRef {
    /// Its BLAKE3, 64 lower-case hex digits.
    pub object: String,
    /// Its size, in bytes.
    pub bytes: u64,
}

/// The sky of a twin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SkyRef {
    /// BLAKE3 of the object that holds it, 64 lower-case hex digits.
    pub object: String,
    /// Its size, in bytes.
    pub bytes: u64,
    /// Index of the image whose appearance it is seen with; the mean of all if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<u32>,
    /// Rows of the matrix that takes directions in the world to the sky's own axes; orthonormal.
    pub sky_from_world: [[f64; 3]; 3],
}

/// Where a version comes from. No clock in it: the same import gives the same identity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// BLAKE3 of the source file, or the generator's name and settings.
    pub source: String,
    /// What built it, as `wildcity 0.1.0`.
    pub builder: String,
    /// Options of the import in the order given, as `axes=y-down-z-forward`.
    pub options: Vec<String>,
}

impl Provenance {
    /// Something that this build makes of a source, without options.
    pub fn of(source: String) -> Self {
        let builder = concat!("wildcity ", env!("CARGO_PKG_VERSION")).to_owned();
        Self { source, builder, options: Vec::new() }
    }
}

impl Manifest {
    /// The layout that this build writes.
    pub const FORMAT: u32 = 1;

    /// Gaussians in all chunks at full detail.
    pub fn gaussians(&self) -> u64 {
        self.chunks.iter().map(|chunk| chunk.count).sum()
    }

    /// Bytes of all objects but the manifest itself.
    pub fn stored_bytes(&self) -> u64 {
        let sky = self.sky.as_ref().map_or(0, |sky| sky.bytes);
        self.table.bytes + sky + self.chunks.iter().map(|chunk| chunk.bytes).sum::<u64>()
    }

    /// Box of everything; empty without chunks.
    pub fn bounds(&self) -> Bounds {
        self.chunks.iter().fold(Bounds::EMPTY, |all, chunk| all.union(&chunk.bounds))
    }
}

impl ChunkEntry {
    /// A section's box of 3-sigma boxes in the world, in metres.
    pub fn section_bounds(&self, section: &Section) -> Bounds {
        let world_m = |corner: [f32; 3]| self.origin_m + DVec3::from_array(corner.map(f64::from));
        Bounds { min_m: world_m(section.min_m), max_m: world_m(section.max_m) }
    }
}
