//! One agent's session: its state, and the requests that it answers.

mod recording;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{RigCamera, overlay_bytes};
use wildcity_scene::{ProfileOverrides, RenderProfile};
use wildcity_sim::{Command, Dynamics, Ego, Ground};
use wildcity_twin::residency::{PinnedScene, Reservation, Resident, RigExtent, Urgency, Viewpoint};

use crate::engine::{BudgetShare, Engine};
use crate::episode::{Episode, EpisodeSummary, Outcome};
use crate::error::SessionError;
use crate::limits;
use crate::observe::builder::{
    ObservationBuilder, ObservationLayout, RenderedObservation, RigCapture, viewpoints,
};
use crate::observe::encode::Encoding;
use crate::observe::frame_history::FrameHistory;
use crate::observe::observation::Observation;
use crate::observe::schedule::Schedule;
use crate::observe::trust::TrainingCoverage;
use crate::options::{
    Outputs, PixelMaps, SessionOptions, Start, Track, choose_cameras, resolve_start,
};
use crate::prefetch::forecast::{self, EgoForecast, RecordedDrive};
use crate::prefetch::latest_task::LatestTask;
use crate::record::format::{self, FrameRequest, Line, RecordedCommand, Recorder};

/// One agent's session on a twin: on one version of it, until the agent asks for another.
#[derive(Debug)]
pub struct Session {
    engine: Arc<Engine>,
    reservation: Reservation,
    prefetching: LatestTask,
    name: String,
    /// What of every version's profile is otherwise, and the profile that comes of it.
    changes: ProfileOverrides,
    profile: RenderProfile,
    profile_hash: blake3::Hash,
    rig_name: String,
    layout: Arc<ObservationLayout>,
    /// The part of what lies over its images in the budget for answers.
    _overlays: BudgetShare,
    dynamics: Dynamics,
    /// How episodes get to their start unless `reset` says otherwise.
    start: Track,
    warm_up_us: i64,
    dt_us: i64,
    deadline: Duration,
    episode: Episode,
    /// The episode's frames that later observations show again.
    album: FrameHistory,
    /// Number of the current episode's file, and the file once something was rendered.
    episode_number: u64,
    recorder: Option<Recorder>,
    /// The file does not say yet that what follows is of this version.
    switched: bool,
    /// The recorded drive that the agent may follow, and where it says that it goes.
    route: Option<Arc<RecordedDrive>>,
    /// Where the twin was recorded, if observations say how far they may be believed.
    trained: Option<Arc<TrainingCoverage>>,
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
        opening: SessionOptions,
    ) -> Result<Self, SessionError> {
        let dt_us = opening.dt_us.unwrap_or(limits::DT_US);
        let dt_limits_us = limits::DT_MIN_US..=limits::DT_MAX_US;
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
        let (chosen_of, rig, outputs) = (resident.clone(), opening.rig, opening.outputs.clone());
        // Overlays that are made smaller or larger take a second at worst.
        let chosen =
            tokio::task::spawn_blocking(move || choose_cameras(&chosen_of, rig, &outputs)).await;
        let (rig_name, cameras) = chosen.map_err(|_| SessionError::Crashed)??;
        let Outputs { encoding, maps, frames, periods_us, trust, .. } = opening.outputs;
        let overlays = engine.answers().hold(overlay_bytes(&cameras))?;
        let lens = lens(&cameras);
        let schedule = Schedule::new(&cameras, dt_us, frames, &periods_us, opening.decision_us)?;
        let layout = ObservationLayout::new(cameras, encoding, maps, schedule)?;
        let (dynamics, warm_up_us) = (opening.dynamics, opening.warm_up_us);
        let start = settled(&resident, opening.start.as_ref(), warm_up_us, dynamics)?;
        let named = match &opening.start {
            Some(Start::Station { trajectory, .. }) => Some(trajectory),
            _ => None,
        };
        let mut logs = manifest.trajectories.iter();
        let route = logs.find(|log| named.is_none_or(|name| log.name == *name));
        let route = route.map(|log| Arc::new(RecordedDrive::new(log)));
        let changes = opening.profile;
        let profile = changes.apply(manifest.profile)?;
        Engine::bake(resident.clone(), profile).await?;
        let trained = match trust {
            true => Some(trained(&resident).await?),
            false => None,
        };
        let reservation = Engine::reserve(resident.clone(), lens, profile).await?;
        let session = Self {
            profile_hash: format::profile_hash(&profile),
            changes,
            profile,
            rig_name,
            layout: Arc::new(layout),
            _overlays: overlays,
            episode: episode(opening.seed, &start, dynamics, dt_us),
            dynamics,
            start,
            warm_up_us,
            dt_us,
            deadline,
            album: FrameHistory::default(),
            episode_number: 0,
            recorder: None,
            switched: false,
            prefetching: LatestTask::default(),
            engine,
            reservation,
            name,
            route,
            trained,
            hint: Vec::new(),
            last_frame: Instant::now(),
            // As fast as the clock, until it is known.
            frame_took: Duration::from_micros(dt_us.unsigned_abs()),
        };
        // The first look is likely to be at the start: it is loaded while the agent thinks.
        session.expect(vec![(Urgency::Imminent, session.start())]);
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
    ) -> Result<Observation, SessionError> {
        let command = command.into();
        let ground = Ground::from_drives(&self.resident().version.manifest.trajectories);
        let mut next = self.episode.stepped(&command, &ground, terminate)?;
        let shots = self.layout.shots(&next, &self.album);
        let drawing = self.draw(&next, shots, Some(self.album.clone())).await?;
        let mut line = self.frame_line(FrameRequest::Step, &next, &drawing);
        line.command = RecordedCommand::of(&command);
        self.record(line).await?;
        next.judged(drawing.trusts());
        (self.episode, self.album) = (next, drawing.album);
        self.look_ahead();
        Ok(drawing.frame)
    }

    /// Renders 1 to `limits::OBSERVE_POSES` poses (`world_from_rig`) without moving.
    ///
    /// # Errors
    /// As [`Session::step`].
    pub async fn observe(&mut self, poses: Vec<Pose>) -> Result<Observation, SessionError> {
        if !(1..=limits::OBSERVE_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), limits::OBSERVE_POSES);
            return Err(SessionError::OutOfRange { field: "poses", must });
        }
        let episode = self.episode.clone();
        let shots = self.layout.looks(&episode, poses);
        let drawing = self.draw(&episode, shots, None).await?;
        self.record(self.frame_line(FrameRequest::Observe, &episode, &drawing)).await?;
        Ok(drawing.frame)
    }

    /// Starts a new episode at `start`, or where the session started, and renders it.
    ///
    /// # Errors
    /// As [`Session::step`]: the old episode goes on.
    pub async fn reset(
        &mut self,
        seed: u64,
        start: Option<Start>,
    ) -> Result<Observation, SessionError> {
        let start = match &start {
            Some(_) => settled(self.resident(), start.as_ref(), self.warm_up_us, self.dynamics)?,
            None => self.start.clone(),
        };
        let mut next = episode(seed, &start, self.dynamics, self.dt_us);
        let shots = self.layout.shots(&next, &FrameHistory::default());
        let drawing = self.draw(&next, shots, Some(FrameHistory::default())).await?;
        let line = self.frame_line(FrameRequest::Reset, &next, &drawing);
        let (recorder, number) = self.begin_recording(&next, Line::Frame(line)).await?;
        self.finish(Outcome::Completed).await;
        next.judged(drawing.trusts());
        (self.recorder, self.episode_number, self.switched) = (Some(recorder), number, false);
        (self.episode, self.album) = (next, drawing.album);
        self.hint.clear();
        self.look_ahead();
        Ok(drawing.frame)
    }

    /// Loads what is seen from 1 to `limits::PREFETCH_POSES` poses (`world_from_rig`), and between
    /// them, as far as there is room: where the agent may go next, in order. Does not wait for it.
    ///
    /// # Errors
    /// There are too many poses, or none.
    pub fn prefetch(&mut self, poses: Vec<Pose>) -> Result<(), SessionError> {
        if !(1..=limits::PREFETCH_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), limits::PREFETCH_POSES);
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
        let profile = self.changes.apply(resident.version.manifest.profile)?;
        Engine::bake(resident.clone(), profile).await?;
        let bytes = Engine::worst_case_bytes(resident.clone(), lens, profile).await?;
        let trained = match &self.trained {
            Some(_) => Some(trained(&resident).await?),
            None => None,
        };
        // From here on, nothing waits: the switch happens as a whole.
        self.reservation.exchange(resident, bytes)?;
        self.trained = trained;
        (self.profile, self.profile_hash) = (profile, format::profile_hash(&profile));
        self.switched = true;
        let mut places = vec![(Urgency::Imminent, self.episode.world_from_rig())];
        places.extend(self.ahead().places());
        self.expect(places);
        Ok(())
    }

    /// Ends the session and tells how its last episode went.
    pub async fn close(mut self, outcome: Outcome) -> EpisodeSummary {
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
    pub fn viewpoints(&self) -> Vec<Viewpoint> {
        viewpoints(&View::of_rig(self.layout.cameras(), self.episode.world_from_rig()))
    }

    /// The memory that is set aside for its worst frame, in bytes.
    pub fn reserved_bytes(&self) -> u64 {
        self.reservation.bytes()
    }

    /// How it is rendered: the version's profile with the changes that it was opened with.
    pub fn profile(&self) -> &RenderProfile {
        &self.profile
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
    pub fn visible_share(&self, camera: usize) -> Option<f64> {
        self.layout.visible_share(camera)
    }

    /// How colour images travel.
    pub fn encoding(&self) -> Encoding {
        self.layout.encoding()
    }

    /// What observations hold beside colours.
    pub fn maps(&self) -> PixelMaps {
        self.layout.maps()
    }

    /// Whether observations say how far they may be believed.
    pub fn trust(&self) -> bool {
        self.trained.is_some()
    }

    /// How the ego moves.
    pub fn dynamics(&self) -> Dynamics {
        self.dynamics
    }

    /// `world_from_rig` where episodes start unless `reset` says otherwise.
    pub fn start(&self) -> Pose {
        self.start.last().map_or(Pose::IDENTITY, |&(_, start)| start)
    }

    /// How much of the recorded drive lies before the start, in microseconds.
    pub fn warm_up_us(&self) -> i64 {
        self.warm_up_us
    }

    /// Last frames of each camera that an observation holds.
    pub fn frames(&self) -> usize {
        self.layout.schedule().frames()
    }

    /// Time between two frames of a camera, by its index, in microseconds.
    pub fn period_us(&self, camera: usize) -> i64 {
        self.layout.schedule().period_us(camera)
    }

    /// Time between two observations with images, in microseconds.
    pub fn decision_us(&self) -> i64 {
        self.layout.schedule().decision_us()
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

    /// Renders shots one after the other, each in its turn among the other sessions' frames.
    async fn draw(
        &self,
        episode: &Episode,
        shots: Vec<RigCapture>,
        album: Option<FrameHistory>,
    ) -> Result<RenderedObservation, SessionError> {
        let deadline = Instant::now() + self.deadline;
        let answers = self.engine.answers();
        let mut assembly = ObservationBuilder::new(self.layout.clone(), answers, episode, &shots)?;
        assembly.judge(self.trained.clone());
        for shot in shots {
            if shot.cameras.is_empty() {
                assembly.add_shot(shot);
                continue;
            }
            let views = self.layout.views(episode, &shot);
            // Before the job is queued: no render thread waits for a disk.
            let pinned = self.pin(deadline, viewpoints(&views)).await?;
            let (waited_for, waited) = (pinned.waited_for, pinned.waited);
            let profile = self.profile;
            let (drawn, queued) = self
                .engine
                .run(deadline, move |scratch, backend| {
                    let drawn = assembly.draw(&pinned, &profile, backend, (&shot, &views), scratch);
                    assembly.add_shot(shot);
                    drawn.map(|()| assembly)
                })
                .await?;
            assembly = drawn?;
            assembly.add_queue_time(queued);
            assembly.add_waiting(waited_for, waited);
        }
        let (held_bytes, limit_bytes) = self.resident().memory();
        assembly.finish(album, held_bytes, limit_bytes)
    }

    /// Loads what the next steps will need, while the agent thinks.
    fn look_ahead(&mut self) {
        self.frame_took = self.last_frame.elapsed();
        self.last_frame = Instant::now();
        self.hint = forecast::rest(&self.hint, self.episode.world_from_rig()).to_vec();
        self.expect(self.ahead().places());
    }

    /// What is known of where the ego goes.
    fn ahead(&self) -> EgoForecast<'_> {
        let (least, most) = limits::PREFETCH_AHEAD;
        let ahead = (3 * self.resident().load_p99()).clamp(least, most);
        let steps = ahead.as_secs_f64() / self.frame_took.as_secs_f64().max(1e-3);
        EgoForecast {
            now: self.episode.world_from_rig(),
            last_step_m: self.episode.ego().velocity_m_s() * (self.dt_us as f64 * 1e-6),
            steps: (steps.ceil() as usize).min(limits::STEPS_AHEAD),
            route: self.route.as_deref(),
            hint: &self.hint,
        }
    }

    /// Has what is seen from some places loaded by others.
    fn expect(&self, places: Vec<(Urgency, Pose)>) {
        let (prefetcher, layout) = (self.reservation.prefetcher().clone(), self.layout.clone());
        let profile = self.profile;
        self.prefetching.submit(move || {
            let eyes_at =
                |(urgency, pose)| (urgency, viewpoints(&View::of_rig(layout.cameras(), pose)));
            let places: Vec<_> = places.into_iter().map(eyes_at).collect();
            prefetcher.prefetch(&places, &profile);
        });
    }

    /// Waits until everything that a frame needs is in memory, all at once.
    async fn pin(
        &self,
        deadline: Instant,
        eyes: Vec<Viewpoint>,
    ) -> Result<PinnedScene, SessionError> {
        let (reply, answer) = oneshot::channel();
        let (resident, profile) = (self.resident().clone(), self.profile);
        let ask = move || {
            let done = Box::new(move |pinned| {
                // Nobody waits any more: the deadline has passed.
                let _ = reply.send(pinned);
            });
            resident.request(&eyes, &profile, done)
        };
        let request =
            tokio::task::spawn_blocking(ask).await.map_err(|_| SessionError::Crashed)??;
        match timeout_at(deadline, answer).await {
            Ok(Ok(pinned)) => Ok(pinned?),
            Ok(Err(_)) => Err(SessionError::Crashed),
            Err(_) => Err(request.timeout_error().into()),
        }
    }
}

/// What of a rig decides how much memory its frames need.
fn lens(cameras: &[RigCamera]) -> RigExtent {
    let eyes = viewpoints(&View::of_rig(cameras, Pose::IDENTITY));
    RigExtent {
        focal_px: eyes.iter().fold(0.0, |most, eye| eye.focal_px.max(most)),
        radius_m: eyes.iter().fold(0.0, |most, eye| eye.position_m.length().max(most)),
    }
}

/// A start where the ego stands on the ground, and how it gets there.
fn settled(
    resident: &Resident,
    start: Option<&Start>,
    warm_up_us: i64,
    dynamics: Dynamics,
) -> Result<Track, SessionError> {
    let mut track = resolve_start(resident, start, warm_up_us)?;
    let ground = Ground::from_drives(&resident.version.manifest.trajectories);
    if let Some((_, start)) = track.last_mut() {
        *start = dynamics.start_pose(*start, &ground);
    }
    Ok(track)
}

/// An episode at its start.
fn episode(seed: u64, track: &[(i64, Pose)], dynamics: Dynamics, dt_us: i64) -> Episode {
    let (start, warm_up) = track.split_last().map_or((Pose::IDENTITY, track), |(s, w)| (s.1, w));
    Episode::warmed_up(seed, Ego::new(dynamics, start), warm_up, dt_us)
}

/// Where a twin was recorded and trained.
async fn trained(resident: &Arc<Resident>) -> Result<Arc<TrainingCoverage>, SessionError> {
    let resident = resident.clone();
    // Half a million keyframes and blocks of a long drive take a while.
    let built =
        tokio::task::spawn_blocking(move || TrainingCoverage::new(&resident.version.manifest));
    let trained = built.await.map_err(|_| SessionError::Crashed)?;
    trained.map(Arc::new).ok_or_else(|| {
        let must = "true, and the twin has no recorded drive to compare with".to_owned();
        SessionError::OutOfRange { field: "outputs.trust", must }
    })
}
