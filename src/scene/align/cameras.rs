//! What the cameras of a capture say of its ground: it is below all of them, and the rows of their
//! images are level.

use glam::DVec3;

use crate::geometry::Pose;

use super::ground::fit;
use super::{GroundPlane, median};

/// The cameras of a capture, in the axes and the unit of its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureCameras {
    /// Directions that may be up, the most likely first; at least one.
    ups: Vec<DVec3>,
    /// Where they are; at least one.
    positions: Vec<DVec3>,
}

/// Why cameras say nothing of the ground.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CamerasError {
    /// They are turned in all directions: a drone that looks down, or none at all.
    #[error(
        "the {count} cameras have no common direction that is up: leave out --cameras, and give --up"
    )]
    NoCommonUp { count: usize },
}

/// Least length of the mean of the cameras' up directions: level photographs that are tilted by up
/// to 45 degrees have 0.7 and more.
const LEAST_COMMON: f64 = 0.7;

/// Largest length of the mean of the directions along the cameras' rows that say where up is: they
/// are spread by 8 degrees. Photographs in one direction do not say how far they are tilted.
const MOST_PARALLEL: f64 = 0.99;

/// Photographs are upright in files that are not: of those that walk around something, the axis
/// that is up is more parallel by at least this.
const MORE_PARALLEL: f64 = 0.02;

impl CaptureCameras {
    /// Cameras with these poses: x right, y down, z forward, of the image as it is in its file.
    ///
    /// Photographs are tilted up to the roof of a house or down to an object, and hardly ever
    /// rolled: up is across the rows of all images. Only if all look in one direction, it is the
    /// mean of their up directions. Of upright photographs, whose files are turned by a quarter, up
    /// is across the columns.
    ///
    /// # Errors
    /// [`CamerasError::NoCommonUp`].
    pub fn new(world_from_camera: &[Pose]) -> Result<Self, CamerasError> {
        let wide = Up::new(world_from_camera, DVec3::NEG_Y, DVec3::X);
        let upright = Up::new(world_from_camera, DVec3::NEG_X, DVec3::Y);
        let is_upright = upright.parallel > wide.parallel + MORE_PARALLEL;
        let mut ups = vec![wide];
        // The file may be turned to either side.
        let turned = [upright, Up { direction: -upright.direction, ..upright }];
        let at = if is_upright { 0 } else { ups.len() };
        ups.splice(at..at, turned);
        ups.retain(|up| up.parallel >= LEAST_COMMON);
        if ups.is_empty() {
            return Err(CamerasError::NoCommonUp { count: world_from_camera.len() });
        }
        let ups = ups.into_iter().map(|up| up.direction).collect();
        let positions = world_from_camera.iter().map(|pose| pose.position_m).collect();
        Ok(Self { ups, positions })
    }

    /// Directions that may be up, the most likely first.
    pub fn ups(&self) -> &[DVec3] {
        &self.ups
    }

    /// The middle of the cameras.
    pub(super) fn middle(&self) -> DVec3 {
        self.positions.iter().sum::<DVec3>() / self.positions.len() as f64
    }

    /// Whether all cameras are above a plane.
    pub(super) fn are_above(&self, plane: &GroundPlane) -> bool {
        self.heights(plane).all(|height| height > 0.0)
    }

    /// Median height of the cameras above a plane, in the unit of the scene.
    pub fn height_above(&self, plane: &GroundPlane) -> f64 {
        median(self.heights(plane).collect())
    }

    fn heights(&self, plane: &GroundPlane) -> impl Iterator<Item = f64> {
        let GroundPlane { point, up } = *plane;
        self.positions.iter().map(move |position| up.dot(position - point))
    }
}

/// A direction that may be up.
#[derive(Clone, Copy, Debug)]
struct Up {
    /// Length of the mean of the cameras' axes that point up, from 0 to 1.
    parallel: f64,
    direction: DVec3,
}

impl Up {
    /// Up, if the axis `upright` of the cameras points there and their axis `level` is horizontal.
    fn new(world_from_camera: &[Pose], upright: DVec3, level: DVec3) -> Self {
        let count = world_from_camera.len().max(1) as f64;
        let axes = |axis: DVec3| world_from_camera.iter().map(move |pose| pose.rotation * axis);
        let mean = axes(upright).sum::<DVec3>() / count;
        let is_spread = axes(level).sum::<DVec3>().length() <= MOST_PARALLEL * count;
        // A plane through the origin: each direction and the opposite one have their mean there.
        let rows: Vec<DVec3> = axes(level).chain(axes(-level)).collect();
        let across = fit(&rows).filter(|_| is_spread).map(|plane| plane.up);
        let direction = across.map_or(mean, |across| across * across.dot(mean).signum());
        Self { parallel: mean.length(), direction: direction.normalize_or_zero() }
    }
}
