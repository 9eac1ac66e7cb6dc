//! The requests that are answered with images (step, observe, reset), and close.
//!
//! Each request first renders, then records, and only then changes the session. If it fails or its
//! future is dropped before that, the session is unchanged, and the client can repeat the request.

use serde_json::Value;
use tokio::time::{Instant, timeout_at};
use tracing::{Instrument as _, debug_span};

use wildcity_options::{ContactMode, DynamicsChoice, DynamicsModel, Start};
use wildcity_render::{Backend, Frame};
use wildcity_scene::geometry::Pose;
use wildcity_sim::scenario::EndReason;
use wildcity_sim::{Command, Dynamics, Ego, Ground};

use super::Session;
use super::pending::{EpisodeFile, NewEpisode, Pending};
use crate::blocking::{Stop, run_blocking, run_until};
use crate::contact::TwinSolids;
use crate::engine::render_queue::{FrameCost, Scratch};
use crate::episode::{Episode, EpisodeSummary, Outcome};
use crate::error::SessionError;
use crate::limits;
use crate::observe::builder::ObservationBuilder;
use crate::observe::builder::finish::RenderedObservation;
use crate::observe::builder::repair::ObservationRepair;
use crate::observe::frame_history::FrameHistory;
use crate::observe::layout::RigCapture;
use crate::observe::observation::Observation;
use crate::pin::pin;
use crate::record::command::RecordedCommand;
use crate::record::format::FrameRequest;
use crate::scenario::assets::FrameDetail;
use crate::scenario::{EpisodeScenario, EpisodeTraffic, Event, EventKind, settle};
use crate::spatial_index::SpatialIndex;
use crate::start::{EpisodeStart, checked_pose};
use crate::state::{EpisodeState, PinnedVersion};
use crate::viewpoint::viewpoints;

/// Options of a step in addition to its command.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepOptions {
    /// Duration for which the command is followed, in microseconds: a whole number of steps; one
    /// step if absent.
    pub until_us: Option<i64>,
    /// Whether the episode ends with it.
    pub terminate: bool,
    /// Notes of the agent, for the record.
    pub notes: Option<Value>,
}

/// Changes by `reset` for its episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResetOptions {
    /// Seed of the episode.
    pub seed: u64,
    /// Where it starts; the session's start if absent.
    pub start: Option<Start>,
    /// How the ego moves; the session's dynamics if absent.
    pub dynamics: Option<DynamicsChoice>,
    /// Speed at the start, in m/s, in place of that of the dynamics.
    pub speed_m_s: Option<f64>,
}

/// State that a frame shows in addition to the twin: the ego and its past, and the actors.
#[derive(Clone, Copy)]
pub(super) struct SimulationState<'a> {
    pub(super) episode: &'a Episode,
    pub(super) traffic: Option<&'a EpisodeTraffic>,
}

/// What the steps of a request meet.
struct Meetings {
    /// The contacts with the twin that begin in each step.
    contacts: Vec<Vec<Event>>,
    /// When the ego first is off the trained area, in microseconds, and the trust of its pose.
    off_model: Option<(i64, f64)>,
}

/// A session after the steps of a request, before anything is rendered.
struct Simulated {
    episode: Episode,
    traffic: Option<EpisodeTraffic>,
    met: Meetings,
}

impl Session {
    /// Moves the ego by one step of `dt_us` and renders.
    ///
    /// # Errors
    /// The session is then unchanged, and the step can be repeated. If the future is dropped, the
    /// step may be on record, but the session is unchanged as well.
    pub async fn step(
        &mut self,
        command: impl Into<Command>,
        terminate: bool,
    ) -> Result<Observation, SessionError> {
        self.follow(command.into(), StepOptions { terminate, ..StepOptions::default() }).await
    }

