//! Off-trajectory views: views with a lateral offset from a twin's recorded drives, repaired by a
//! model, as a data set for training.
//!
//! ```text
//! plan          poses of the views: rounds, offsets, stations
//! cameras       pinholes in place of lenses; camera models of the formats
//! maps          masks, depth and images as PNG
//! record        augment.json: the settings of a data set, and its samples
//! folder        the folder of a round: samples renamed into place, resume, refusals
//! transforms    transforms.json, as nerfstudio reads it
//! colmap        sparse/0, as COLMAP reads it
//! run           a round from start to end
//! points        Gaussians as COLMAP's points
//! training_image an image of a data set, without what a round says of it
//! ```
//!
//! This package does not render: `run` draws the views through a server, like any agent. The idea
//! of rounds, in which the views move away from the drive and the newest ones are trained on, is
//! that of Difix3D+ (Wu et al. 2025).

mod cameras;
mod colmap;
mod error;
mod folder;
pub mod limits;
mod maps;
mod plan;
mod points;
mod record;
mod run;
mod training_image;
mod transforms;

pub use cameras::{CameraModel, TrainingCamera, without_lens};
pub use colmap::{ColmapForm, ColmapModel};
pub use error::AugmentError;
pub use folder::Folder;
pub use maps::{counted, depth_mm, mask_png, millimetres_png, rgb_png};
pub use plan::{Place, Plan};
pub use points::{Point, PointSample, Surroundings};
pub use record::{
    Header, MadeWith, Options, RepairedWith, Sample, SampleFiles, SampleRepair, weight,
};
pub use run::{Augmentation, PLACE_TIMEOUT, Progress, Round, Settings};
pub use training_image::TrainingImage;
pub use transforms::{posed_frame, transforms};
