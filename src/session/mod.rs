//! Episodes: reset, step, observe, record, replay.
//!
//! An [`Engine`] is what all sessions share; a [`Session`] is one agent's use of it. A request
//! renders, is recorded, and only then changes the session: whatever fails on the way, nothing has
//! happened, and the request can be sent again.

mod ahead;
mod buffer;
mod encode;
mod engine;
mod episode;
mod error;
mod golden;
mod leases;
mod listing;
mod lookout;
mod observation;
mod opening;
mod record;
mod replay;
mod retrace;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use crate::config;
use crate::geometry::Pose;
use crate::render::View;
use crate::residency::{Eye, Lens, Pinned, Reservation, Resident, Urgency};
use crate::scene::rig::{Rig, RigCamera};
use crate::sim::{Command, Dynamics, Ego, Ground};

pub use buffer::Buffer;
pub use encode::Encoding;
pub(crate) use encode::{jpeg, png};
pub use engine::{Engine, EngineSettings, HeldLatest};
pub use episode::{Episode, History, Outcome, Summary};
pub use error::SessionError;
pub use golden::{Changed, Golden};
pub use listing::{TrajectorySummary, TwinSummary};
pub use observation::{
    DType, Frame, HEADER_PREFIX_BYTES, Image, Residency, Tensor, TensorKind, Timings,
};
pub use opening::{ImagePart, Opening, Outputs, RigChoice, Start};
pub use record::{
    EpisodeHeader, FrameRecord, FrameRequest, RecordError, RecordedCommand, RecordedOutputs,
    RecordedVersion,
};
pub use replay::{Change, Difference, Extent, Recording, Redrawn, ReplayError, Report};
pub use retrace::StrayedStep;

use ahead::{Ahead, Route};
use lookout::Lookout;
pub(crate) use observation::eyes;
use observation::{Assembly, Layout};
use opening::{choose_cameras, resolve_start};
use record::{Line, Recorder};

/// One agent's session on a twin: on one version of it, until the agent asks for another.
#[derive(Debug)]
pub struct Session {
    engine: Arc<Engine>,
    reservation: Reservation,
    lookout: Lookout,
    name: String,
    profile_hash: blake3::Hash,
    rig_name: String,
    layout: Arc<Layout>,
    dynamics: Dynamics,
    start: Pose,
    dt_us: i64,
    deadline: Duration,
    episode: Episode,
    /// Number of the current episode's file, and the file once something was rendered.
    episode_number: u64,
    recorder: Option<Recorder>,
    /// The file does not say yet that what follows is of this version.
    switched: bool,
    /// The recorded drive that the agent may follow, and where it says that it goes.
    route: Option<Arc<Route>>,
    hint: Vec<Pose>,
    /// When the last frame was ready, and how long after the one before.
    last_frame: Instant,
    frame_took: Duration,
}

