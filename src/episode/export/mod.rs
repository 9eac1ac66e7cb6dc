//! Episodes as MCAP files: indexed, compressed in chunks, with CRCs, and Foxglove's schemas.
//!
//! | topic | message |
//! |---|---|
//! | `/tf` | `foxglove.FrameTransforms`: world to rig at each step, rig to each camera at the start |
//! | `/camera/N/image` | `foxglove.CompressedImage`: JPEG, if the caller renders the images |
//! | `/camera/N/calibration` | `foxglove.CameraCalibration`; `/wildcity/episode` has its deviation from the lens |
//! | `/lidar/N/points` | `foxglove.PointCloud` in the rig at the sweep's time, if the caller casts the sweeps |
//! | `/actors` | `foxglove.SceneUpdate`: a box for each actor and for the ego |
//! | `/map` | `foxglove.SceneUpdate`: the outlines of the lanes |
//! | `/actors/poses` | `foxglove.PosesInFrame`: the middles of the actors' boxes, also for Rerun |
//! | `/ego/odometry` | `foxglove.Odometry`: pose, velocity, yaw rate |
//! | `/ego/pose` | `foxglove.PoseInFrame`: the same pose, also for Rerun |
//! | `/ego/path`, `/route` | `foxglove.PosesInFrame` in the world: the driven path, and the recorded drive |
//! | `/plan` | `foxglove.PosesInFrame` in the rig: the agent's trajectory, when it was decided |
//! | `/log` | `foxglove.Log`: events |
//! | `/wildcity/episode`, `step`, `event`, `result` | JSON: the lines of the record |
//!
//! Times are those of the episode plus 1,000 s, because a warm-up has negative times and MCAP does
//! not allow them.

#[cfg(feature = "mcap")]
mod calibration;
#[cfg(feature = "mcap")]
mod container;
#[cfg(feature = "mcap")]
mod convert;
#[cfg(feature = "mcap")]
mod descriptors;
mod error;
mod file;
#[cfg(feature = "mcap")]
mod messages;
#[cfg(feature = "mcap")]
mod nuscenes;
#[cfg(feature = "mcap")]
mod output;
#[cfg(feature = "mcap")]
mod parts;
#[cfg(feature = "mcap")]
mod ros2;
#[cfg(feature = "mcap")]
mod sweep;
#[cfg(feature = "mcap")]
mod write;

pub use error::{ExportError, Exported};
pub use file::{export_file, mcap_path, remove_leftovers, write_whole};
#[cfg(feature = "mcap")]
pub use nuscenes::{NuscenesExport, NuscenesImage, export_nuscenes};
#[cfg(feature = "mcap")]
pub use ros2::{Ros2Export, export_ros2};
#[cfg(feature = "mcap")]
pub use sweep::ExportedSweep;
#[cfg(feature = "mcap")]
pub use write::{EpisodeExport, ExportedImage, export};

/// Whether this build can write MCAP: it has the feature `mcap`.
pub const CAN_EXPORT: bool = cfg!(feature = "mcap");
