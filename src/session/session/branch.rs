//! Snapshots: a session returns to them, and other sessions begin from them, or from a step of a
//! recorded episode. A branch that gets the same commands as its original gives the same bytes.

use std::sync::Arc;

use tokio::time::Instant;

use wildcity_scene::rig::overlay_bytes;

use super::Session;
use super::open::{frame_bytes, layout_extent, prepare, rig_extent, solid_ego};
use super::pending::{EpisodeFile, NewEpisode, Pending};
use super::requests::SimulationState;
use crate::blocking::run_blocking;
use crate::engine::Engine;
use crate::engine::answer_budget::BudgetShare;
use crate::error::SessionError;
use crate::observe::encode::PixelMaps;
use crate::observe::layout::ObservationLayout;
use crate::observe::observation::Observation;
use crate::record::branch_error::BranchError;
use crate::record::continuation::{Continuation, KeptFrames};
use crate::record::format::{FrameRequest, RecordedOrigin, RecordedSettings};
use crate::snapshot::Snapshot;
use crate::start::EpisodeStart;
use crate::state::{EpisodeState, SessionSettings};

/// Name of the snapshot of the state in which a branch was opened.
const FIRST_SNAPSHOT: &str = "start";

impl Session {
    /// Stores the present state under a name, in place of an earlier snapshot of that name.
    ///
    /// # Errors
    /// There are too many snapshots, or too little memory for the state.
    pub fn take_snapshot(&self, name: String) -> Result<(), SessionError> {
        let share =
            self.engine.answer_budget().reserve(self.state.copied_bytes()).map_err(|_| {
                SessionError::Busy { what: "too little memory is left for snapshots" }
            })?;
        self.snapshots.store(name, self.present(share))
    }

    fn present(&self, share: BudgetShare) -> Snapshot {
        let step = self.state.episode.step();
        // Without a file, no frame of this episode is on record: a branch has the origin that the
        // episode has.
        let recorded = self.recorder.as_ref().map(|_| RecordedOrigin {
            episode: format!("{}-{}", self.name, self.episode_number),
            step,
        });
        Snapshot {
            settings: self.settings.clone(),
            version: self.version.clone(),
            state: self.state.clone(),
            origin: recorded.or_else(|| self.origin.clone()),
            _share: share,
        }
    }

    /// Returns to a snapshot, and renders it. This restores the state of the session: version of
    /// the twin, ego, time, frames of bundles. Later steps are recorded in a new file.
    ///
    /// # Errors
    /// There is no such snapshot; otherwise as [`Session::step`].
    pub async fn restore(&mut self, name: &str) -> Result<Observation, SessionError> {
        // The snapshot stays as it is, even if another one takes its name meanwhile.
        let snapshot = self.snapshots.find("name", name)?;
        let Snapshot { version, state, origin, .. } = &*snapshot;
        let mut episode = state.episode.clone();

        // The frames of the present are rendered again, since the history has only those of them
        // that later observations show.
        let layout = &self.settings.layout;
        let earlier = state.frame_history.before(episode.time_us());
        let captures = layout.captures(&episode, &earlier);
        let simulation = SimulationState { episode: &episode, traffic: state.traffic.as_ref() };
        let deadline = Instant::now() + self.settings.deadline;
        let rendered = self.render(version, simulation, captures, Some(earlier), deadline).await?;
        // Another version needs other memory for its worst frame.
        let mut memory = None;
        if !version.has_same_version(&self.version) {
            let resident = version.resident.clone();
            let extent = layout_extent(layout);
            let may_split = self.settings.may_split();
            let scenes = Engine::scene_bytes(resident, extent, version.profile, may_split).await?;
            memory = Some((scenes, frame_bytes(&self.engine, layout, version)));
        }

        let record = self.frame_record(FrameRequest::Restore, &episode, &rendered);
        let new = NewEpisode {
            version: version.clone(),
            memory,
            origin: origin.clone(),
            first: episode.clone(),
        };
        // Only for the least trust: whether the ego has left the area was decided when this state
        // was reached.
        let _mean = episode.add_trusts(rendered.trusts());
        episode.set_repair_state(rendered.repair_state);
        // After a switch of version, the frames of the present are as the original has them.
        let frame_history = state.frame_history.clone().or(&rendered.frame_history);
        let next = EpisodeState { episode, frame_history, ..state.clone() };
        let file = EpisodeFile::New(Box::new(new));
        let observation = rendered.observation;
        Pending { next: Some(next), record, file, observation }.commit(self).await
    }

    /// Opens a session in the state of another one's snapshot, with its settings. The new session
    /// has that state as its snapshot `start`.
    ///
    /// # Errors
    /// There is not enough memory for its worst frame.
    pub async fn branch(
        engine: Arc<Engine>,
        name: String,
        from: &Snapshot,
    ) -> Result<Self, SessionError> {
        let Snapshot { settings, version, state, origin, .. } = from;
        let extent = layout_extent(&settings.layout);
        let frame = frame_bytes(&engine, &settings.layout, version);
        // Memory for its own frames: a branch lives on without the session that it comes from.
        let resident = version.resident.clone();
        let scenes =
            Engine::scene_bytes(resident, extent, version.profile, settings.may_split()).await?;
        let reservation = version.resident.reserve_scenes(scenes, frame)?;
        let mut session = Self::assembled(
            engine,
            name,
            settings.clone(),
            reservation,
            version.clone(),
            state.clone(),
        );
        session.origin.clone_from(origin);
        session.take_snapshot(FIRST_SNAPSHOT.to_owned())?;
        Ok(session)
    }