impl Session {
    /// Opens a session, and sets aside the memory for its worst frame.
    ///
    /// # Errors
    /// Names the first field of `opening` that cannot be had; nothing was opened then.
    pub async fn open(
        engine: Arc<Engine>,
        name: String,
        opening: Opening,
    ) -> Result<Self, SessionError> {
        let dt_us = opening.dt_us.unwrap_or(config::DT_US);
        let dt_limits_us = config::DT_MIN_US..=config::DT_MAX_US;
        if !dt_limits_us.contains(&dt_us) {
            let must = format!("{dt_us} µs; {dt_limits_us:?} µs are accepted");
            return Err(SessionError::OutOfRange { field: "dt_us", must });
        }
        let longest = engine.step_timeout();
        let deadline = opening.deadline.unwrap_or(longest);
        if deadline.is_zero() || deadline > longest {
            let must = format!("{deadline:?}; up to {longest:?} are accepted, and more than zero");
            return Err(SessionError::OutOfRange { field: "deadline_ms", must });
        }
        let resident = engine.resident(opening.twin, opening.version).await?;
        let manifest = &resident.version.manifest;
        let (rig_name, cameras) = choose_cameras(&resident, opening.rig, &opening.outputs)?;
        let Outputs { encoding, depth, opacity, .. } = opening.outputs;
        let lens = lens(&cameras);
        let layout = Layout::new(cameras, encoding, depth, opacity)?;
        let start = match &opening.start {
            Some(start) => resolve_start(&resident, start)?,
            None => manifest.trajectories.first().map_or(Pose::IDENTITY, |log| log.at_station(0.0)),
        };
        let dynamics = opening.dynamics;
        let start = dynamics.start(start, &Ground::of(&manifest.trajectories));
        let named = match &opening.start {
            Some(Start::Station { trajectory, .. }) => Some(trajectory),
            _ => None,
        };
        let mut logs = manifest.trajectories.iter();
        let route = logs.find(|log| named.is_none_or(|name| log.name == *name));
        let route = route.map(|log| Arc::new(Route::new(log)));
        let reservation = Engine::reserve(resident.clone(), lens).await?;
        let session = Self {
            profile_hash: record::profile_hash(&manifest.profile),
            rig_name,
            layout: Arc::new(layout),
            dynamics,
            start,
            dt_us,
            deadline,
            episode: Episode::new(opening.seed, Ego::new(dynamics, start), dt_us),
            episode_number: 0,
            recorder: None,
            switched: false,
            lookout: Lookout::default(),
            engine,
            reservation,
            name,
            route,
            hint: Vec::new(),
            last_frame: Instant::now(),
            // As fast as the clock, until it is known.
            frame_took: Duration::from_micros(dt_us.unsigned_abs()),
        };
        // The first look is likely to be at the start: it is loaded while the agent thinks.
        session.expect(vec![(Urgency::Imminent, start)]);
        Ok(session)
    }

    /// Moves the ego as it is told, lets `dt_us` pass and renders.
    ///
    /// # Errors
    /// Nothing has changed then, and the step can be tried again. Dropping the future may record
    /// the step but never takes it.
    pub async fn step(
        &mut self,
        command: impl Into<Command>,
        terminate: bool,
    ) -> Result<Frame, SessionError> {
        let command = command.into();
        let ground = Ground::of(&self.resident().version.manifest.trajectories);
        let next = self.episode.stepped(&command, &ground, terminate)?;
        let pose = next.world_from_rig();
        let frame = self.draw(&next, vec![pose]).await?;
        let mut line = frame_line(FrameRequest::Step, &next, &[pose], &frame);
        line.command = RecordedCommand::of(&command);
        self.record(line).await?;
        self.episode = next;
        self.look_ahead();
        Ok(frame)
    }

