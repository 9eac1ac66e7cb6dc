//! Episodes: reset, step, observe, record, replay.
//!
//! An [`Engine`] is what all sessions share; a [`Session`] is one agent's use of it. A request
//! renders, is recorded, and only then changes the session: whatever fails on the way, nothing has
//! happened, and the request can be sent again.

mod engine;
mod episode;
mod error;
mod golden;
pub mod limits;
mod observe;
mod options;
mod prefetch;
mod record;
mod session;

pub use engine::twin_summaries::{TrajectorySummary, TwinSummary};
pub use engine::{Engine, EngineSettings, LatestPin};
pub use episode::{EgoHistory, Episode, EpisodeSummary, Outcome};
pub use error::SessionError;
pub use golden::{ProposedChange, PsnrPreview};
pub use observe::buffer::ObservationBuffer;
pub use observe::builder::{HEADER_PREFIX_BYTES, viewpoints};
pub use observe::encode::{Encoding, jpeg, png};
pub use observe::observation::{
    DType, ImageInfo, Observation, PastImageInfo, ResidencyStats, Tensor, TensorKind, Timings,
};
pub use observe::trust::{TrainingCoverage, Trust};
pub use options::{ImagePart, Outputs, PixelMaps, RigChoice, SessionOptions, Start};
pub use record::ego_replay::DivergedStep;
pub use record::format::{
    EpisodeHeader, FrameRecord, FrameRequest, RecordError, RecordedCommand, RecordedOutputs,
    RecordedVersion,
};
pub use record::replay::{
    ImageDifference, ProvenanceChange, RecordedEpisode, ReplayError, ReplayReport, ReplayUntil,
    ReplayedImage,
};
pub use session::Session;
