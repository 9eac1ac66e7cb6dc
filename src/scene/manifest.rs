//! The manifest: lists everything that one version of a twin consists of.
//!
//! The *table* of sections is an object of its own: at 78 bytes a section, 100,000 sections would
//! be 25 MB as JSON in the manifest. Each object repeats its own part of the table, so that it can
//! be read without the manifest; `verify` compares the two.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::align::{Alignment, AlignmentError};
use crate::geo::GeoAnchor;
use crate::geometry::Bounds;

use super::{Chunk, RecordFormat, RenderProfile, Rig, Trajectory};

/// One immutable version of a twin. Its identity is the BLAKE3 hash of its canonical JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of the manifest's layout: [`Manifest::FORMAT`].
    pub format: u32,
    /// The twin's name, `[a-z0-9._-]+`.
    pub twin: String,
    /// How the twin is rendered unless a session overrides it.
    pub profile: RenderProfile,
    /// Spherical-harmonic degree of every chunk.
    pub sh_degree: u8,
    /// How Gaussians are encoded in the objects.
    pub record: RecordFormat,
    /// The object that holds the [`ChunkEntry::sections`] of all chunks.
    pub table: ObjectRef,
    /// The cells in order of (cell y, cell x): the order of global ids.
    pub chunks: Vec<ChunkEntry>,
    /// The rig of the vehicle that recorded the twin, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trajectories: Vec<Trajectory>,
    /// The twin's sky, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sky: Option<SkyRef>,
    /// Recorded images of the drives, if the twin has some.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub views: Option<ViewsRef>,
    /// The place of the world on the earth, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub geo: Option<GeoAnchor>,
    /// From the axes and the unit with which the capture was imported to the twin's: all alignments
    /// since then as one. None if the twin was never aligned; older versions have it only in their
    /// provenance ([`Manifest::alignment`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub twin_from_capture: Option<Alignment>,
    /// The source of the version.
    pub provenance: Provenance,
}

/// One entry of the manifest's chunks: a 64 m cell and the object that stores it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChunkEntry {
    /// Grid cell (x, y); cell (i, j) is centred on (64 i, 64 j) m.
    pub cell: [i32; 2],
    /// BLAKE3 of the object that holds the cell, 64 lower-case hex digits.
    pub object: String,
    /// Gaussians in the cell at full detail.
    pub count: u64,
    /// Size of the object, in bytes.
    pub bytes: u64,
    /// Union of the Gaussians' 3-sigma boxes in the world, in metres.
    pub bounds: Bounds,
    /// Origin of the cell in the world, in metres: means in the object are relative to it.
    pub origin_m: DVec3,
    /// Whether its Gaussians have classes. Not written if they have none, so that a twin without
    /// classes has the same bytes, and the same hash, as before there were any.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub classes: bool,
    /// The sections of the object, in order of (block, level). A route of 20 km has 100,000 and
    /// more, so they are stored in [`Manifest::table`], 78 bytes each, and not in the manifest's
    /// JSON.
    #[serde(skip)]
    pub sections: Vec<Section>,
}

/// One level of detail of one 16 m block of a cell: the unit that is read, decoded and drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// The block within the cell: 4 y + x, counted from the south-west corner.
    pub block: u8,
    /// Level of detail: 0 is full detail, higher levels are coarser.
    pub level: u8,
    pub count: u32,
    /// Upper bound of the geometric error, in metres ([`crate::lod::Level::error_m`]). It rises
    /// with the level.
    pub error_m: f32,
    /// Smallest corner of the 3-sigma boxes relative to the chunk's origin, in metres.
    pub min_m: [f32; 3],
    /// Largest corner of the 3-sigma boxes relative to the chunk's origin, in metres.
    pub max_m: [f32; 3],
    /// Offset in the object, in bytes.
    pub offset_bytes: u64,
    /// Length in the object, in bytes.
    pub bytes: u32,
    /// BLAKE3 of these bytes of the object.
    pub hash: [u8; 32],
}

/// A reference to an object of the store.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRef {
    /// BLAKE3 of the object, 64 lower-case hex digits.
    pub object: String,
    /// Size of the object, in bytes.
    pub bytes: u64,
}

/// The sky of a twin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SkyRef {
    /// BLAKE3 of the object that holds the sky, 64 lower-case hex digits.
    pub object: String,
    /// Size of the object, in bytes.
    pub bytes: u64,
    /// Index of the training image whose appearance embedding is used; the mean of all if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<u32>,
    /// Rows of the orthonormal matrix that takes directions in world axes to the sky's axes.
    pub sky_from_world: [[f64; 3]; 3],
}

/// The recorded images of a version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewsRef {
    /// BLAKE3 of the object with the table, 64 lower-case hex digits.
    pub object: String,
    /// Size of the table, in bytes.
    pub bytes: u64,
    pub images: u64,
    /// Their total size, in bytes.
    pub image_bytes: u64,
}

