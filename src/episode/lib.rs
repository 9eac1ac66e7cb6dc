//! Recorded episodes, without renderer and twin: reading, comparing and scoring them.
//!
//! The session writes an episode's file while it drives. This package has the lines that a scenario
//! adds to it, and reads the file afterwards. It accepts fields that later builds add, and reads a
//! truncated file up to its end.
//!
//! | module | contents |
//! |---|---|
//! | `lines` | the lines of a scenario: `scenario`, `actors`, `event`, `result` |
//! | `file` | reading an episode's file |
//! | `drive` | an episode as input of the scores |
//! | `outcome` | the result of an episode |
//! | `scenario` | the line of a scenario |
//! | `diff` | the first difference of two episodes |
//! | `export` | an episode as MCAP, or as tables of nuScenes |
//! | `listing`, `overview` | the episodes of a directory, and what a list shows of each |
//! | `prune` | removing old records |
//! | [`limits`] | limits |

mod diff;
mod drive;
mod export;
mod file;
pub mod limits;
mod lines;
mod listing;
mod outcome;
mod overview;
mod prune;
mod scenario;
mod sweep_point;

pub use diff::{Difference, What, diff};
pub use drive::{drive_record, off_model_us};
pub use export::{
    CAN_EXPORT, ExportError, Exported, export_file, mcap_path, remove_leftovers, write_whole,
};
#[cfg(feature = "mcap")]
pub use export::{
    EpisodeExport, ExportedImage, ExportedSweep, NuscenesExport, NuscenesImage, Ros2Export, export,
    export_nuscenes, export_ros2,
};
pub use file::{
    CameraHead, Cut, EndLine, EpisodeFile, Frame, Header, ReadError, RigHead, check_no_mcap,
    driven_indices, line_bytes, open_record,
};
pub use lines::{
    ActorLine, ActorStateLine, ActorsLine, Collision, ContactEvent, EgoLine, EpisodeResult, Event,
    EventLine, FaultLine, LaneLine, RoutePoint, ScenarioLine, ScoreLine,
};
pub use listing::{Listed, list, read_mcap, read_text, record_bytes};
pub use outcome::result;
pub use overview::{Overview, RecordHead};
pub use prune::{Keep, Pruned, prune};
pub use scenario::{DriveStart, ground_surface, pose_at, scenario_line};
pub use sweep_point::SweepPoint;
