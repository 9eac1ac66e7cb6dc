//! One agent's session: its state, and accessors to it.
//!
//! | file | what the session does |
//! |---|---|
//! | `open.rs` | opens, and switches to another version of the twin |
//! | `branch.rs` | takes and restores snapshots, and opens sessions from a state of another episode |
//! | `requests.rs` | answers step, observe, reset and close |
//! | `pending.rs` | records a rendered request, and then changes the session |
//! | `recording.rs` | writes the episode's file |
//! | `prefetching.rs` | loads what the next steps will need |

mod branch;
mod open;
mod pending;
mod prefetching;
mod recording;
mod reference_images;
pub(crate) mod requests;
mod sweeps;

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use wildcity_options::Sensors;
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{RigCamera, RigLidar};
use wildcity_sim::Dynamics;
use wildcity_twin::residency::{Reservation, Resident, Viewpoint};

use crate::engine::Engine;
use crate::engine::devices::DeviceSlot;
use crate::episode::Episode;
use crate::observe::encode::{ImageEncoding, PixelMaps};
use crate::prefetch::latest_task::LatestTask;
use crate::record::format::RecordedOrigin;
use crate::record::recorder::Recorder;
use crate::repair::references::ReferenceSource;
use crate::repair::session_repair::SessionRepair;
use crate::scenario::{EpisodeTraffic, Event};
use crate::snapshot::Snapshots;
use crate::state::{EpisodeState, PinnedVersion, SessionSettings};

/// One agent's session on a twin. It stays on one version until the agent switches to another.
#[derive(Debug)]
pub struct Session {
    engine: Arc<Engine>,
    /// The version of the twin, and the memory for the session's worst frame.
    reservation: Reservation,
    /// Prefetches in the background.
    prefetch_task: LatestTask,
    name: String,
    /// Name of the token that its records belong to; empty if there is none.
    owner: String,
    /// The device that draws its frames, and their number in its queue.
    slot: DeviceSlot,
    settings: Arc<SessionSettings>,
    version: PinnedVersion,
    state: EpisodeState,
    snapshots: Snapshots,
    /// The recorded episode that this one is a branch of, if it is one.
    origin: Option<RecordedOrigin>,
    /// Number of the current episode's file, and the file once it exists: it begins with the first
    /// frame.
    episode_number: u64,
    recorder: Option<Recorder>,
    /// Whether the session has switched versions since the last line of the episode's file.
    version_switched: bool,
    /// A newer version that the session should follow, and cannot show.
    not_followed: Option<u64>,
    /// The agent's announced path (`prefetch`): poses (`world_from_rig`), in order.
    hint: Vec<Pose>,
    /// When the last frame was ready, and the time between it and the previous frame.
    last_frame_at: Instant,
    frame_interval: Duration,
}

impl Session {
    /// The name of the session, with which the names of its episodes begin.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Names the token that the records of its episodes belong to from now on.
    pub fn set_owner(&mut self, owner: &str) {
        owner.clone_into(&mut self.owner);
    }