    /// Moves the ego by one or more steps of `dt_us` along a plan, and renders at its end: the
    /// frames of that time, and the frames since the start of the plan that the observation shows.
    ///
    /// # Errors
    /// As [`Session::step`], and if the notes or the number of steps are out of range.
    pub async fn follow(
        &mut self,
        command: Command,
        options: StepOptions,
    ) -> Result<Observation, SessionError> {
        let steps = self.plan_steps(&command, options.until_us)?;
        check_notes(options.notes.as_ref())?;
        // Before the deadline begins: to open a newer version is no part of the step.
        self.follow_latest().await;
        let deadline = Instant::now() + self.settings.deadline;
        let now = &self.state.episode;
        let Simulated { episode: mut next, mut traffic, met } =
            self.simulated(command.clone(), steps, options.terminate, deadline).await?;
        let mut events = Vec::new();
        match &traffic {
            Some(traffic) => {
                if let Some(reason) = traffic.ended() {
                    next.end(reason);
                }
            }
            None => {
                events = met.contacts.into_iter().flatten().collect();
                if !events.is_empty() && self.contact_mode(&next) == ContactMode::End {
                    next.end(EndReason::Contact);
                    let kind = EventKind::End(EndReason::Contact);
                    events.push(Event { time_us: next.time_us(), kind });
                }
            }
        }

        // A copy: the session keeps its own until the step is on record.
        let frame_history = self.state.frame_history.clone();
        let captures = self.settings.layout.captures(&next, &frame_history);
        let simulation = SimulationState { episode: &next, traffic: traffic.as_ref() };
        let rendered =
            self.render(&self.version, simulation, captures, Some(frame_history), deadline).await?;
        // An ego that failed first has not left the area by what came after.
        let failure_us = next.is_failed().then(|| match &traffic {
            // Only the end tells which of the contacts the scenario judges.
            Some(traffic) => {
                let is_end = |event: &&Event| matches!(event.kind, EventKind::End(_));
                traffic.events().iter().find(is_end).map(|event| event.time_us)
            }
            // Without a scenario, any contact fails, and the first one did.
            None => events.iter().map(|event| event.time_us).min(),
        });
        let left = left_model(&mut next, met.off_model, &rendered, failure_us.flatten());
        if let Some(event) = left {
            add_event(traffic.as_mut(), &mut events, event);
        }
        settle(&mut events);

        let mut record = self.frame_record(FrameRequest::Step, &next, &rendered);
        // With a delay, the pose at the end is not the one that was commanded, so that every
        // command is on record.
        record.command = if now.is_delayed() {
            Some(RecordedCommand::from_command(&command))
        } else {
            RecordedCommand::new(&command)
        };
        record.notes = options.notes;
        if steps > 1 {
            record.steps = steps as u64;
            // Without them, frames before the last one would count as those of a warm-up.
            record.times_us = rendered.captures.iter().map(|capture| capture.time_us).collect();
        }
        next.set_repair_state(rendered.repair_state);
        let frame_history = rendered.frame_history;
        let next = EpisodeState { episode: next, frame_history, traffic, events };
        let file = EpisodeFile::Same;
        let observation = rendered.observation;
        Pending { next: Some(next), record, file, observation }.commit(self).await
    }

    /// The session after some steps along a command. Off the threads that answer requests, until a
    /// deadline: 256 actors take a second for ten, and the twin may have to be read.
    async fn simulated(
        &self,
        command: Command,
        steps: usize,
        terminate: bool,
        deadline: Instant,
    ) -> Result<Simulated, SessionError> {
        let dt_us = self.settings.dt_us;
        let traffic = self.state.traffic.clone();
        // Long simulations take turns, so that they leave processors to all others.
        let work = traffic.as_ref().map_or(0, |traffic| traffic.work(dt_us * steps as i64));
        let turn = self.engine.simulation_turn(work, deadline).await?;
        let now = self.state.episode.clone();
        let index = self.version.index.clone();
        let solids = self.version.solids.clone();
        run_until(deadline, move |stop| {
            let _turn = turn;
            let lanes = traffic.as_ref().and_then(|traffic| traffic.loaded().lanes());
            let drives = &index.version().manifest.trajectories;
            let ground = Ground::from_drives(drives).with_boxes(index.boxes()).and_lanes(lanes);
            let (episode, egos) = now.followed(&command, steps, &ground, terminate)?;
            // Each part may take long, so that a stop is looked for between them.
            stop.refusal()?;
            let met = meetings(&now, &egos, solids.as_ref(), &index, dt_us, stop)?;
            stop.refusal()?;
            let traffic = traffic
                .map(|traffic| traffic.followed(now.ego(), &egos, dt_us, &met.contacts, stop))
                .transpose()?;
            Ok(Simulated { episode, traffic, met })
        })
        .await
    }