/// The source of a version. It holds no time, so that the same import gives the same identity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// BLAKE3 of the source file, or the generator's name and settings.
    pub source: String,
    /// The program that built the version, such as `wildcity 0.1.0`.
    pub builder: String,
    /// Options of the import in the order given, such as `axes=y-down-z-forward`.
    pub options: Vec<String>,
}

/// Start of the option with the note of a push.
const NOTE: &str = "note=";

impl Provenance {
    /// The provenance of an import of `source` by this build, without options.
    pub fn new(source: String) -> Self {
        let builder = concat!("wildcity ", env!("CARGO_PKG_VERSION")).to_owned();
        Self { source, builder, options: Vec::new() }
    }

    /// The provenance of a version that is edited from one with this provenance. The note described
    /// the push, not the edit.
    pub fn for_edit(&self) -> Self {
        let mut edited = self.clone();
        // The version that follows is not the push that the note describes.
        edited.options.retain(|option| !option.starts_with(NOTE));
        edited
    }

    /// Adds the description of the push that it comes from.
    pub fn set_note(&mut self, note: &str) {
        self.options.push(format!("{NOTE}{note}"));
    }

    /// The description of the push that it comes from, if the push had one.
    pub fn note(&self) -> Option<&str> {
        self.options.iter().find_map(|option| option.strip_prefix(NOTE))
    }
}

impl Manifest {
    /// The layout version that this build writes.
    pub const FORMAT: u32 = 1;

    /// From the axes and the unit with which the capture was imported to the twin's, if the twin
    /// was aligned since.
    ///
    /// A version without [`Manifest::twin_from_capture`] was never aligned, or by a program that
    /// wrote alignments only as options `align=` of the provenance. A push of such a program
    /// removed them: its version records no alignment.
    ///
    /// # Errors
    /// An option of the provenance cannot be read, or all of them together are more than an
    /// [`Alignment`] may be.
    pub fn alignment(&self) -> Result<Option<Alignment>, AlignmentError> {
        // The field has all alignments as one; options are read only where it is missing.
        if self.twin_from_capture.is_some() {
            return Ok(self.twin_from_capture);
        }
        let mut options = self.provenance.options.iter().filter_map(|o| o.strip_prefix("align="));
        // In the order of the options, which is that of the alignments: each next one is applied
        // after all before it.
        let all = options.try_fold(None, |first: Option<Alignment>, text| {
            let next: Alignment = text.parse()?;
            Ok(Some(first.map_or(next, |first| next.after(&first))))
        })?;
        // A product of valid alignments can leave the range.
        all.map(|all| all.check().map(|()| all)).transpose()
    }

    /// Number of Gaussians in all chunks at full detail.
    pub fn gaussians(&self) -> u64 {
        self.chunks.iter().map(|chunk| chunk.count).sum()
    }

    /// Whether any of its Gaussians have classes.
    pub fn has_classes(&self) -> bool {
        self.chunks.iter().any(|chunk| chunk.classes)
    }

    /// Whether any section is coarser than full detail.
    pub fn has_levels(&self) -> bool {
        let mut sections = self.chunks.iter().flat_map(|chunk| &chunk.sections);
        sections.any(|section| !section.is_full_detail())
    }

    /// Size of all objects without the manifest itself, in bytes.
    pub fn stored_bytes(&self) -> u64 {
        let sky = self.sky.as_ref().map_or(0, |sky| sky.bytes);
        // The table of the views, and the images that it lists.
        let views = self.views.as_ref().map_or(0, |views| views.bytes + views.image_bytes);
        self.table.bytes + sky + views + self.chunks.iter().map(|chunk| chunk.bytes).sum::<u64>()
    }

    /// Union of the bounds of all chunks, in world metres; empty without chunks.
    pub fn bounds(&self) -> Bounds {
        self.chunks.iter().fold(Bounds::EMPTY, |all, chunk| all.union(&chunk.bounds))
    }
}

impl Section {
    /// Whether it is at level 0, the finest.
    pub fn is_full_detail(&self) -> bool {
        self.level == 0
    }
}

impl ChunkEntry {
    /// The sections at full detail: one of each block, which together have all Gaussians of the
    /// cell.
    pub fn full_detail(&self) -> impl Iterator<Item = &Section> {
        self.sections.iter().filter(|section| section.is_full_detail())
    }

    /// Memory that a section needs, in bytes, given the SH degree of the twin.
    pub fn needed_bytes(&self, sh_degree: u8, section: &Section) -> u64 {
        let count = u64::from(section.count);
        Chunk::needed_bytes(sh_degree, count) + if self.classes { count } else { 0 }
    }

    /// Union of a section's 3-sigma boxes in the world, in metres.
    pub fn section_bounds(&self, section: &Section) -> Bounds {
        // Corners are stored in f32 relative to the cell, so that they keep their precision far
        // from the world's origin.
        let world_m = |corner: [f32; 3]| self.origin_m + DVec3::from_array(corner.map(f64::from));
        Bounds { min_m: world_m(section.min_m), max_m: world_m(section.max_m) }
    }
}
