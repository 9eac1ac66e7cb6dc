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
    /// The new version.
    pub version: Version,
    /// What was cut out, in the axes of the box, at full detail.
    pub gaussians: Gaussians,
}

impl Catalog {
    /// Makes a version without the Gaussians whose centres lie in a box, from [`CUT_ABOVE_M`] above its bottom. Cells
    /// that the box does not touch stay as they are; in the others the Gaussians that stay are encoded again.
    ///
    /// # Errors
    /// [`StoreError::NothingToCut`] if no Gaussian lies in the box, or none would stay in a cell; otherwise as a commit.
    pub fn cut(
        &self,
        base: &Version,
        world_from_box: &Pose,
        box_: &ActorBox,
    ) -> Result<Cut, StoreError> {
        let manifest = &base.manifest;
        let reach_m = DVec3::new(box_.length_m, box_.width_m, box_.height_m).length();
        let near = |bounds: &Bounds| bounds.distance_m(world_from_box.position_m) <= reach_m;
        let box_from_world = world_from_box.inverse();
        let mut staying = Gaussians { sh_degree: manifest.sh_degree, ..Gaussians::default() };
        let mut cut = staying.clone();
        let mut cells = BTreeSet::new();
        for chunk in manifest.chunks.iter().filter(|chunk| near(&chunk.bounds)) {
            let all = self.full_detail(base, chunk)?;
            let (inside, outside): (Vec<usize>, Vec<usize>) = (0..all.len()).partition(|&index| {
                let mean_m = DVec3::from_array(all.means_m[index]);
                is_inside(box_, box_from_world.transform_point(mean_m))
            });
            if inside.is_empty() {
                continue;
            }
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
        let levels = manifest.chunks.iter().flat_map(|chunk| &chunk.sections).any(|s| s.level > 0);
        let storage = StorageOptions { record: manifest.record, levels };
        let mut commit = self.begin(&manifest.twin, CommitKind::Import, storage)?;
        commit.put(&staying, Some(&cells), &mut |_, _| {})?;
        let mut provenance = manifest.provenance.clone();
        let DVec3 { x, y, z } = world_from_box.position_m;
        provenance.options.push(format!(
            "cut={:.3},{:.3},{:.3} {:.3}x{:.3}x{:.3}",
            x, y, z, box_.length_m, box_.width_m, box_.height_m
        ));
        let change =
            VersionChange { profile: None, rig: None, trajectories: None, sky: None, provenance };
        let version = commit.change(base.number, change)?;
        cut.transform(&box_from_world);
        Ok(Cut { version, gaussians: cut })
    }

    /// The Gaussians of a cell at full detail, in world axes.
    fn full_detail(&self, version: &Version, chunk: &ChunkEntry) -> Result<Gaussians, StoreError> {
        let sh_degree = version.manifest.sh_degree;
        let mut all = Gaussians { sh_degree, ..Gaussians::default() };
        for section in chunk.sections.iter().filter(|section| section.level == 0) {
            all.append(&self.section(version, chunk, section)?.to_gaussians());
        }
        Ok(all)
    }
}

fn is_inside(box_: &ActorBox, at_m: DVec3) -> bool {
    let ActorBox { length_m, width_m, height_m } = *box_;
    at_m.x.abs() <= 0.5 * length_m
        && at_m.y.abs() <= 0.5 * width_m
        && (CUT_ABOVE_M..=height_m).contains(&at_m.z)
}