    /// What contact with the twin does in an episode without a scenario.
    fn contact_mode(&self, episode: &Episode) -> ContactMode {
        let model = episode.ego().dynamics().model;
        // A teleported ego is not stopped by what it meets: it is often put into places where no
        // car drives.
        let is_teleported = model == DynamicsModel::Teleport;
        let default = if is_teleported { ContactMode::Report } else { ContactMode::End };
        self.settings.contact.unwrap_or(default)
    }

    /// Number of steps of a plan that is followed for `until_us`.
    fn plan_steps(&self, command: &Command, until_us: Option<i64>) -> Result<usize, SessionError> {
        let dt_us = self.settings.dt_us;
        let Some(until_us) = until_us else { return Ok(1) };
        let refused = |must: String| SessionError::OutOfRange { field: "until_us", must };
        // A single step may be longer than the longest plan.
        let most_us =
            dt_us.saturating_mul(limits::PLAN_STEPS as i64).min(limits::PLAN_US.max(dt_us));
        if !(dt_us..=most_us).contains(&until_us) || until_us % dt_us != 0 {
            return Err(refused(format!(
                "{until_us} µs; whole steps of {dt_us} µs up to {most_us} µs are accepted"
            )));
        }
        if matches!(command, Command::Pose(_)) && until_us > dt_us {
            let must =
                "several steps, and a pose is reached with one: send a trajectory or an action";
            return Err(refused(format!("{until_us} µs, {must}")));
        }
        // At most `PLAN_STEPS`.
        Ok((until_us / dt_us) as usize)
    }

    /// Renders from 1 to [`limits::OBSERVE_POSES`] poses (`world_from_rig`) without moving the ego.
    ///
    /// # Errors
    /// As [`Session::step`].
    pub async fn observe(&mut self, poses: Vec<Pose>) -> Result<Observation, SessionError> {
        if !(1..=limits::OBSERVE_POSES).contains(&poses.len()) {
            let must = format!("{}; 1 to {} are accepted", poses.len(), limits::OBSERVE_POSES);
            return Err(SessionError::OutOfRange { field: "poses", must });
        }
        let episode = &self.state.episode;
        let captures = self.settings.layout.captures_at(episode, poses);
        let simulation = SimulationState { episode, traffic: self.state.traffic.as_ref() };
        let deadline = Instant::now() + self.settings.deadline;
        let rendered = self.render(&self.version, simulation, captures, None, deadline).await?;
        let record = self.frame_record(FrameRequest::Observe, episode, &rendered);
        let file = EpisodeFile::Same;
        Pending { next: None, record, file, observation: rendered.observation }.commit(self).await
    }

    /// Starts a new episode at `start`, or where the session started, and renders it.
    ///
    /// # Errors
    /// As [`Session::step`]; the old episode goes on.
    pub async fn reset(
        &mut self,
        seed: u64,
        start: Option<Start>,
    ) -> Result<Observation, SessionError> {
        self.reset_with(ResetOptions { seed, start, ..ResetOptions::default() }).await
    }

