//! Steps: of one session, or of several at once.

use std::sync::Arc;

use futures_util::future::join_all;
use tokio::time::Instant;

use wildcity_session::{Observation, Session, SessionError, StepOptions};

use super::{Connection, NO_SESSION};
use crate::convert::{self, SessionStep, Stepped};
use crate::fault::Fault;
use crate::metrics::Metrics;
use crate::sessions::{Answer, SlotGuard};

impl Connection {
    /// Carries out steps of several sessions at once: their frames wait for the renderer together.
    pub(super) async fn step_many(
        &mut self,
        seq: u64,
        steps: Vec<SessionStep>,
    ) -> Result<Answer, Fault> {
        if self.slots.is_empty() {
            return Err(NO_SESSION);
        }
        let open = self.names();
        // The limit is that of one answer: all observations are in one message. Checked before any
        // session moves.
        let named = |slot: &&SlotGuard| steps.iter().any(|step| step.session == slot.name());
        let sessions = self.slots.iter().filter(named).filter_map(|slot| slot.session.as_ref());
        let pixels: u64 = sessions.map(Session::step_pixels).sum();
        let limit = wildcity_session::limits::ANSWER_PIXELS;
        if pixels > limit {
            return Err(SessionError::AnswerTooLarge { field: "steps", pixels, limit }.into());
        }

        let metrics = &self.state.metrics;
        // Each future takes the exclusive reference to its own slot, so that all can run at once. A
        // name occurs once, which the conversion has checked.
        let mut slots: Vec<_> = self.slots.iter_mut().map(Some).collect();
        let carried_out = steps.into_iter().map(|SessionStep { session: name, step: asked }| {
            let slot =
                open.iter().position(|known| *known == name).and_then(|slot| slots[slot].take());
            let open = &open;
            async move {
                let result = async {
                    let (movement, options) = asked?;
                    let unknown =
                        || Fault::NotOnConnection { name: name.clone(), open: open.clone() };
                    let slot = slot.ok_or_else(unknown)?;
                    let session = slot.session.as_mut().ok_or(NO_SESSION)?;
                    let driven = step(metrics, session, movement, options).await?;
                    let frame = Arc::new(convert::observation(seq, session, driven)?);
                    slot.update_view();
                    slot.show(&frame);
                    Ok(frame)
                }
                .await;
                Stepped { session: name, result }
            }
        });
        // One refused step leaves the others as they are: each has its own result.
        let stepped = join_all(carried_out).await;
        for fault in stepped.iter().filter_map(|step| step.result.as_ref().err()) {
            tracing::debug!(seq, "refused: {fault}");
            metrics.refused(&fault.report().code().0);
        }
        Ok(Answer::Many(Arc::new(convert::many(seq, stepped)?)))
    }
}

/// Carries out a step of a session, and counts it.
pub(super) async fn step(
    metrics: &Metrics,
    session: &mut Session,
    movement: wildcity_sim::Command,
    options: StepOptions,
) -> Result<Observation, Fault> {
    let begun = Instant::now();
    // A request may simulate several steps, so the difference is counted.
    let done = session.episode().step();
    let frame = session.follow(movement, options).await?;
    metrics.steps.inc_by(session.episode().step() - done);
    metrics.step_seconds.observe(begun.elapsed().as_secs_f64());
    metrics.queue_seconds.observe(frame.timings.queue.as_secs_f64());
    Ok(frame)
}
