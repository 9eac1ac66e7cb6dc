//! Cutting Gaussians out of a twin: what lies in a box goes, as a new version, and is returned.

use std::collections::BTreeSet;

use glam::DVec3;

use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::manifest::ChunkEntry;
use wildcity_scene::{ActorBox, Gaussians};

use super::log::CommitKind;
use super::pack::StorageOptions;
use super::settings::VersionChange;
use super::{Catalog, StoreError, Version};

/// Lower end of what is cut, above the bottom of the box, in metres: the ground stays.
pub const CUT_ABOVE_M: f64 = 0.05;

/// A new version without some Gaussians, and those Gaussians.
#[derive(Clone, Debug)]
pub struct Cut {
    pub version: Version,
    /// The Gaussians that were cut out, in the axes of the box, at full detail.
    pub gaussians: Gaussians,
}

/// A box to cut out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CutPlace {
    /// Where it is: its origin is on the ground under the middle.
    pub world_from_box: Pose,
    pub box_: ActorBox,
}

impl Catalog {
    /// Makes a version without the Gaussians whose centres lie in a box, from [`CUT_ABOVE_M`] above
    /// its bottom. Cells that the box does not touch stay as they are; in the others the Gaussians
    /// that stay are encoded again.
    ///
    /// # Errors
    /// [`StoreError::NothingToCut`] if no Gaussian lies in the box, or none would stay in a cell;
    /// otherwise as a commit.
    pub fn cut(
        &self,
        base: &Version,
        world_from_box: &Pose,
        box_: &ActorBox,
    ) -> Result<Cut, StoreError> {
        let DVec3 { x, y, z } = world_from_box.position_m;
        let option = format!(
            "cut={:.3},{:.3},{:.3} {:.3}x{:.3}x{:.3}",
            x, y, z, box_.length_m, box_.width_m, box_.height_m
        );
        let place = CutPlace { world_from_box: *world_from_box, box_: *box_ };
        let mut cut = self.cut_all(base, &[place], option)?;
        cut.gaussians.transform(&world_from_box.inverse());
        Ok(cut)
    }

    /// As [`Catalog::cut`], with many boxes: what lies in any of them goes, and is returned in
    /// world axes. `option` is noted in the provenance.
    ///
    /// # Errors
    /// As [`Catalog::cut`].
    pub fn cut_all(
        &self,
        base: &Version,
        places: &[CutPlace],
        option: String,
    ) -> Result<Cut, StoreError> {
        let manifest = &base.manifest;
        // Inverted once for each box, and not for each of millions of Gaussians.
        let places: Vec<(CutPlace, Pose)> =
            places.iter().map(|place| (*place, place.world_from_box.inverse())).collect();
        // Only of cells that lose some: a change replaces whole cells, and leaves all others alone.
        let mut staying = Gaussians { sh_degree: manifest.sh_degree, ..Gaussians::default() };
        let mut cut = staying.clone();
        let mut cells = BTreeSet::new();
        for chunk in &manifest.chunks {
            let near: Vec<&(CutPlace, Pose)> =
                places.iter().filter(|(place, _)| place.is_near(&chunk.bounds)).collect();
            if near.is_empty() {
                continue;
            }
            let all = self.full_detail(base, chunk)?;
            let (inside, outside): (Vec<usize>, Vec<usize>) = (0..all.len()).partition(|&index| {
                let mean_m = DVec3::from_array(all.means_m[index]);
                near.iter().any(|(place, box_from_world)| {
                    place.has(box_from_world.transform_point(mean_m))
                })
            });
            // The box is near, but nothing of this cell is in it: its stored bytes stay.
            if inside.is_empty() {
                continue;
            }
            // A change can replace a cell, but cannot remove one.
            if outside.is_empty() {
                return Err(StoreError::NothingToCut { cell: Some(chunk.cell) });
            }
            cells.insert(chunk.cell);
            cut.append(&all.select(inside));
            staying.append(&all.select(outside));
        }
        if cut.is_empty() {
            return Err(StoreError::NothingToCut { cell: None });
        }
        // As the twin is stored, because a version has one record format.
        let storage = StorageOptions { record: manifest.record, levels: manifest.has_levels() };
        let mut commit = self.begin(&manifest.twin, CommitKind::Import, storage)?;
        commit.put(&staying, Some(&cells), &mut |_, _| {})?;
        let mut provenance = manifest.provenance.for_edit();
        provenance.options.push(option);
        let version = commit.change(base.number, VersionChange::new(provenance))?;
        Ok(Cut { version, gaussians: cut })
    }

    /// The Gaussians of a cell at full detail, in world axes.
    pub(super) fn full_detail(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
    ) -> Result<Gaussians, StoreError> {
        let sh_degree = version.manifest.sh_degree;
        let mut all = Gaussians { sh_degree, ..Gaussians::default() };
        for section in chunk.full_detail() {
            all.append(&self.section(version, chunk, section)?.to_gaussians());
        }
        Ok(all)
    }
}

impl CutPlace {
    /// Whether a part of some bounds may be in the box.
    pub(super) fn is_near(&self, bounds: &Bounds) -> bool {
        let ActorBox { length_m, width_m, height_m } = self.box_;
        // From the origin, in the middle of the ground face, the farthest corner is at sqrt((l/2)²
        // + (w/2)² + h²). The diagonal of the box is above that.
        let reach_m = DVec3::new(length_m, width_m, height_m).length();
        bounds.distance_m(self.world_from_box.position_m) <= reach_m
    }

    /// Whether a point in the box's axes is cut, in metres.
    pub(super) fn has(&self, at_m: DVec3) -> bool {
        let ActorBox { length_m, width_m, height_m } = self.box_;
        at_m.x.abs() <= 0.5 * length_m
            && at_m.y.abs() <= 0.5 * width_m
            && (CUT_ABOVE_M..=height_m).contains(&at_m.z)
    }
}
