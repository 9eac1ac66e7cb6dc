//! Images of a data set, as transforms.json and COLMAP have them.

use wildcity_scene::geometry::Pose;

use crate::record::Sample;

/// An image of a data set.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingImage {
    /// Its file below the folder of the images.
    pub name: String,
    /// Name of its camera.
    pub camera: String,
    pub world_from_camera: Pose,
}

impl From<&Sample> for TrainingImage {
    fn from(sample: &Sample) -> Self {
        Self {
            name: sample.name.clone(),
            camera: sample.camera.clone(),
            world_from_camera: sample.world_from_camera,
        }
    }
}
