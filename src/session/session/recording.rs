//! Writes the files of a session's episodes.

use wildcity_episode::{self as episode, ActorsLine, EventLine, ScenarioLine, scenario_line};
use wildcity_scene::Rig;

use super::Session;
use super::pending::{EpisodeFile, NewEpisode};
use crate::blocking::run_blocking;
use crate::engine::turns::Turn;
use crate::episode::{Episode, Outcome};
use crate::error::SessionError;
use crate::observe::builder::finish::RenderedObservation;
use crate::observe::encode::PixelMaps;
use crate::record::error::RecordError;
use crate::record::format::{
    BUILD, EpisodeHeader, FrameRecord, FrameRequest, Line, RecordedOrigin, RecordedOutputs,
    RecordedSettings, RecordedVersion,
};
use crate::record::recorder::{Account, NewFile, Recorder};
use crate::record::repairs::{RecordedImageRepair, RecordedRepair};
use crate::scenario::{EpisodeTraffic, Event, EventKind};
use crate::state::{EpisodeState, PinnedVersion, SessionSettings};

impl Session {
    /// Records a frame, unless the session records nothing, and returns the file if it was created
    /// for it: for a new episode, or for the first frame of one. `next` is the state after the
    /// request; `None` if it stays.
    pub(super) async fn record(
        &self,
        frame: FrameRecord,
        next: Option<&EpisodeState>,
        file: &EpisodeFile,
    ) -> Result<Option<NewFile>, SessionError> {
        if !self.settings.is_recorded {
            return Ok(None);
        }
        let is_first = self.recorder.is_none() || matches!(file, EpisodeFile::New(_));
        let before = &self.state;
        let traffic = next.and_then(|next| next.traffic.as_ref());
        let events = next.map_or(&[][..], |next| &next.events);
        // The first frame of a file also needs the actors of the state that it begins with.
        let shown = traffic.or(before.traffic.as_ref().filter(|_| is_first));
        let mut lines = simulation_lines(shown, events, &frame, is_first);
        lines.push(Line::Frame(frame));
        let created = match (file, self.recorder.clone()) {
            (EpisodeFile::New(new), _) => {
                let NewEpisode { version, origin, first, .. } = &**new;
                self.create_file(version, origin.clone(), traffic, first, lines).await?
            }
            (EpisodeFile::Same, Some(recorder)) => {
                // Together with the frame, so that a switch before a failed frame is not on record.
                let version = self.version_switched.then(|| self.version_line());
                append(recorder, version.into_iter().chain(lines).collect()).await?;
                return Ok(None);
            }
            (EpisodeFile::Same, None) => {
                let origin = self.origin.clone();
                // The state before the step: a replay begins with it, and executes the command of
                // the first frame.
                let traffic = before.traffic.as_ref();
                self.create_file(&self.version, origin, traffic, &before.episode, lines).await?
            }
        };
        Ok(Some(created))
    }

    /// The record of a rendered observation, without the command that led there.
    pub(super) fn frame_record(
        &self,
        request: FrameRequest,
        episode: &Episode,
        rendered: &RenderedObservation,
    ) -> FrameRecord {
        let RenderedObservation { observation, captures, hashes, repairs, .. } = rendered;
        let all_cameras = self.settings.layout.cameras().len();
        // Where the actors are in the warm-up depends on the time, and so do the effects of
        // sensors.
        let layout = &self.settings.layout;
        let is_timed = self.settings.scenario.is_some()
            || layout.sensors().is_some_and(|sensors| !sensors.cameras.is_empty());
        let needs_times = is_timed && captures.len() > 1;
        // The times at which frames were due are only needed where they differ.
        let is_other = captures.iter().any(|capture| capture.due_us != capture.time_us);
        let due_us = captures.iter().map(|capture| capture.due_us);
        let times_us = captures.iter().map(|capture| capture.time_us).collect();
        let mut cameras: Vec<_> = captures.iter().map(|capture| capture.cameras.clone()).collect();
        // All cameras at all poses are the usual case, which records leave out.
        if cameras.iter().all(|of_pose| of_pose.len() == all_cameras) {
            cameras.clear();
        }
        FrameRecord {
            request,
            step: episode.step(),
            time_us: episode.time_us(),
            poses: captures.iter().map(|capture| capture.world_from_rig).collect(),
            cameras,
            command: None,
            steps: 1,
            times_us: if needs_times { times_us } else { Vec::new() },
            due_us: if is_other { due_us.collect() } else { Vec::new() },
            notes: None,
            terminated: episode.terminated(),
            frame_hash: observation.frame_hash.to_hex().to_string(),
            images: hashes.iter().map(|hash| hash.to_hex().to_string()).collect(),
            sweeps: observation
                .sweeps
                .iter()
                .map(|sweep| sweep.hash.to_hex().to_string())
                .collect(),
            repairs: RecordedImageRepair::list(repairs),
        }
    }

