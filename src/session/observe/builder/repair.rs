//! The repair of an observation's images.
//!
//! The renderer's callback encodes an image at once unless it may be repaired. Such a candidate is copied
//! instead. When all views of its pose are rendered, so that the trust of each is known, the selection decides,
//! and the candidates are repaired and encoded outside of the render queue: frames of other sessions are
//! rendered meanwhile, and a model that hangs delays its own session alone.

use std::sync::Arc;
use std::time::Instant;

use wildcity_render::Target;

use super::{ObservationBuilder, encoded};
use crate::engine::answer_budget::{AnswerBudget, BudgetShare};
use crate::error::SessionError;
use crate::observe::layout::RigCapture;
use crate::options::OnFailure;
use crate::repair::session_repair::{RenderedImage, SessionRepair};
use crate::repair::status::{ImageRepair, RepairFailure, RepairStatus};

/// What the repair of an observation's images needs.
pub(crate) struct ObservationRepair {
    pub(super) session: Arc<SessionRepair>,
    /// By camera: whether it is in repair after the captures so far.
    repairing: Vec<bool>,
    /// Whether that goes from one capture to the next. Not for poses that the ego is not at.
    has_history: bool,
    /// Of the last capture.
    candidates: Vec<Candidate>,
    /// The memory of the candidates.
    share: Option<BudgetShare>,
}

/// An image that may be repaired.
struct Candidate {
    camera: usize,
    /// Among the encoded images.
    index: usize,
    /// Whether the selection chose it.
    is_chosen: bool,
    image: RenderedImage,
    /// Where its pixels are in the buffer, if the observation holds them there.
    raw_at: Option<usize>,
}

/// Which images of a capture may be repaired: shared by the threads that finish its views.
pub(super) struct Gate {
    pub(super) session: Arc<SessionRepair>,
    /// By view of the capture.
    was_on: Vec<bool>,
}

/// An image that the renderer has finished, as the selection needs it.
pub(super) struct Finished {
    pub(super) trust: f64,
    /// Set if it may be repaired.
    pub(super) candidate: Option<RenderedImage>,
}

impl ObservationRepair {
    /// `repairing` says by camera whether it was in repair after the observation before; none for poses that
    /// the ego is not at.
    pub(crate) fn new(
        session: Arc<SessionRepair>,
        cameras: usize,
        repairing: Option<&[bool]>,
    ) -> Self {
        let has_history = repairing.is_some();
        let mut repairing = repairing.unwrap_or_default().to_vec();
        repairing.resize(cameras, false);
        Self { session, repairing, has_history, candidates: Vec::new(), share: None }
    }

    /// By camera, whether it is in repair now; none for poses that the ego is not at.
    pub(super) fn into_repairing(self) -> Option<Vec<bool>> {
        self.has_history.then_some(self.repairing)
    }

    /// The gate of a capture. Reserves memory for its candidates.
    pub(super) fn gate(
        &mut self,
        budget: &AnswerBudget,
        capture: &RigCapture,
        pixels: u64,
    ) -> Result<Gate, SessionError> {
        let depth = u64::from(self.session.needs_depth());
        let normals = u64::from(self.session.needs_normals());
        self.share = Some(budget.reserve(pixels * (3 + 4 * (1 + depth + 3 * normals)))?);
        let was_on = capture.cameras.iter().map(|&camera| self.repairing[camera]).collect();
        Ok(Gate { session: self.session.clone(), was_on })
    }

    /// Decides which images of a capture are repaired. `raw_at` says where the pixels of each view are in the
    /// buffer, and `first` where the capture's images begin among the encoded ones.
    pub(super) fn decide(
        &mut self,
        capture: &RigCapture,
        gate: &Gate,
        finished: Vec<Finished>,
        raw_at: &[Option<usize>],
        first: usize,
    ) {
        let trusts: Vec<f64> = finished.iter().map(|image| image.trust).collect();
        let decision = gate.session.selection.decide(&gate.was_on, &trusts);
        for (view, Finished { candidate, .. }) in finished.into_iter().enumerate() {
            let camera = capture.cameras[view];
            if self.has_history {
                self.repairing[camera] = decision.is_on[view];
            }
            let Some(image) = candidate else { continue };
            self.candidates.push(Candidate {
                camera,
                index: first + view,
                is_chosen: decision.cameras.contains(&view),
                image,
                raw_at: raw_at[view],
            });
        }
        if self.candidates.is_empty() {
            self.share = None;
        }
    }
}

