//! What the cameras of a capture say of its ground: it is below all of them, and the rows of their
//! images are level.

use glam::DVec3;

use crate::geometry::Pose;

use super::ground::fit;
use super::{GroundPlane, median};

/// The cameras of a capture, in the axes and the unit of its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureCameras {
    /// About where up is.
    pub up: DVec3,
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

impl CaptureCameras {
    /// Cameras with these poses: x right, y down, z forward.
    ///
    /// Photographs are tilted up to the roof of a house or down to an object, and hardly ever
    /// rolled: up is across the rows of all images. Only if all look in one direction, it is the
    /// mean of their up directions.
    ///
    /// # Errors
    /// [`CamerasError::NoCommonUp`].
    pub fn new(world_from_camera: &[Pose]) -> Result<Self, CamerasError> {
        let count = world_from_camera.len();
        let axes = |axis: DVec3| world_from_camera.iter().map(move |pose| pose.rotation * axis);
        let mean = axes(DVec3::NEG_Y).sum::<DVec3>() / count.max(1) as f64;
        if mean.length() < LEAST_COMMON {
            return Err(CamerasError::NoCommonUp { count });
        }
        let positions = world_from_camera.iter().map(|pose| pose.position_m).collect();
        let is_spread = axes(DVec3::X).sum::<DVec3>().length() <= MOST_PARALLEL * count as f64;
        // A plane through the origin: each direction and the opposite one have their mean there.
        let rows: Vec<DVec3> = axes(DVec3::X).chain(axes(DVec3::NEG_X)).collect();
        let across = fit(&rows).filter(|_| is_spread).map(|plane| plane.up);
        let up = across.map_or(mean, |across| across * across.dot(mean).signum());
        Ok(Self { up: up.normalize(), positions })
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
