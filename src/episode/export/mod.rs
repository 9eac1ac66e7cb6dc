//! Episodes as MCAP files: indexed, compressed in chunks, with CRCs, and Foxglove's schemas.
//!
//! | topic | message |
//! |---|---|
//! | `/tf` | `foxglove.FrameTransforms`: world to rig at each step, rig to each camera at the start |
//! | `/camera/N/image` | `foxglove.CompressedImage`: JPEG, if the caller renders the images |
//! | `/camera/N/calibration` | `foxglove.CameraCalibration`; `/wildcity/episode` has its deviation from the lens |
//! | `/actors` | `foxglove.SceneUpdate`: a box for each actor and for the ego |
//! | `/map` | `foxglove.SceneUpdate`: the outlines of the lanes |
//! | `/ego/odometry` | `foxglove.Odometry`: pose, velocity, yaw rate |
//! | `/ego/path`, `/route` | `foxglove.PosesInFrame` in the world: the driven path, and the recorded drive |
//! | `/plan` | `foxglove.PosesInFrame` in the rig: the agent's trajectory, when it was decided |
//! | `/log` | `foxglove.Log`: events |
//! | `/wildcity/episode`, `step`, `event`, `result` | JSON: the lines of the record |
//!
//! Times are those of the episode plus 1,000 s, because a warm-up has negative times and MCAP does
//! not allow them.

mod calibration;
mod container;
mod convert;
mod descriptors;
mod file;
mod messages;
mod output;
mod parts;
mod write;

pub use file::{export_file, mcap_path, remove_leftovers, write_whole};
pub use write::{EpisodeExport, ExportError, Exported, ExportedImage, export};
