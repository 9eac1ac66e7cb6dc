//! Episodes as MCAP files: indexed, compressed in chunks, with CRCs, and Foxglove's schemas.
//!
//! | topic | message |
//! |---|---|
//! | `/tf` | `foxglove.FrameTransforms`: world to rig at each step, rig to each camera at the begin |
//! | `/actors` | `foxglove.SceneUpdate`: a box for each actor, and the ego's |
//! | `/route`, `/plan` | `foxglove.PosesInFrame`: the recorded drive in the world, the agent's trajectory in the rig |
//! | `/camera/N/calibration` | `foxglove.CameraCalibration`; not of f-theta lenses, which it cannot describe |
//! | `/log` | `foxglove.Log`: events |
//! | `/wildcity/episode`, `step`, `event`, `result` | JSON: the lines of the record |
//!
//! Times are those of the episode plus 1,000 s, since MCAP has no times below 0 and a warm-up has.

mod descriptors;
mod messages;
mod write;

pub use write::{ExportError, Exported, export};
