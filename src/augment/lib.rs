//! Views beside a twin's recorded drives, repaired by a model, as a data set that a trainer reads.
//!
//! ```text
//! plan          where views are: rounds, offsets, stations
//! cameras       pinholes in place of lenses; what each format calls a camera
//! maps          masks, depth and images as PNG
//! record        augment.json: what a data set was made with, and its samples
//! folder        the folder of a round: samples renamed into place, resume, refusals
//! transforms    transforms.json, as nerfstudio reads it
//! colmap        sparse/0, as COLMAP reads it
//! points        Gaussians as COLMAP's points
//! ```
//!
//! Nothing here renders: `wildcity augment` draws the views through a server, as any agent would. The idea of
//! rounds, in which the views move away from the drive and the newest ones are trained on, is that of Difix3D+ (Wu et
//! al. 2025).

mod cameras;
mod colmap;
mod error;
mod folder;
pub mod limits;
mod maps;
mod plan;
mod points;
mod record;
mod transforms;

pub use cameras::{CameraModel, TrainingCamera, pinhole_of};
pub use colmap::{ColmapForm, ColmapModel};
pub use error::AugmentError;
pub use folder::Folder;
pub use maps::{counted, depth_mm, mask_png, millimetres_png, rgb_png};
pub use plan::{Place, Plan};
pub use points::{Point, PointSample, Surroundings};
pub use record::{
    Header, MadeWith, Options, RepairedWith, Sample, SampleFiles, SampleRepair, weight,
};
pub use transforms::transforms;
