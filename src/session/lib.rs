//! Sessions of agents on city twins: open, reset, step, observe, record, replay.
//!
//! An [`Engine`] is shared by all sessions; a [`Session`] belongs to one agent. A request renders,
//! is recorded, and only then changes the session: if any of this fails, the session is unchanged,
//! and the client can repeat the request.
//!
//! | module | contents |
//! |---|---|
//! | `session` | a session: opening it, answering its requests |
//! | `start` | where episodes start |
//! | `state`, `episode` | the parts of a session; the ego's pose, the simulated time, and the past poses |
//! | `contact`, `spatial_index` | contact of the ego with the twin; what of a twin is near a place |
//! | `snapshot` | named states, to return to and to open other sessions from |
//! | `engine` | the twins in memory, the render queue, the budget for answers |
//! | `polls` | how long requests hold up the threads that answer |
//! | `observe` | which images are rendered, and how they become one message |
//! | `record` | episodes' files, and their replay |
//! | `prefetch` | loads what the next frames of the ego will need |
//! | `repair` | which images a model repairs, and what is reported of each |
//! | `scenario` | scenarios by name, and the files next to them |
//! | `sensors` | sensor effects, and the planner latency |
//! | `stills` | images from any views, without an episode |
//! | [`limits`] | limits and defaults |

mod blocking;
mod contact;
mod engine;
mod episode;
mod error;
pub mod limits;
mod observe;
mod open_scene;
mod pin;
mod polls;
mod prefetch;
mod record;
mod repair;
mod scenario;
mod sensors;
mod session;
mod snapshot;
mod spatial_index;
mod start;
mod state;
mod stills;
mod viewpoint;

pub use blocking::run_blocking;
pub use engine::answer_budget::BudgetShare;
pub use engine::render_queue::{FrameCost, Scratch};
pub use engine::twin_summaries::{DamagedSummary, TrajectorySummary, TwinSummaries, TwinSummary};
pub use engine::{DeviceLoad, Engine, EngineSettings, LatestPin, PUSHES};
pub use episode::{EgoHistory, Episode, EpisodeSummary, Outcome};
pub use error::SessionError;
pub use observe::buffer::ObservationBuffer;
pub use observe::encode::{ImageEncoding, PixelMaps, png};
pub use observe::jpeg::jpeg;
pub use observe::layout::HEADER_PREFIX_BYTES;
pub use observe::observation::{
    DType, ImageInfo, Observation, PastImageInfo, ResidencyStats, SweepInfo, Tensor, TensorKind,
    Timings,
};
pub use observe::trust::{RecordedPoses, TrainingCoverage, Trust};
pub use open_scene::{FrameScene, OpenScene};
pub use polls::{PollTimes, Polls};
pub use record::command::RecordedCommand;
pub use record::continuation::Continuation;
pub use record::ego_replay::DivergedStep;
pub use record::error::RecordError;
pub use record::format::{
    EpisodeHeader, FrameRecord, FrameRequest, RecordedOrigin, RecordedOutputs, RecordedSettings,
    RecordedVersion, is_episode_name,
};
pub use record::quota::RecordLimits;
pub use record::recorded_episode::RecordedEpisode;
pub use record::repairs::{RecordedImageRepair, RecordedRepair};
pub use record::replay_report::{
    ImageDifference, ProvenanceChange, RepairedImages, ReplayError, ReplayReport, ReplayUntil,
    Replayed, ReplayedImage, ReplayedSweep, Sensor, WrongValue,
};
pub use repair::offline::{
    NeededReferences, OfflineDrawing, OfflineReferences, OfflineView, ViewReferences,
};
pub use repair::references::ReferenceSource;
pub use repair::rendered_image::RenderedImage;
pub use repair::session_repair::SessionRepair;
pub use repair::status::{ImageRepair, RepairFailure, RepairStatus};
pub use scenario::{
    EpisodeTraffic, Event, EventKind, LoadedScenario, PlannedScenario, ScenarioError,
    ScenarioSource, Scenarios, StoredAssets, TwinScenarios, generated_actors,
};
pub use sensors::{ImageSensor, SensorReason};
pub use session::Session;
pub use session::requests::{ResetOptions, StepOptions};
pub use snapshot::{Snapshot, Snapshots};
pub use start::scenario_start;
pub use stills::{Still, StillActor, StillViews, Stills};
pub use viewpoint::{lidar_viewpoint, viewpoints};

/// What a session can be asked for: the parts of [`Open`](options::Open).
pub use wildcity_options as options;
