//! The parts of a session: settings that stay the same from opening to closing, and state that
//! steps change.

use std::sync::Arc;
use std::time::Duration;

use wildcity_options::{ContactMode, RandomStart};
use wildcity_scene::{ProfileOverrides, RenderProfile};
use wildcity_sim::Dynamics;
use wildcity_sim::traffic::EgoBox;
use wildcity_twin::residency::Resident;

use crate::contact::TwinSolids;
use crate::engine::answer_budget::BudgetShare;
use crate::episode::Episode;
use crate::observe::frame_history::FrameHistory;
use crate::observe::layout::ObservationLayout;
use crate::observe::trust::TrainingCoverage;
use crate::prefetch::recorded_drive::RecordedDrive;
use crate::record::format::profile_hash;
use crate::repair::references::ReferenceViews;
use crate::repair::session_repair::SessionRepair;
use crate::scenario::{EpisodeTraffic, Event, SessionScenario};
use crate::spatial_index::SpatialIndex;
use crate::start::EpisodeStart;

/// Settings that `open` determines. Sessions that are branches of another one share its settings.
#[derive(Debug)]
pub(crate) struct SessionSettings {
    /// Fields that override the profile of each version of the twin.
    pub(crate) profile_overrides: ProfileOverrides,
    pub(crate) rig_name: String,
    pub(crate) layout: Arc<ObservationLayout>,
    /// The share of the budget for answers that the cameras' overlays take.
    pub(crate) _overlays: BudgetShare,
    pub(crate) dynamics: Dynamics,
    /// Where episodes start unless `reset` names another start; sampled anew for each episode if
    /// `random_start` is set.
    pub(crate) start: EpisodeStart,
    pub(crate) random_start: Option<RandomStart>,
    pub(crate) warm_up_us: i64,
    pub(crate) dt_us: i64,
    pub(crate) deadline: Duration,
    /// The recorded drive that the ego may follow.
    pub(crate) drive: Option<Arc<RecordedDrive>>,
    /// The scenario of every episode.
    pub(crate) scenario: Option<SessionScenario>,
    /// Whether observations contain the poses of the actors.
    pub(crate) reports_actors: bool,
    /// The repair of the images, if the session asked for it.
    pub(crate) repair: Option<Arc<SessionRepair>>,
    /// What contact with the twin does; `None` leaves it to the dynamics of each episode, or to the
    /// scenario.
    pub(crate) contact: Option<ContactMode>,
    /// The size with which contact with the twin is looked for; `None` if it is not.
    pub(crate) solid_ego: Option<EgoBox>,
    /// Whether episodes are recorded.
    pub(crate) is_recorded: bool,
    /// Whether the session switches to newer versions by itself.
    pub(crate) follows_latest: bool,
}

impl SessionSettings {
    /// Whether frames may be drawn view by view: images to repair are chosen among all of a frame.
    pub(crate) fn may_split(&self) -> bool {
        self.repair.is_none()
    }
}

/// The version of the twin that a session shows, and how.
#[derive(Clone, Debug)]
pub(crate) struct PinnedVersion {
    pub(crate) resident: Arc<Resident>,
    /// The version's profile with the session's overrides.
    pub(crate) profile: RenderProfile,
    pub(crate) profile_hash: blake3::Hash,
    /// Poses where the twin was recorded; only if images come with their trust or may be repaired.
    pub(crate) coverage: Option<Arc<TrainingCoverage>>,
    /// What of it is near a place.
    pub(crate) index: Arc<SpatialIndex>,
    /// Its solid Gaussians; only if contact with them is looked for.
    pub(crate) solids: Option<TwinSolids>,
    /// References of the views; only if the session's repair model needs some.
    pub(crate) references: Option<Arc<ReferenceViews>>,
}

/// State that a step changes. With the settings and the version, it determines the coming
/// observations. A copy continues exactly as the original does.
#[derive(Clone, Debug)]
pub(crate) struct EpisodeState {
    pub(crate) episode: Episode,
    /// The episode's frames that later observations show again.
    pub(crate) frame_history: FrameHistory,
    /// The actors; only with a scenario.
    pub(crate) traffic: Option<EpisodeTraffic>,
    /// Events of the last step, by time. With a scenario, those of the traffic.
    pub(crate) events: Vec<Event>,
}

impl PinnedVersion {
    pub(crate) fn new(
        resident: Arc<Resident>,
        profile: RenderProfile,
        coverage: Option<Arc<TrainingCoverage>>,
        index: Arc<SpatialIndex>,
    ) -> Self {
        let profile_hash = profile_hash(&profile);
        Self { resident, profile, profile_hash, coverage, index, solids: None, references: None }
    }

    /// Sets the solid Gaussians.
    pub(crate) fn with_solids(self, solids: Option<TwinSolids>) -> Self {
        Self { solids, ..self }
    }

    pub(crate) fn with_references(self, references: Option<Arc<ReferenceViews>>) -> Self {
        Self { references, ..self }
    }

    /// Whether it is the same version of the same twin.
    pub(crate) fn has_same_version(&self, other: &Self) -> bool {
        // After a rollback, two numbers may have one hash.
        self.resident.version.hash == other.resident.version.hash
            && self.resident.version.number == other.resident.version.number
    }
}

impl EpisodeState {
    /// The state at the start of an episode.
    pub(crate) fn at_start(episode: Episode) -> Self {
        let frame_history = FrameHistory::default();
        Self { episode, frame_history, traffic: None, events: Vec::new() }
    }

    /// Bytes that a copy does not share with its original. It shares the frames.
    pub(crate) fn copied_bytes(&self) -> u64 {
        let traffic = self.traffic.as_ref().map_or(0, EpisodeTraffic::copied_bytes);
        (traffic + size_of_val(&*self.events)) as u64
    }
}