    /// Renders 1 to `config::OBSERVE_POSES` poses (`world_from_rig`) without moving.
    ///
    /// # Errors
    /// As [`Session::step`].
    pub async fn observe(&mut self, poses: Vec<Pose>) -> Result<Frame, SessionError> {
        if !(1..=config::OBSERVE_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), config::OBSERVE_POSES);
            return Err(SessionError::OutOfRange { field: "poses", must });
        }
        let episode = self.episode.clone();
        let frame = self.draw(&episode, poses.clone()).await?;
        self.record(frame_line(FrameRequest::Observe, &episode, &poses, &frame)).await?;
        Ok(frame)
    }

    /// Starts a new episode at `start`, or where the session started, and renders it.
    ///
    /// # Errors
    /// As [`Session::step`]: the old episode goes on.
    pub async fn reset(&mut self, seed: u64, start: Option<Start>) -> Result<Frame, SessionError> {
        let start = match &start {
            Some(start) => {
                let ground = Ground::of(&self.resident().version.manifest.trajectories);
                self.dynamics.start(resolve_start(self.resident(), start)?, &ground)
            }
            None => self.start,
        };
        let next = Episode::new(seed, Ego::new(self.dynamics, start), self.dt_us);
        let frame = self.draw(&next, vec![start]).await?;
        let line = frame_line(FrameRequest::Reset, &next, &[start], &frame);
        let (recorder, number) = self.begin_recording(&next, Line::Frame(line)).await?;
        self.finish(Outcome::Completed).await;
        (self.recorder, self.episode_number, self.switched) = (Some(recorder), number, false);
        self.episode = next;
        self.hint.clear();
        self.look_ahead();
        Ok(frame)
    }

    /// Loads what is seen from 1 to `config::PREFETCH_POSES` poses (`world_from_rig`), and between
    /// them, as far as there is room: where the agent may go next, in order. Does not wait for it.
    ///
    /// # Errors
    /// There are too many poses, or none.
    pub fn prefetch(&mut self, poses: Vec<Pose>) -> Result<(), SessionError> {
        if !(1..=config::PREFETCH_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), config::PREFETCH_POSES);
            return Err(SessionError::OutOfRange { field: "poses", must });
        }
        self.hint = poses;
        self.expect(self.ahead().places());
        Ok(())
    }

    /// Sees another version of the twin from now on, or its latest; the episode goes on. It is on
    /// record with the next frame, so that a switch that fails or is dropped leaves no trace.
    ///
    /// # Errors
    /// The version cannot be had: the session stays with its own.
    pub async fn switch_version(&mut self, version: Option<u64>) -> Result<(), SessionError> {
        let now = &self.resident().version;
        let resident = self.engine.resident(now.manifest.twin.clone(), version).await?;
        if resident.version.number == now.number {
            return Ok(());
        }
        let lens = lens(self.layout.cameras());
        let bytes = Engine::worst_bytes(resident.clone(), lens).await?;
        // From here on, nothing waits: the switch happens as a whole.
        self.reservation.exchange(resident, bytes)?;
        self.profile_hash = record::profile_hash(&self.resident().version.manifest.profile);
        self.switched = true;
        let mut places = vec![(Urgency::Imminent, self.episode.world_from_rig())];
        places.extend(self.ahead().places());
        self.expect(places);
        Ok(())
    }

    /// Ends the session and tells how its last episode went.
    pub async fn close(mut self, outcome: Outcome) -> Summary {
        self.finish(outcome).await;
        self.episode.summary(outcome)
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The twin's version.
    pub fn resident(&self) -> &Arc<Resident> {
        self.reservation.resident()
    }

    /// What its next frame needs, if it stays where it is.
    pub fn eyes(&self) -> Vec<Eye> {
        eyes(&View::of_rig(self.layout.cameras(), self.episode.world_from_rig()))
    }

    /// The memory that is set aside for its worst frame, in bytes.
    pub fn reserved_bytes(&self) -> u64 {
        self.reservation.bytes()
    }

    /// BLAKE3 of the render profile's JSON.
    pub fn profile_hash(&self) -> blake3::Hash {
        self.profile_hash
    }

    /// Name of the backend that renders.
    pub fn backend(&self) -> &'static str {
        self.engine.backend()
    }

    /// The cameras that are rendered, in the order of the images.
    pub fn cameras(&self) -> &[RigCamera] {
        self.layout.cameras()
    }

    /// The share of a camera's image that its lens sees, where that is not all of it.
    pub fn seen(&self, camera: usize) -> Option<f64> {
        self.layout.seen(camera)
    }

    /// How colour images travel.
    pub fn encoding(&self) -> Encoding {
        self.layout.encoding()
    }

    /// Whether observations hold depth, and whether opacity.
    pub fn depth_and_opacity(&self) -> (bool, bool) {
        self.layout.depth_and_opacity()
    }

    /// How the ego moves.
    pub fn dynamics(&self) -> Dynamics {
        self.dynamics
    }

    /// `world_from_rig` where episodes start unless `reset` says otherwise.
    pub fn start(&self) -> Pose {
        self.start
    }

    /// Simulated time of a step, in microseconds.
    pub fn dt_us(&self) -> i64 {
        self.dt_us
    }

    /// How long one answer may take.
    pub fn deadline(&self) -> Duration {
        self.deadline
    }

    /// The current episode.
    pub fn episode(&self) -> &Episode {
        &self.episode
    }

    /// Renders poses one after the other, each in its turn among the other sessions' frames.
    async fn draw(&self, episode: &Episode, poses: Vec<Pose>) -> Result<Frame, SessionError> {
        let deadline = Instant::now() + self.deadline;
        let mut assembly =
            Assembly::new(self.layout.clone(), self.engine.answers(), episode, poses.len())?;
        for world_from_rig in poses {
            let views = episode.views(self.layout.cameras(), world_from_rig);
            // Before the job is queued: no render thread waits for a disk.
            let pinned = self.pin(deadline, eyes(&views)).await?;
            let (waited_for, waited) = (pinned.waited_for, pinned.waited);
            let profile = self.resident().version.manifest.profile;
            let (drawn, queued) = self
                .engine
                .run(deadline, move |scratch, backend| {
                    assembly.draw(&pinned, &profile, backend, &views, scratch).map(|()| assembly)
                })
                .await?;
            assembly = drawn?;
            assembly.add_queue_time(queued);
            assembly.add_waiting(waited_for, waited);
        }
        let (held_bytes, limit_bytes) = self.resident().memory();
        assembly.finish(held_bytes, limit_bytes)
    }

    /// Loads what the next steps will need, while the agent thinks.
    fn look_ahead(&mut self) {
        self.frame_took = self.last_frame.elapsed();
        self.last_frame = Instant::now();
        self.hint = ahead::rest(&self.hint, self.episode.world_from_rig()).to_vec();
        self.expect(self.ahead().places());
    }

    /// What is known of where the ego goes.
    fn ahead(&self) -> Ahead<'_> {
        let (least, most) = config::PREFETCH_AHEAD;
        let ahead = (3 * self.resident().load_p99()).clamp(least, most);
        let steps = ahead.as_secs_f64() / self.frame_took.as_secs_f64().max(1e-3);
        Ahead {
            now: self.episode.world_from_rig(),
            last_step_m: self.episode.ego().velocity_m_s() * (self.dt_us as f64 * 1e-6),
            steps: (steps.ceil() as usize).min(config::STEPS_AHEAD),
            route: self.route.as_deref(),
            hint: &self.hint,
        }
    }

    /// Has what is seen from some places loaded by others.
    fn expect(&self, places: Vec<(Urgency, Pose)>) {
        let (expectation, layout) = (self.reservation.expectation().clone(), self.layout.clone());
        self.lookout.look(move || {
            let eyes_at = |(urgency, pose)| (urgency, eyes(&View::of_rig(layout.cameras(), pose)));
            let places: Vec<_> = places.into_iter().map(eyes_at).collect();
            let profile = &expectation.resident().version.manifest.profile;
            expectation.prefetch(&places, profile);
        });
    }

    /// Waits until everything that a frame needs is in memory, all at once.
    async fn pin(&self, deadline: Instant, eyes: Vec<Eye>) -> Result<Pinned, SessionError> {
        let (reply, answer) = oneshot::channel();
        let resident = self.resident().clone();
        let ask = move || {
            let done = Box::new(move |pinned| {
                // Nobody waits any more: the deadline has passed.
                let _ = reply.send(pinned);
            });
            resident.ask(&eyes, &resident.version.manifest.profile, done)
        };
        let ticket =
            tokio::task::spawn_blocking(ask).await.map_err(|_| SessionError::Crashed)??;
        match timeout_at(deadline, answer).await {
            Ok(Ok(pinned)) => Ok(pinned?),
            Ok(Err(_)) => Err(SessionError::Crashed),
            Err(_) => Err(ticket.late().into()),
        }
    }

    /// Writes what was rendered to the episode's file, which begins with its first frame.
    async fn record(&mut self, frame: FrameRecord) -> Result<(), SessionError> {
        let line = Line::Frame(frame);
        match self.recorder.clone() {
            Some(recorder) => {
                let version = self.switched.then(|| self.version_line());
                append(recorder, version.into_iter().chain([line]).collect()).await?;
            }
            None => {
                let (recorder, number) = self.begin_recording(&self.episode, line).await?;
                (self.recorder, self.episode_number) = (Some(recorder), number);
            }
        }
        self.switched = false;
        Ok(())
    }

    /// Says that what follows is of this version.
    fn version_line(&self) -> Line {
        let version = &self.resident().version;
        Line::Version(RecordedVersion {
            step: self.episode.step(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: version.manifest.profile,
            profile_hash: self.profile_hash.to_hex().to_string(),
        })
    }

    /// Begins the file of an episode that has not moved yet, with its first frame.
    async fn begin_recording(
        &self,
        episode: &Episode,
        first_frame: Line,
    ) -> Result<(Recorder, u64), SessionError> {
        let version = &self.resident().version;
        let (depth, opacity) = self.layout.depth_and_opacity();
        let cameras = self.layout.cameras().to_vec();
        let header = EpisodeHeader {
            format: EpisodeHeader::FORMAT,
            build: record::BUILD.to_owned(),
            session: self.name.clone(),
            twin: version.manifest.twin.clone(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: version.manifest.profile,
            profile_hash: self.profile_hash.to_hex().to_string(),
            backend: self.engine.backend().to_owned(),
            backend_detail: self.engine.backend_detail(),
            rig: Rig { name: self.rig_name.clone(), cameras },
            outputs: RecordedOutputs { encoding: self.layout.encoding(), depth, opacity },
            seed: episode.seed(),
            dynamics: self.dynamics,
            start: episode.world_from_rig(),
            dt_us: self.dt_us,
        };
        let (dir, name) = (self.engine.episodes().to_owned(), self.name.clone());
        let (first_number, lines) =
            (self.episode_number + 1, [Line::Episode(Box::new(header)), first_frame]);
        let created = tokio::task::spawn_blocking(move || {
            Recorder::create(&dir, &name, first_number, &lines)
        });
        let created = created.await;
        Ok(created.map_err(|_| SessionError::Crashed)??)
    }

    /// Writes the last line. The episode is over either way: a failure is only logged.
    async fn finish(&mut self, outcome: Outcome) {
        let Some(recorder) = self.recorder.take() else { return };
        if let Err(error) = append(recorder, vec![Line::End(self.episode.summary(outcome))]).await {
            tracing::warn!(session = self.name, "the episode's summary is missing: {error}");
        }
    }
}

/// What of a rig decides how much memory its frames need.
fn lens(cameras: &[RigCamera]) -> Lens {
    let eyes = eyes(&View::of_rig(cameras, Pose::IDENTITY));
    Lens {
        focal_px: eyes.iter().fold(0.0, |most, eye| eye.focal_px.max(most)),
        radius_m: eyes.iter().fold(0.0, |most, eye| eye.position_m.length().max(most)),
    }
}

async fn append(recorder: Recorder, lines: Vec<Line>) -> Result<(), SessionError> {
    let appended = tokio::task::spawn_blocking(move || recorder.append(&lines)).await;
    Ok(appended.map_err(|_| SessionError::Crashed)??)
}

fn frame_line(
    request: FrameRequest,
    episode: &Episode,
    poses: &[Pose],
    frame: &Frame,
) -> FrameRecord {
    FrameRecord {
        request,
        step: episode.step(),
        time_us: episode.time_us(),
        poses: poses.to_vec(),
        command: None,
        terminated: episode.terminated(),
        frame_hash: frame.frame_hash.to_hex().to_string(),
        images: frame.images.iter().map(|image| image.hash.to_hex().to_string()).collect(),
    }
}