    /// The line after which frames are rendered from another version of the twin.
    fn version_line(&self) -> Line {
        let version = &self.resident().version;
        Line::Version(RecordedVersion {
            step: self.state.episode.step(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: self.version.profile,
            profile_hash: self.version.profile_hash.to_hex().to_string(),
        })
    }

    /// Creates the file of an episode, with its header and its first frame. `episode` is the state
    /// before the step of this frame.
    async fn create_file(
        &self,
        pinned: &PinnedVersion,
        origin: Option<RecordedOrigin>,
        traffic: Option<&EpisodeTraffic>,
        episode: &Episode,
        first_lines: Vec<Line>,
    ) -> Result<NewFile, SessionError> {
        let version = &pinned.resident.version;
        let settings = &self.settings;
        let PixelMaps { depth, opacity, normals, instances, semantics } = settings.layout.maps();
        let cameras = settings.layout.cameras().to_vec();
        let header = EpisodeHeader {
            format: EpisodeHeader::FORMAT,
            build: BUILD.to_owned(),
            session: self.name.clone(),
            owner: self.owner.clone(),
            twin: version.manifest.twin.clone(),
            version: version.number,
            version_hash: version.hash.clone(),
            profile: pinned.profile,
            profile_hash: pinned.profile_hash.to_hex().to_string(),
            backend: self.engine.backend().to_owned(),
            backend_detail: self.engine.backend_detail(),
            rig: Rig {
                name: settings.rig_name.clone(),
                cameras,
                lidars: settings.layout.lidars().to_vec(),
            },
            outputs: RecordedOutputs {
                encoding: settings.layout.encoding(),
                depth,
                opacity,
                normals,
                instances,
                semantics,
            },
            seed: episode.seed(),
            dynamics: episode.ego().dynamics(),
            start: episode.world_from_rig(),
            dt_us: settings.dt_us,
            settings: recorded_settings(settings, self.trust()),
            repair: settings.repair.as_deref().map(RecordedRepair::from_repair),
            // A plain start follows from seed, dynamics and pose, which the header has anyway.
            state: (!episode.is_start_alone()).then(|| episode.clone()),
            origin,
            scenario: traffic.map(|traffic| traffic.loaded().hash.clone()),
        };
        let dir = self.engine.episodes().to_owned();
        let name = self.name.clone();
        // The first number to try; another server may have used it.
        let first_number = self.episode_number + 1;
        let account = Account {
            owner: self.owner.as_str().into(),
            quota: self.engine.record_quota().clone(),
        };
        let loaded = traffic.map(|traffic| traffic.loaded().clone());
        let version = version.clone();
        // The session may have switched it off.
        let checks_static = pinned.solids.is_some();
        let create = move || {
            // Here, because the line has the whole map.
            let scenario = loaded.map(|loaded| {
                let drives = &version.manifest.trajectories;
                let line =
                    scenario_line(&loaded.scenario, loaded.map.as_ref(), &loaded.hash, drives);
                Line::Scenario(Box::new(ScenarioLine { checks_static, ..line }))
            });
            let head = [Line::Episode(Box::new(header))].into_iter().chain(scenario);
            let lines: Vec<Line> = head.chain(first_lines).collect();
            logged(Recorder::create(&dir, &name, first_number, &lines, account))
        };
        Ok(run_blocking(create).await??)
    }

    /// Writes the last line of the episode's file, and lets it be exported. A failure is only
    /// logged: the episode is over either way.
    pub(super) async fn end_recording(&mut self, outcome: Outcome) {
        // Taken first, so that an episode never gets two ends.
        let Some(recorder) = self.recorder.take() else { return };
        let summary = self.state.episode.summary(outcome);
        let mut lines = Vec::new();
        if self.state.traffic.is_some() {
            let recorder = recorder.clone();
            let turn = self.engine.record_turn().await;
            // Without a result the record is still whole: `wildcity episode score` makes it again.
            let result = move |turn: Turn| {
                let result = recorder.result(&summary);
                drop(turn);
                result
            };
            if let Ok(turn) = turn
                && let Ok(Some(result)) = run_blocking(move || result(turn)).await
            {
                lines.push(Line::Result(result));
            }
        }
        lines.push(Line::End(summary));
        let record = recorder.path().to_owned();
        if let Err(error) = append(recorder, lines).await {
            tracing::warn!(session = self.name, "the episode's summary was not recorded: {error}");
        }
        // A record without an end is exported as well: it is as whole as it will be.
        self.engine.export(record);
    }
}

/// The lines before the frame of a request: with a scenario those of its traffic, otherwise its
/// events.
fn simulation_lines(
    traffic: Option<&EpisodeTraffic>,
    events: &[Event],
    frame: &FrameRecord,
    is_first: bool,
) -> Vec<Line> {
    match traffic {
        Some(traffic) => traffic_lines(traffic, frame, is_first),
        None => events.iter().map(|event| event_line(frame.step, event)).collect(),
    }
}

/// The lines before the frame of a request: the poses of the actors at each frame of a warm-up and
/// after each step, and the events. Before the first frame of a file also the poses in the earlier
/// steps that its frames show, as in a branch, or if the first request is not a reset.
fn traffic_lines(traffic: &EpisodeTraffic, frame: &FrameRecord, is_first: bool) -> Vec<Line> {
    let FrameRecord { step, steps, .. } = *frame;
    let warm_up_us = frame.times_us.iter().copied().filter(|time_us| *time_us < 0);
    let warm_up =
        warm_up_us.map(|time_us| ActorsLine::new(step, time_us, &traffic.states_before(time_us)));
    // The first frame of a file has all that the past holds, as its frames may show it. Otherwise
    // the past may hold fewer steps than were made.
    let count = traffic.last_steps(if is_first { usize::MAX } else { steps as usize }).count();
    // The last of the states is that of `step`.
    let before = (step + 1).saturating_sub(count as u64);
    let of_steps = (before..)
        .zip(traffic.last_steps(count))
        .map(|(step, (time_us, states))| ActorsLine::new(step, time_us, states));
    let actors = warm_up.chain(of_steps).map(Line::Actors);
    let events = traffic.events().iter().map(|event| event_line(step, event));
    actors.chain(events).collect()
}

fn event_line(step: u64, happened: &Event) -> Line {
    let event = match &happened.kind {
        EventKind::Contact(contact) => return Line::Event(EventLine::contact(step, contact)),
        EventKind::StaticContact { area_m2, impact_mps } => {
            episode::Event::StaticContact { area_m2: *area_m2, impact_mps: *impact_mps }
        }
        EventKind::OffModel { trust } => episode::Event::OffModel { trust: *trust },
        EventKind::Trigger { actor, trigger } => {
            episode::Event::Triggered { actor: *actor, trigger: *trigger as u32 }
        }
        EventKind::Appeared { actor } => episode::Event::Appeared { actor: *actor },
        EventKind::Left { actor } => episode::Event::Left { actor: *actor },
        EventKind::End(reason) => episode::Event::Ended { rule: reason.name().to_owned() },
    };
    Line::Event(EventLine { step, time_us: happened.time_us, event })
}

/// The settings that the header does not have otherwise; `None` if all are the defaults.
fn recorded_settings(settings: &SessionSettings, trust: bool) -> Option<RecordedSettings> {
    let recorded = RecordedSettings {
        profile_overrides: settings.profile_overrides.clone(),
        schedule: settings.layout.schedule().clone(),
        trust,
        warm_up_us: settings.warm_up_us,
        sensors: settings.layout.sensors().cloned(),
        contact: settings.contact,
    };
    let cameras = settings.layout.cameras().len();
    // Compared as a whole, so that a field which is added later is not forgotten.
    (recorded != RecordedSettings::with_defaults(cameras, settings.dt_us)).then_some(recorded)
}

async fn append(recorder: Recorder, lines: Vec<Line>) -> Result<(), SessionError> {
    Ok(run_blocking(move || logged(recorder.append(&lines))).await??)
}

/// Logs a failure for the operator, because the client may not report it.
fn logged<T>(recorded: Result<T, RecordError>) -> Result<T, RecordError> {
    recorded.inspect_err(|error| tracing::error!("{error}"))
}