    /// As [`Session::reset`], with dynamics for only this episode.
    ///
    /// # Errors
    /// As [`Session::reset`], and if the speed is out of range.
    pub async fn reset_with(&mut self, options: ResetOptions) -> Result<Observation, SessionError> {
        self.follow_latest().await;
        let settings = &self.settings;
        let ResetOptions { seed, start, dynamics, speed_m_s } = options;
        // Before the dynamics, as in the order of the request's fields.
        if let Some(Start::Pose { pose }) = &start {
            checked_pose(*pose)?;
        }
        let mut dynamics = match dynamics {
            Some(asked) => Dynamics::try_from(wildcity_options::Dynamics::from(asked))?,
            None => settings.dynamics,
        };
        if let Some(speed_m_s) = speed_m_s {
            dynamics = dynamics.with_speed("speed", speed_m_s)?;
        }
        // With a scenario, the seed decides jitter, and perhaps the start.
        let loaded = match &settings.scenario {
            None => None,
            Some(scenario) => {
                let scenario = scenario.clone();
                let version = self.resident().version.clone();
                let engine = self.engine.clone();
                let find = move |_: &Stop| scenario.for_episode(seed, &version, &engine);
                Some(self.engine.in_scenario_turn(find).await?)
            }
        };
        // The request, then the session's random start, then the scenario. Without any, the
        // session's start.
        let start = start
            .or_else(|| settings.random_start.clone().map(|random| Start::Random { random }))
            .or_else(|| settings.scenario.as_ref()?.start(&loaded.as_ref()?.loaded));
        let manifest = &self.resident().version.manifest;
        let lanes = loaded.as_ref().and_then(|found| found.loaded.lanes());
        let start = match &start {
            // Dynamics decide whether a start is placed on the ground.
            None if dynamics.model == settings.dynamics.model => settings.start.clone(),
            None => {
                let boxes = self.version.index.boxes();
                let drives = Ground::from_drives(&manifest.trajectories).with_boxes(boxes);
                let ground = drives.and_lanes(lanes);
                settings.start.placed(&ground, dynamics)
            }
            Some(start) => EpisodeStart::resolve(
                manifest,
                Some(start),
                settings.warm_up_us,
                dynamics,
                seed,
                lanes,
            )
            .map_err(|error| error.into_reset_error(Some(start)))?,
        };
        let mut next = start
            .episode(seed, dynamics, settings.dt_us)
            .with_sensors(settings.layout.episode_sensors());
        let exposure_us = settings.layout.longest_exposure_us();
        let mut traffic = loaded.map(|EpisodeScenario { loaded, assets }| {
            EpisodeTraffic::at_start(loaded, assets, next.ego(), exposure_us)
                .with_reach(next.reach_us())
        });

        let frame_history = FrameHistory::default();
        let captures = self.settings.layout.captures(&next, &frame_history);
        let simulation = SimulationState { episode: &next, traffic: traffic.as_ref() };
        let deadline = Instant::now() + self.settings.deadline;
        let rendered =
            self.render(&self.version, simulation, captures, Some(frame_history), deadline).await?;
        // Judged like every later pose, so that an episode can begin outside of the area.
        let trust = self.version.index.recorded().map(|at| at.trust(&next.world_from_rig()));
        let off_model =
            trust.filter(|trust| *trust < limits::OFF_MODEL_TRUST).map(|trust| (0, trust));
        let left = left_model(&mut next, off_model, &rendered, None);
        let mut events = Vec::new();
        if let Some(event) = left {
            add_event(traffic.as_mut(), &mut events, event);
        }

        let record = self.frame_record(FrameRequest::Reset, &next, &rendered);
        let version = self.version.clone();
        let new = NewEpisode { version, memory: None, origin: None, first: next.clone() };
        next.set_repair_state(rendered.repair_state);
        let frame_history = rendered.frame_history;
        let next = EpisodeState { episode: next, frame_history, traffic, events };
        let file = EpisodeFile::New(Box::new(new));
        let observation = rendered.observation;
        Pending { next: Some(next), record, file, observation }.commit(self).await
    }

    /// Ends the session and summarizes its last episode.
    pub async fn close(mut self, outcome: Outcome) -> EpisodeSummary {
        let summary = self.end(outcome).await;
        self.free().await;
        summary
    }