    /// The version of the twin.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.version.resident
    }

    /// The viewpoints of the next frame if the ego stays where it is.
    pub fn viewpoints(&self) -> Vec<Viewpoint> {
        self.settings.layout.viewpoints(self.state.episode.world_from_rig())
    }

    /// Memory that is reserved for the worst frame, in bytes.
    pub fn reserved_bytes(&self) -> u64 {
        self.reservation.bytes()
    }

    /// The reserved memory by purpose.
    pub fn reservation(&self) -> &Reservation {
        &self.reservation
    }

    /// How it is rendered: the version's profile with the overrides from opening.
    pub fn profile(&self) -> &RenderProfile {
        &self.version.profile
    }

    /// BLAKE3 of the render profile's JSON.
    pub fn profile_hash(&self) -> blake3::Hash {
        self.version.profile_hash
    }

    /// Name of the backend that renders.
    pub fn backend(&self) -> &'static str {
        self.engine.backend()
    }

    /// The cameras that are rendered, in the order of the images.
    pub fn cameras(&self) -> &[RigCamera] {
        self.settings.layout.cameras()
    }

    /// The LiDARs, in the order of the sweeps of an observation.
    pub fn lidars(&self) -> &[RigLidar] {
        self.settings.layout.lidars()
    }

    /// The share of a camera's image that its lens sees; `None` if that is all of it.
    pub fn visible_share(&self, camera: usize) -> Option<f64> {
        self.settings.layout.visible_share(camera)
    }

    /// How colour images are encoded.
    pub fn encoding(&self) -> ImageEncoding {
        self.settings.layout.encoding()
    }

    /// Which maps come with every image.
    pub fn maps(&self) -> PixelMaps {
        self.settings.layout.maps()
    }

    /// Whether images come with their trust.
    pub fn trust(&self) -> bool {
        // With repair there is a coverage even if the client did not ask for the trust.
        let is_reported = self.settings.repair.as_ref().is_none_or(|repair| repair.reports_trust);
        self.version.coverage.is_some() && is_reported
    }

    /// The repair of its images, if it asked for it.
    pub fn repair(&self) -> Option<&SessionRepair> {
        self.settings.repair.as_deref()
    }

    /// Source of the images that its repair model compares with; `None` if it needs none.
    pub fn references(&self) -> Option<ReferenceSource> {
        self.version.references.as_ref().map(|references| references.source())
    }

    /// Effects of its sensors, if it asked for them.
    pub fn sensors(&self) -> Option<&Sensors> {
        self.settings.layout.sensors()
    }

    /// How the ego moves.
    pub fn dynamics(&self) -> Dynamics {
        self.settings.dynamics
    }

    /// `world_from_rig` where episodes start unless `reset` names another start.
    pub fn start(&self) -> Pose {
        self.settings.start.world_from_rig()
    }

    /// Length of the warm-up before the start, in microseconds.
    pub fn warm_up_us(&self) -> i64 {
        self.settings.warm_up_us
    }

    /// Number of the most recent frames of each camera that an observation has.
    pub fn frames(&self) -> usize {
        self.settings.layout.schedule().frames()
    }

    /// Pixels that its answer to a step counts towards
    /// [`limits::ANSWER_PIXELS`](crate::limits::ANSWER_PIXELS).
    pub fn step_pixels(&self) -> u64 {
        self.settings.layout.step_pixels()
    }

    /// Time between two frames of a camera, by its index, in microseconds.
    pub fn period_us(&self, camera: usize) -> i64 {
        self.settings.layout.schedule().period_us(camera)
    }

    /// Time between two observations with images, in microseconds.
    pub fn decision_us(&self) -> i64 {
        self.settings.layout.schedule().decision_us()
    }

    /// Simulated time of a step, in microseconds.
    pub fn dt_us(&self) -> i64 {
        self.settings.dt_us
    }

    /// Largest time for one answer.
    pub fn deadline(&self) -> Duration {
        self.settings.deadline
    }

    /// Its snapshots. They stay usable after the session ends, as long as this copy exists.
    pub fn snapshots(&self) -> &Snapshots {
        &self.snapshots
    }

    /// The actors and the route of the current episode; only with a scenario.
    pub fn traffic(&self) -> Option<&EpisodeTraffic> {
        self.state.traffic.as_ref()
    }

    /// Events of the last step or reset, by time.
    pub fn events(&self) -> &[Event] {
        self.state.traffic.as_ref().map_or(&self.state.events, EpisodeTraffic::events)
    }

    /// Whether observations contain the poses of the actors.
    pub fn reports_actors(&self) -> bool {
        self.settings.reports_actors
    }

    /// Name of the current episode's record; `None` before its first frame.
    pub fn episode_name(&self) -> Option<String> {
        self.recorder.as_ref().map(|_| format!("{}-{}", self.name, self.episode_number))
    }

    /// The current episode, as the last request left it.
    pub fn episode(&self) -> &Episode {
        &self.state.episode
    }
}
