//! The manifest: everything one version of a twin consists of.

use serde::{Deserialize, Serialize};

use crate::geometry::Bounds;

use super::{RenderProfile, Rig, Trajectory};

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
    /// The chunks in order of (cell y, cell x): the order of global ids.
    pub chunks: Vec<ChunkEntry>,
    /// The vehicle that recorded it, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    /// Recorded drives.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trajectories: Vec<Trajectory>,
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
    /// Gaussians in it.
    pub count: u64,
    /// Size of the object, in bytes.
    pub bytes: u64,
    /// Box of the Gaussians' 3-sigma boxes, in metres.
    pub bounds: Bounds,
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

impl Manifest {
    /// The layout that this build writes.
    pub const FORMAT: u32 = 0;

    /// Gaussians in all chunks.
    pub fn gaussians(&self) -> u64 {
        self.chunks.iter().map(|chunk| chunk.count).sum()
    }

    /// Box of everything; empty without chunks.
    pub fn bounds(&self) -> Bounds {
        self.chunks.iter().fold(Bounds::EMPTY, |all, chunk| all.union(&chunk.bounds))
    }
}
