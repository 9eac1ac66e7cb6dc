//! Giving Gaussians of a twin classes, by boxes and by the ground, as a new version.

use std::collections::BTreeSet;

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, SemanticClass};

use super::cut::CutPlace;
use super::log::CommitKind;
use super::pack::StorageOptions;
use super::settings::VersionChange;
use super::{Catalog, StoreError, Version};

/// Which Gaussians get which class.
#[derive(Clone, Copy)]
pub struct Labels<'a> {
    /// The class of those whose centres lie on the ground, and whether a point in the world does.
    pub ground: Option<(SemanticClass, &'a (dyn Fn(DVec3) -> bool + Sync))>,
    /// The class of those whose centres lie in a box, as [`Catalog::cut`] takes it: the ground
    /// under it is not in it. They take precedence over the ground, and later boxes over earlier
    /// ones.
    pub places: &'a [(CutPlace, SemanticClass)],
}

/// A new version with classes.
#[derive(Clone, Debug)]
pub struct Labelled {
    pub version: Version,
    /// Number of Gaussians that were given a class, also one that they had.
    pub gaussians: u64,
}

impl Catalog {
    /// Makes a version in which some Gaussians have classes; others keep theirs, and are unlabelled
    /// if they had none. Cells of which none gets a class stay as they are; in the others all
    /// Gaussians are encoded again. `option` is noted in the provenance.
    ///
    /// # Errors
    /// [`StoreError::NothingToLabel`] if no Gaussian gets a class; otherwise as a commit.
    pub fn label(
        &self,
        base: &Version,
        labels: Labels<'_>,
        option: String,
    ) -> Result<Labelled, StoreError> {
        let manifest = &base.manifest;
        // The inverse of each place is needed for every Gaussian.
        let places: Vec<(&CutPlace, Pose, SemanticClass)> = labels
            .places
            .iter()
            .map(|(place, class)| (place, place.world_from_box.inverse(), *class))
            .collect();
        let mut changed = Gaussians { sh_degree: manifest.sh_degree, ..Gaussians::default() };
        let mut cells = BTreeSet::new();
        let mut labelled = 0;
        for chunk in &manifest.chunks {
            let near: Vec<_> =
                places.iter().filter(|(place, ..)| place.is_near(&chunk.bounds)).collect();
            // Only the ground reaches cells that no box is near.
            if near.is_empty() && labels.ground.is_none() {
                continue;
            }
            let mut all = self.full_detail(base, chunk)?;
            let class_at = |mean_m: &[f64; 3]| {
                let at_m = DVec3::from_array(*mean_m);
                let last = near.iter().rfind(|(place, box_from_world, _)| {
                    place.has(box_from_world.transform_point(at_m))
                });
                let ground = labels.ground.filter(|(_, is_ground)| is_ground(at_m));
                last.map(|(.., class)| *class).or(ground.map(|(class, _)| class))
            };
            let given: Vec<Option<SemanticClass>> = all.means_m.iter().map(class_at).collect();
            let count = given.iter().flatten().count() as u64;
            if count == 0 {
                continue;
            }
            labelled += count;
            let own =
                all.classes.take().unwrap_or_else(|| vec![SemanticClass::Unlabelled; all.len()]);
            let classes = given.iter().zip(own).map(|(given, own)| given.unwrap_or(own));
            all.classes = Some(classes.collect());
            // A commit replaces whole cells, so that also the Gaussians without a new class are put
            // again.
            cells.insert(chunk.cell);
            changed.append(&all);
        }
        if labelled == 0 {
            return Err(StoreError::NothingToLabel);
        }
        // As the twin is stored, because a version has one record format.
        let storage = StorageOptions { record: manifest.record, levels: manifest.has_levels() };
        let mut commit = self.begin(&manifest.twin, CommitKind::Import, storage)?;
        commit.put(&changed, Some(&cells), &mut |_, _| {})?;
        let mut provenance = manifest.provenance.for_edit();
        provenance.options.push(option);
        let version = commit.change(base.number, VersionChange::new(provenance))?;
        Ok(Labelled { version, gaussians: labelled })
    }
}

impl std::fmt::Debug for Labels<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let ground = self.ground.map(|(class, _)| class);
        f.debug_struct("Labels").field("ground", &ground).field("places", &self.places).finish()
    }
}
