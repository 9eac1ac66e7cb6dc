//! The requests that are answered with images: step, observe, reset. And close.
//!
//! Each request first renders, then records, and only then changes the session. If it fails or its future
//! is dropped before that, nothing has happened, and the client can repeat it.

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use wildcity_render::{Backend, Frame};
use wildcity_scene::geometry::Pose;
use wildcity_sim::{Command, Ground};
use wildcity_twin::residency::{PinnedScene, Viewpoint};

use super::Session;
use crate::blocking::run_blocking;
use crate::engine::render_queue::Scratch;
use crate::episode::{Episode, EpisodeSummary, Outcome};
use crate::error::SessionError;
use crate::limits;
use crate::observe::builder::ObservationBuilder;
use crate::observe::builder::finish::RenderedObservation;
use crate::observe::frame_history::FrameHistory;
use crate::observe::layout::RigCapture;
use crate::observe::observation::Observation;
use crate::options::Start;
use crate::record::format::{FrameRequest, Line, RecordedCommand};
use crate::start::EpisodeStart;
use crate::viewpoint::viewpoints;

impl Session {
    /// Moves the ego by one step of `dt_us` and renders.
    ///
    /// # Errors
    /// The step has not happened then and can be repeated. If the future is dropped, the step may be on
    /// record but has not happened either.
    pub async fn step(
        &mut self,
        command: impl Into<Command>,
        terminate: bool,
    ) -> Result<Observation, SessionError> {
        let command = command.into();
        let ground = Ground::from_drives(&self.resident().version.manifest.trajectories);
        let mut next = self.episode.stepped(&command, &ground, terminate)?;

        let captures = self.layout.captures(&next, &self.frame_history);
        let rendered = self.render(&next, captures, Some(self.frame_history.clone())).await?;

        let mut record = self.frame_record(FrameRequest::Step, &next, &rendered);
        record.command = RecordedCommand::of(&command);
        self.record(record).await?;

        next.add_trusts(rendered.trusts());
        self.episode = next;
        self.frame_history = rendered.frame_history;
        self.look_ahead();
        Ok(rendered.observation)
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
        let episode = self.episode.clone();
        let captures = self.layout.captures_at(&episode, poses);
        let rendered = self.render(&episode, captures, None).await?;
        self.record(self.frame_record(FrameRequest::Observe, &episode, &rendered)).await?;
        Ok(rendered.observation)
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
        let start = match &start {
            Some(_) => EpisodeStart::resolve(
                &self.resident().version.manifest,
                start.as_ref(),
                self.warm_up_us,
                self.dynamics,
            )
            .map_err(|error| error.of_reset(start.as_ref()))?,
            None => self.start.clone(),
        };
        let mut next = start.episode(seed, self.dynamics, self.dt_us);

        let captures = self.layout.captures(&next, &FrameHistory::default());
        let rendered = self.render(&next, captures, Some(FrameHistory::default())).await?;

        let record = self.frame_record(FrameRequest::Reset, &next, &rendered);
        let file = self.create_file(&next, Line::Frame(record)).await?;
        self.end_recording(Outcome::Completed).await;

        next.add_trusts(rendered.trusts());
        self.recorder = Some(file.recorder);
        self.episode_number = file.number;
        self.version_switched = false;
        self.episode = next;
        self.frame_history = rendered.frame_history;
        self.hint.clear();
        self.look_ahead();
        Ok(rendered.observation)
    }

    /// Ends the session and summarizes its last episode.
    pub async fn close(mut self, outcome: Outcome) -> EpisodeSummary {
        self.end_recording(outcome).await;
        self.episode.summary(outcome)
    }

    /// Renders captures one after the other, each in its turn among the other sessions' frames.
    ///
    /// With a history, the observation also shows its earlier frames; without one (`observe`), it does not.
    async fn render(
        &self,
        episode: &Episode,
        captures: Vec<RigCapture>,
        history: Option<FrameHistory>,
    ) -> Result<RenderedObservation, SessionError> {
        let deadline = Instant::now() + self.deadline;
        let mut builder = ObservationBuilder::new(
            self.layout.clone(),
            self.engine.answer_budget(),
            self.coverage.clone(),
            episode,
            &captures,
        )?;
        for capture in captures {
            if capture.cameras.is_empty() {
                builder.add_capture(capture);
                continue;
            }
            let views = self.layout.views(episode, &capture);
            // Load before the job is queued, so that no render thread waits for a disk.
            let pinned = self.pin(deadline, viewpoints(&views)).await?;
            builder.add_load(pinned.waited_for, pinned.waited);
            let profile = self.profile;
            let work = move |scratch: &mut Scratch, backend: &dyn Backend| {
                let frame = Frame { scene: &pinned, profile: &profile, views: &views };
                let rendered = builder.render(&capture, &frame, backend, scratch);
                builder.add_capture(capture);
                rendered.map(|()| builder)
            };
            let (rendered, queued) = self.engine.run(deadline, work).await?;
            builder = rendered?;
            builder.add_queue_time(queued);
        }
        let (held_bytes, limit_bytes) = self.resident().memory();
        builder.finish(history, held_bytes, limit_bytes)
    }

    /// Waits until all sections that a frame needs are in memory, and pins them.
    async fn pin(
        &self,
        deadline: Instant,
        viewpoints: Vec<Viewpoint>,
    ) -> Result<PinnedScene, SessionError> {
        let (reply, answer) = oneshot::channel();
        let resident = self.resident().clone();
        let profile = self.profile;
        let request = run_blocking(move || {
            let done = Box::new(move |pinned| {
                // Sending fails if the deadline has passed and the receiver is gone.
                let _ = reply.send(pinned);
            });
            resident.request(&viewpoints, &profile, done)
        });
        // Dropping the request takes the frame out of the pager's queue.
        let request = request.await??;
        match timeout_at(deadline, answer).await {
            Ok(Ok(pinned)) => Ok(pinned?),
            Ok(Err(_)) => Err(SessionError::Crashed),
            Err(_) => Err(request.timeout_error().into()),
        }
    }
}