    /// Ends the episode, and completes its record.
    pub async fn end(&mut self, outcome: Outcome) -> EpisodeSummary {
        self.end_recording(outcome).await;
        self.state.episode.summary(outcome)
    }

    /// Frees all memory of the session, and returns when the next one has it.
    pub async fn free(self) {
        // Millions of small values may be freed, which must not hold up an async thread. A panic
        // would only lose memory.
        let _ = run_blocking(move || drop(self)).await;
    }

    /// Renders captures of a version one after the other, each scheduled among the other sessions'
    /// frames.
    ///
    /// With a history, the observation also shows its earlier frames; without one (`observe`), it
    /// does not.
    pub(super) async fn render(
        &self,
        version: &PinnedVersion,
        simulation: SimulationState<'_>,
        captures: Vec<RigCapture>,
        history: Option<FrameHistory>,
        deadline: Instant,
    ) -> Result<RenderedObservation, SessionError> {
        let SimulationState { episode, .. } = simulation;
        let layout = &self.settings.layout;
        // Poses that the ego is not at have no sweeps, and neither have times between decisions.
        let is_shown = history.is_some() && captures.last().is_some_and(|capture| capture.shown);
        let sweeps = if is_shown && !layout.lidars().is_empty() {
            Some(self.sweeps(version, simulation, deadline).await?)
        } else {
            None
        };
        let mut builder = ObservationBuilder::new(
            layout.clone(),
            self.engine.answer_budget(),
            version.coverage.clone(),
            episode,
            &captures,
            sweeps.as_ref().map_or(&[][..], |sweeps| &sweeps.clouds),
        )?
        .with_repair(self.settings.repair.clone().map(|repair| {
            // Without history, the poses are not the ego's, and no state of the repair is kept.
            let state = history.is_some().then(|| episode.repair_state());
            ObservationRepair::new(repair, layout.cameras().len(), state)
        }));
        for (sections, waited, queued) in sweeps.into_iter().flat_map(|sweeps| sweeps.loads) {
            builder.add_load(sections, waited);
            builder.add_queue_time(queued);
        }
        for capture in captures {
            // All cameras, or one after the other if there is only memory for one view's scene.
            for cameras in capture.cameras.chunks(self.views_at_once(version)) {
                let part = RigCapture { cameras: cameras.to_vec(), ..capture.clone() };
                builder = self.render_part(version, simulation, part, builder, deadline).await?;
            }
            // Also if nothing is due: the observation has a time and a history.
            // Before the repair, which looks at the last capture.
            builder.add_capture(capture);
            if builder.has_candidates() {
                if let Some(references) = &version.references {
                    builder = self.find_references(version, references, builder, deadline).await?;
                }
                let repaired = run_blocking(move || builder.repair().map(|()| builder))
                    .instrument(debug_span!("repair"));
                // A model that hangs ends with its own timeout; the session does not wait for it
                // longer than for a frame.
                let in_time = timeout_at(deadline, repaired).await;
                builder = in_time.map_err(|_| SessionError::DeadlineExceeded)???;
            }
        }
        let (held_bytes, limit_bytes) = version.resident.memory();
        builder.finish(history, held_bytes, limit_bytes)
    }

    /// Most views that a frame of a version may draw at a time.
    fn views_at_once(&self, version: &PinnedVersion) -> usize {
        // The memory for another version is reserved after its first frame.
        if self.settings.may_split() && !version.has_same_version(&self.version) {
            return 1;
        }
        self.reservation.views_at_once()
    }