impl Gate {
    /// What the selection needs of a finished view.
    pub(super) fn finished(&self, view: usize, trust: f64, target: &Target<'_>) -> Finished {
        if !self.session.selection.is_candidate(self.was_on[view], trust) {
            return Finished { trust, candidate: None };
        }
        let copy = |map: Option<&[f32]>| map.unwrap_or_default().to_vec();
        let mut image = RenderedImage {
            rgb8: target.rgb8.as_deref().unwrap_or_default().to_vec(),
            opacity: copy(target.opacity.as_deref()),
            trust,
            ..RenderedImage::default()
        };
        if self.session.needs_depth() {
            image.depth_m = copy(target.depth_m.as_deref());
        }
        if self.session.needs_normals() {
            image.normals = copy(target.normals.as_deref());
        }
        Finished { trust, candidate: Some(image) }
    }
}

impl ObservationBuilder {
    /// Whether images of the last capture may be repaired.
    pub(crate) fn has_candidates(&self) -> bool {
        self.repair.as_ref().is_some_and(|repair| !repair.candidates.is_empty())
    }

    /// Repairs the chosen images of the last capture, and encodes all of its candidates. Blocks.
    ///
    /// # Errors
    /// [`SessionError::Repair`] if the model fails and the session asked for an error, or
    /// [`SessionError::Encode`].
    pub(crate) fn repair(&mut self) -> Result<(), SessionError> {
        let Some(repair) = &mut self.repair else { return Ok(()) };
        let session = repair.session.clone();
        let candidates = std::mem::take(&mut repair.candidates);
        let capture = self.captures.last().cloned();
        for Candidate { camera, index, is_chosen, image, raw_at } in candidates {
            let mounted = &self.layout.cameras()[camera];
            let mut status = RepairStatus::Kept;
            let mut pixels = image.rgb8.clone();
            if is_chosen {
                let started = Instant::now();
                let repaired = session.repair(mounted, &image);
                self.timings.repair += started.elapsed();
                match repaired {
                    Ok(repaired) => {
                        status = RepairStatus::Repaired;
                        pixels = repaired;
                    }
                    Err(cause) if session.on_failure == OnFailure::Error => {
                        let camera = mounted.name.clone();
                        return Err(SessionError::Repair { camera, cause: Box::new(cause) });
                    }
                    Err(cause) => {
                        let model = &session.model.manifest().name;
                        tracing::warn!(model, camera = mounted.name, "not repaired: {cause}");
                        status = RepairStatus::Failed(RepairFailure::from(&cause));
                    }
                }
            }
            let effects = capture
                .as_ref()
                .filter(|capture| capture.sensed)
                .and_then(|capture| self.layout.pixel_effects(camera, self.key, capture.time_us));
            let is_later =
                capture.as_ref().is_some_and(|capture| self.layout.is_shown_later(capture, camera));
            let done = encoded(&self.layout, camera, &pixels, is_later, effects.as_ref())
                .map_err(|reason| SessionError::Encode { camera: mounted.name.clone(), reason })?;
            if let Some(at) = raw_at {
                let sent = if done.changed.is_empty() { &pixels } else { &done.changed };
                self.buffer.bytes_mut()[at..at + sent.len()].copy_from_slice(sent);
            }
            let rendered = &mut self.encoded[index];
            let rendered_hash = rendered.hash;
            self.timings.encode += done.took;
            rendered.hash = done.hash;
            rendered.file = done.file;
            rendered.effects = done.effects;
            rendered.repair = Some(ImageRepair { status, rendered_hash });
        }
        if let Some(repair) = &mut self.repair {
            repair.share = None;
        }
        Ok(())
    }
}
