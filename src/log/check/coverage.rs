//! How well the images of each camera cover the drive.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::poses::{Poses, Stations};
use crate::row::ImageRow;

/// The images of one camera along the drive.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraCoverage {
    pub camera: String,
    pub images: usize,
    /// Images at times without a pose: they cannot be placed.
    pub unplaced: usize,
    /// Images that name a mask.
    pub masks: usize,
    /// Images that name a mask of the ground.
    pub ground_masks: usize,
    /// Images that name a mask of the sky.
    pub sky_masks: usize,
    /// Largest distance along the drive without an image, in metres, ends included.
    pub longest_m: f64,
    /// Mean distance along the drive between two images, in metres.
    pub spacing_m: f64,
}

/// Counts images along the drive.
pub(super) struct Coverage<'a> {
    stations: Stations<'a>,
    cameras: BTreeMap<String, Along>,
}

/// The images of a camera so far.
struct Along {
    last_m: f64,
    coverage: CameraCoverage,
}

impl<'a> Coverage<'a> {
    pub(super) fn new(poses: &'a Poses) -> Self {
        Self { stations: Stations::new(poses), cameras: BTreeMap::new() }
    }

    pub(super) fn add(&mut self, row: &ImageRow) {
        let station_m = self.stations.at(row.time_us);
        // Looked up first, so that only the first row of a camera copies its name.
        if !self.cameras.contains_key(&row.camera) {
            let coverage = CameraCoverage::new(row.camera.clone());
            self.cameras.insert(row.camera.clone(), Along { last_m: 0.0, coverage });
        }
        let Some(Along { last_m, coverage }) = self.cameras.get_mut(&row.camera) else { return };
        coverage.images += 1;
        coverage.masks += usize::from(row.mask.is_some());
        coverage.ground_masks += usize::from(row.ground_mask.is_some());
        coverage.sky_masks += usize::from(row.sky_mask.is_some());
        match station_m {
            None => coverage.unplaced += 1,
            Some(station_m) => {
                coverage.longest_m = coverage.longest_m.max(station_m - *last_m);
                *last_m = station_m;
            }
        }
    }

    pub(super) fn finish(self) -> Vec<CameraCoverage> {
        let length_m = self.stations.length_m();
        let finished = self.cameras.into_values().map(|Along { last_m, mut coverage }| {
            // The rest of the drive behind the last image is without one, too.
            coverage.longest_m = coverage.longest_m.max(length_m - last_m);
            // An image without a pose is nowhere along the drive.
            let placed = coverage.images - coverage.unplaced;
            coverage.spacing_m = length_m / placed.max(1) as f64;
            coverage
        });
        finished.collect()
    }
}

impl CameraCoverage {
    fn new(camera: String) -> Self {
        Self {
            camera,
            images: 0,
            unplaced: 0,
            masks: 0,
            ground_masks: 0,
            sky_masks: 0,
            longest_m: 0.0,
            spacing_m: 0.0,
        }
    }
}