    /// Renders the cameras of a part of a capture, in one frame.
    async fn render_part(
        &self,
        version: &PinnedVersion,
        simulation: SimulationState<'_>,
        part: RigCapture,
        mut builder: ObservationBuilder,
        deadline: Instant,
    ) -> Result<ObservationBuilder, SessionError> {
        let SimulationState { episode, traffic } = simulation;
        let layout = &self.settings.layout;
        let views = layout.views(episode, &part);
        let viewpoints = viewpoints(&views);
        let profile = version.profile;
        let placed = traffic.map(|traffic| {
            let exposures_us = &layout.exposures_us(&part);
            let detail = FrameDetail { viewpoints: &viewpoints, exposures_us, profile: &profile };
            traffic.placed(part.time_us, detail)
        });
        // Load before the job is queued, so that no render thread waits for a disk.
        let resident = version.resident.clone();
        let mut pinned =
            pin(resident, profile, deadline, viewpoints).instrument(debug_span!("load")).await?;
        pinned.place(placed.unwrap_or_default());
        builder.add_load(pinned.waited_for, pinned.waited);
        let cost = FrameCost::new(self.slot.number(), &views, &profile);
        // The builder goes to the render thread with the work, and comes back with the result.
        let work = move |scratch: &mut Scratch, backend: &dyn Backend| {
            let frame = Frame { scene: &pinned, profile: &profile, views: &views };
            builder.render(&part, &frame, backend, scratch).map(|()| builder)
        };
        let (rendered, queued) = self.engine.run(cost, deadline, work).await?;
        let mut rendered = rendered?;
        rendered.add_queue_time(queued);
        Ok(rendered)
    }
}

/// What an ego meets of the twin while it goes through `egos`, and whether it leaves the trained
/// area.
fn meetings(
    now: &Episode,
    egos: &[Ego],
    solids: Option<&TwinSolids>,
    index: &SpatialIndex,
    dt_us: i64,
    stop: &Stop,
) -> Result<Meetings, SessionError> {
    let begin_us = now.time_us();
    let contacts = match solids {
        Some(solids) => solids.contacts(now.ego(), egos, begin_us, dt_us, stop)?,
        None => vec![Vec::new(); egos.len()],
    };
    // An ego that has left the area once is not looked for again.
    let recorded = index.recorded().filter(|_| !now.is_off_model());
    // Lazy, so that the search ends at the first pose that is off.
    let mut trusts = egos.iter().zip(1..).filter_map(|(ego, step)| {
        Some((begin_us + step * dt_us, recorded?.trust(&ego.world_from_rig())))
    });
    let off_model = trusts.find(|(_, trust)| *trust < limits::OFF_MODEL_TRUST);
    Ok(Meetings { contacts, off_model })
}

/// Adds an event to those of the traffic, or without a scenario to `events`.
fn add_event(traffic: Option<&mut EpisodeTraffic>, events: &mut Vec<Event>, event: Event) {
    match traffic {
        Some(traffic) => traffic.add_event(event),
        None => events.push(event),
    }
}

/// The event that an episode leaves the area that the twin was trained on, by a pose or by the
/// images of an observation; `None` if it does not, or has left it before, or failed before.
fn left_model(
    next: &mut Episode,
    off_model: Option<(i64, f64)>,
    rendered: &RenderedObservation,
    failed_us: Option<i64>,
) -> Option<Event> {
    // First of all, because the least trust counts every observation.
    let of_images = next.add_trusts(rendered.trusts());
    let is_low = of_images.filter(|trust| *trust < limits::OFF_MODEL_TRUST);
    // The poses of all steps come before the images of the last one.
    let (time_us, trust) = off_model.or(is_low.map(|trust| (next.time_us(), trust)))?;
    // At the same time, the failure counts.
    if next.is_off_model() || failed_us.is_some_and(|failed_us| failed_us <= time_us) {
        return None;
    }
    next.leave_model();
    Some(Event { time_us, kind: EventKind::OffModel { trust } })
}

fn check_notes(notes: Option<&Value>) -> Result<(), SessionError> {
    let bytes = notes.map_or(0, |notes| notes.to_string().len());
    if bytes > limits::NOTES_BYTES {
        let must = format!("{bytes} bytes of JSON; at most {} are accepted", limits::NOTES_BYTES);
        return Err(SessionError::OutOfRange { field: "notes", must });
    }
    Ok(())
}
