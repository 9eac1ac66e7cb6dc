//! The differences between two versions of a twin.

use std::collections::BTreeMap;

use wildcity_scene::Manifest;
use wildcity_scene::manifest::ChunkEntry;

use super::{Catalog, StoreError};

/// The differences between two versions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Diff {
    /// Cells that differ, in order of (cell y, cell x).
    pub cells: Vec<CellDiff>,
    /// Number of cells that are the same in both.
    pub kept: u64,
    /// Fields of the manifest that differ, among `profile`, `sh_degree`, `record`, `rig`,
    /// `trajectories`, `sky`, `views`, `geo`, `alignment`.
    pub settings: Vec<&'static str>,
}

/// A cell that differs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CellDiff {
    /// Grid cell (x, y).
    pub cell: [i32; 2],
    /// Its size before; `None` if it was added.
    pub before: Option<CellSize>,
    /// Its size after; `None` if it was removed.
    pub after: Option<CellSize>,
}

/// The size of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CellSize {
    /// Number of Gaussians at full detail.
    pub gaussians: u64,
    /// Size of its object, in bytes.
    pub bytes: u64,
}

impl Catalog {
    /// The differences between version `before` and version `after` of a twin, only from their
    /// manifests.
    ///
    /// # Errors
    /// As [`Catalog::version`].
    pub fn diff(&self, name: &str, before: u64, after: u64) -> Result<Diff, StoreError> {
        let before = self.version(name, Some(before))?;
        let after = self.version(name, Some(after))?;
        Ok(Diff::between(&before.manifest, &after.manifest))
    }
}

impl Diff {
    /// The setting that differs if one version is in other axes than the other.
    pub(super) const ALIGNMENT: &str = "alignment";

    /// The differences between two manifests.
    pub fn between(before: &Manifest, after: &Manifest) -> Self {
        // The pair [before, after] by (y, x), which is the order of the result.
        let mut cells: BTreeMap<_, [Option<&ChunkEntry>; 2]> = BTreeMap::new();
        for (which, manifest) in [before, after].into_iter().enumerate() {
            for chunk in &manifest.chunks {
                let [x, y] = chunk.cell;
                cells.entry([y, x]).or_default()[which] = Some(chunk);
            }
        }
        let all = cells.len() as u64;
        // Objects are named by their content, so that equal names are equal cells.
        cells.retain(|_, [old, new]| old.map(|c| &c.object) != new.map(|c| &c.object));
        let size = |c: &ChunkEntry| CellSize { gaussians: c.count, bytes: c.bytes };
        let cells = cells.into_iter().map(|([y, x], [old, new])| CellDiff {
            cell: [x, y],
            before: old.map(size),
            after: new.map(size),
        });
        let cells: Vec<_> = cells.collect();
        let differs = [
            ("profile", before.profile != after.profile),
            ("sh_degree", before.sh_degree != after.sh_degree),
            ("record", before.record != after.record),
            ("rig", before.rig != after.rig),
            ("trajectories", before.trajectories != after.trajectories),
            ("sky", before.sky != after.sky),
            ("views", before.views != after.views),
            ("geo", before.geo != after.geo),
            (Self::ALIGNMENT, before.alignment() != after.alignment()),
        ];
        let settings = differs.into_iter().filter_map(|(field, differs)| differs.then_some(field));
        // No underflow: the cells that differ are some of all.
        Self { kept: all - cells.len() as u64, cells, settings: settings.collect() }
    }
}