    /// Reads the record of an episode up to its step `step`, for [`Session::continued`]. The caller
    /// has checked the name with [`is_episode_name`](crate::is_episode_name).
    ///
    /// # Errors
    /// There is no such record, it is damaged, or it has fewer steps.
    pub async fn recorded(
        engine: &Engine,
        episode: &str,
        step: u64,
    ) -> Result<Continuation, SessionError> {
        let path = engine.episodes().join(format!("{episode}.jsonl"));
        let origin = RecordedOrigin { episode: episode.to_owned(), step };
        let turn = engine.record_turn().await?;
        run_blocking(move || Continuation::read(&path, origin, turn)).await?
    }

    /// Opens a session in the state that a recorded episode had after one of its steps, with its
    /// settings. The new session has that state as its snapshot `start`.
    ///
    /// Executes the recorded commands again, and renders the frames that coming bundles show.
    ///
    /// # Errors
    /// The poses and frames of the record differ from those of this build, twin and backend.
    pub async fn continued(
        engine: Arc<Engine>,
        name: String,
        mut continuation: Continuation,
    ) -> Result<Self, SessionError> {
        let deadline = engine.step_timeout();
        let origin = continuation.origin().clone();
        // All of them before the drive, which runs on a thread that cannot wait for them.
        for number in continuation.versions() {
            let twin = continuation.twin().to_owned();
            continuation.add_version(engine.open_version(twin, Some(number)).await?)?;
        }

        // The settings of the recorded session.
        let header = continuation.header().clone();
        if header.scenario.is_some() {
            return Err(BranchError::Scenario.into());
        }
        if header.repair.is_some() {
            return Err(BranchError::Repair.into());
        }
        let cameras = header.rig.cameras;
        let recorded = match header.settings {
            Some(settings) => settings,
            None => RecordedSettings::with_defaults(cameras.len(), header.dt_us),
        };
        // The file may have been changed, so that its values are checked as those of a request are.
        recorded.schedule.check(cameras.len(), header.dt_us)?;
        let overlays = engine.answer_budget().reserve(overlay_bytes(&cameras))?;
        let extent = rig_extent(&cameras, &header.rig.lidars);
        let outputs = header.outputs;
        let maps = PixelMaps {
            depth: outputs.depth,
            opacity: outputs.opacity,
            normals: outputs.normals,
            instances: outputs.instances,
            semantics: outputs.semantics,
        };
        let mut layout =
            ObservationLayout::new(cameras, outputs.encoding, maps, recorded.schedule)?
                .with_lidars(header.rig.lidars);
        if let Some(sensors) = recorded.sensors {
            layout.add_sensors(sensors, header.dt_us)?;
        }
        let layout = Arc::new(layout);
        let settings = SessionSettings {
            profile_overrides: recorded.profile_overrides,
            rig_name: header.rig.name,
            layout: layout.clone(),
            _overlays: overlays,
            dynamics: header.dynamics,
            start: EpisodeStart::recorded(header.start, header.state.as_ref()),
            random_start: None,
            warm_up_us: recorded.warm_up_us,
            dt_us: header.dt_us,
            deadline,
            // Only prefetching follows it, and a record does not name it.
            drive: None,
            scenario: None,
            reports_actors: false,
            repair: None,
            contact: recorded.contact,
            solid_ego: solid_ego(recorded.contact, None),
            is_recorded: true,
            follows_latest: false,
        };

        // The state after the step, and the frames that coming observations show again.
        let driven = run_blocking(move || continuation.drive(&layout)).await??;
        let coverage_for = recorded.trust.then_some("outputs.trust");
        let version = prepare(
            &engine,
            driven.version.clone(),
            driven.profile,
            coverage_for,
            settings.solid_ego,
        )
        .await?;
        let frame = frame_bytes(&engine, &settings.layout, &version);
        let may_split = settings.may_split();
        let resident = driven.version.clone();
        let scenes = Engine::scene_bytes(resident, extent, driven.profile, may_split).await?;
        let reservation = driven.version.reserve_scenes(scenes, frame)?;
        // A record with a scenario was refused, so that there is no traffic.
        let state = EpisodeState::at_start(driven.episode.clone());
        let mut session =
            Self::assembled(engine, name, Arc::new(settings), reservation, version, state);
        session.origin = Some(origin);
        session.render_kept(driven.kept, &header.backend).await?;
        session.take_snapshot(FIRST_SNAPSHOT.to_owned())?;
        Ok(session)
    }

    /// Renders the frames of a recorded episode that coming observations show again.
    async fn render_kept(
        &mut self,
        kept: Vec<KeptFrames>,
        recorded_by: &str,
    ) -> Result<(), SessionError> {
        // In the order in which they were taken, each with the state and the version of its time.
        for KeptFrames { episode, version, profile, frames } in kept {
            let coverage_for = self.version.coverage.as_ref().map(|_| "outputs.trust");
            let version = prepare(&self.engine, version, profile, coverage_for, None).await?;
            let history = Some(self.state.frame_history.clone());
            let captures = frames.iter().map(|frame| frame.capture.clone()).collect();
            let simulation = SimulationState { episode: &episode, traffic: None };
            let deadline = Instant::now() + self.settings.deadline;
            let rendered = self.render(&version, simulation, captures, history, deadline).await?;
            // Each capture has one camera, so that hashes and frames correspond.
            for (frame, now) in frames.iter().zip(&rendered.hashes) {
                if now.to_hex().as_str() != frame.hash {
                    let camera = self.cameras()[frame.camera].name.clone();
                    let time_us = frame.capture.time_us;
                    let recorded_by = recorded_by.to_owned();
                    let backend = self.backend().to_owned();
                    return Err(BranchError::Image { camera, time_us, recorded_by, backend }.into());
                }
            }
            self.state.frame_history = rendered.frame_history;
        }
        Ok(())
    }
}
