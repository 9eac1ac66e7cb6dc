//! The repair of an observation's images.
//!
//! The renderer's callback encodes an image at once unless it may be repaired. Such a candidate is
//! copied instead. When all views of its pose are rendered, so that the trust of each is known, the
//! selection decides, and the candidates are repaired and encoded outside of the render queue:
//! frames of other sessions are rendered meanwhile, and a model that hangs delays only its own
//! session.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use wildcity_render::{Target, View};
use wildcity_repair::reference::Reference;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;

use super::{ImageToEncode, ObservationBuilder, encoded};
use crate::engine::answer_budget::{AnswerBudget, BudgetShare};
use crate::error::SessionError;
use crate::observe::layout::RigCapture;
use crate::repair::drawn::{ReferenceInputs, WarpQuery};
use crate::repair::references::{ReferenceView, ReferenceViews};
use crate::repair::rendered_image::RenderedImage;
use crate::repair::session_repair::SessionRepair;
use crate::repair::status::{ImageRepair, RepairFailure, RepairState, RepairStatus};
use wildcity_options::OnFailure;

/// State and data of the repair of an observation's images.
pub(crate) struct ObservationRepair {
    pub(super) session: Arc<SessionRepair>,
    /// Hysteresis state of each camera after the captures so far.
    state: RepairState,
    /// Whether the state is kept from one capture to the next. False for `observe`, whose poses are
    /// not the ego's.
    has_history: bool,
    /// Candidates of the last capture.
    candidates: Vec<Candidate>,
    /// The memory of the candidates.
    share: Option<BudgetShare>,
    /// The references of the candidates, by [`ReferenceView::id`].
    references: HashMap<String, Arc<Reference>>,
}

/// An image that may be repaired.
struct Candidate {
    camera: usize,
    /// Index among the encoded images.
    index: usize,
    /// Whether the selection chose it.
    is_chosen: bool,
    image: RenderedImage,
    /// Where its pixels are in the buffer, if the observation holds them there.
    raw_at: Option<usize>,
    view: View,
    world_from_rig: Pose,
    /// The references that are warped into it, in order.
    around: Vec<ReferenceView>,
    /// The reference of the same camera.
    nearest: Option<ReferenceView>,
}

/// The images of a rendered capture.
pub(super) struct RenderedCapture<'a> {
    /// In the order of the views.
    pub(super) finished: Vec<Finished>,
    pub(super) views: &'a [View],
    /// Where the pixels of each view are in the buffer.
    pub(super) raw_at: &'a [Option<usize>],
    /// Index of its first image among the encoded ones.
    pub(super) first: usize,
}

/// Decides, for each view of a capture, whether it is a repair candidate. Shared by the threads
/// that finish the views.
pub(super) struct CandidateFilter {
    pub(super) session: Arc<SessionRepair>,
    /// For each view of the capture, whether the repair of its camera is on.
    was_on: Vec<bool>,
}

/// An image that the renderer has finished, as the selection needs it.
pub(super) struct Finished {
    pub(super) trust: f64,
    /// Set if it may be repaired.
    pub(super) candidate: Option<RenderedImage>,
}

impl ObservationRepair {
    /// `state` is the state after the previous observation; `None` for poses that the ego is not
    /// at.
    pub(crate) fn new(
        session: Arc<SessionRepair>,
        cameras: usize,
        state: Option<RepairState>,
    ) -> Self {
        let has_history = state.is_some();
        let state = state.unwrap_or_default().for_cameras(cameras);
        let references = HashMap::new();
        Self { session, state, has_history, candidates: Vec::new(), share: None, references }
    }

    /// The state after all captures; `None` for poses that the ego is not at.
    pub(super) fn into_state(self) -> Option<RepairState> {
        self.has_history.then_some(self.state)
    }

    /// Returns the filter of a capture, and reserves memory for its candidates.
    pub(super) fn candidate_filter(
        &mut self,
        budget: &AnswerBudget,
        capture: &RigCapture,
        pixels: u64,
    ) -> Result<CandidateFilter, SessionError> {
        let depth = u64::from(self.session.needs_depth());
        let normals = u64::from(self.session.needs_normals());
        // Two more copies of the depth, and the references in the view.
        let warped = u64::from(self.session.needs_warped());
        // The colour takes 3 bytes a pixel, the opacity and the other maps 4 a value.
        let values = 1 + depth + 3 * normals + 4 * warped;
        self.share = Some(budget.reserve(pixels * (3 + 4 * values))?);
        let was_on = capture.cameras.iter().map(|&camera| self.state.is_on[camera]).collect();
        Ok(CandidateFilter { session: self.session.clone(), was_on })
    }

    /// Decides which images of a capture are repaired.
    pub(super) fn decide(
        &mut self,
        capture: &RigCapture,
        filter: &CandidateFilter,
        rendered: RenderedCapture<'_>,
    ) {
        let RenderedCapture { finished, views, raw_at, first } = rendered;
        let trusts: Vec<f64> = finished.iter().map(|image| image.trust).collect();
        // All views are judged by the state before the capture, so that their order does not
        // matter.
        let decision = filter.session.selection.decide(&filter.was_on, &trusts);
        for (view, Finished { candidate, .. }) in finished.into_iter().enumerate() {
            let camera = capture.cameras[view];
            if self.has_history {
                self.state.is_on[camera] = decision.is_on[view];
            }
            // Images of high trust are encoded already.
            let Some(image) = candidate else { continue };
            self.candidates.push(Candidate {
                camera,
                index: first + view,
                is_chosen: decision.cameras.contains(&view),
                image,
                raw_at: raw_at[view],
                view: views[view],
                world_from_rig: capture.world_from_rig,
                around: Vec::new(),
                nearest: None,
            });
        }
        if self.candidates.is_empty() {
            // Nothing was copied, so that nothing needs the memory.
            self.share = None;
        }
    }
}

impl Candidate {
    /// References that the model gets in addition to the image.
    fn reference_inputs(
        &self,
        session: &SessionRepair,
        camera: &RigCamera,
        references: &HashMap<String, Arc<Reference>>,
    ) -> ReferenceInputs {
        let mut inputs = ReferenceInputs::default();
        if session.needs_reference()
            && let Some(nearest) = &self.nearest
            && let Some(reference) = references.get(&nearest.id())
        {
            inputs.set_reference(&nearest.name, reference, &camera.camera);
        }
        if session.needs_warped() {
            // A reference that could not be read is left out.
            let named = |view: &ReferenceView| {
                Some((view.name.clone(), references.get(&view.id())?.clone()))
            };
            let around: Vec<(String, Arc<Reference>)> =
                self.around.iter().filter_map(named).collect();
            let rays = session.rays(self.camera, camera);
            let query = WarpQuery { camera, rays, view: &self.view, image: &self.image };
            query.warped(&around, &mut inputs);
        }
        inputs
    }
}

impl CandidateFilter {
    /// Returns the data of a finished view that the selection needs.
    pub(super) fn finished(&self, view: usize, trust: f64, target: &Target<'_>) -> Finished {
        // Runs on a thread of the renderer: only what may be repaired is copied.
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

    /// The references that the chosen images of the last capture need, each once. Takes some
    /// milliseconds an image.
    pub(crate) fn wanted_references(&mut self, views: &ReferenceViews) -> Vec<ReferenceView> {
        let Some(repair) = &mut self.repair else { return Vec::new() };
        let session = repair.session.clone();
        // Two images may need the same reference: it is listed where it is found first.
        let mut wanted: Vec<ReferenceView> = Vec::new();
        let mut known = HashSet::new();
        let mut want = |view: &ReferenceView| {
            if known.insert(view.id()) {
                wanted.push(view.clone());
            }
        };
        for candidate in repair.candidates.iter_mut().filter(|candidate| candidate.is_chosen) {
            let camera = &self.layout.cameras()[candidate.camera];
            let world_from_rig = &candidate.world_from_rig;
            if session.needs_warped() {
                let Candidate { view, image, .. } = &*candidate;
                let rays = session.rays(candidate.camera, camera);
                let query = WarpQuery { camera, rays, view, image };
                candidate.around = query.overlapping(views.around(world_from_rig));
                candidate.around.iter().for_each(&mut want);
            }
            if session.needs_reference() {
                let world_from_camera = &candidate.view.world_from_camera;
                // A pose that the ego is not at has no history.
                let kept = repair.state.references[candidate.camera]
                    .as_deref()
                    .filter(|_| repair.has_history);
                candidate.nearest = views.nearest(camera, world_from_camera, world_from_rig, kept);
                candidate.nearest.iter().for_each(&mut want);
            }
        }
        wanted
    }

    /// Adds references by [`ReferenceView::id`], and how long reading and drawing them took.
    pub(crate) fn add_references(
        &mut self,
        references: HashMap<String, Arc<Reference>>,
        took: Duration,
    ) {
        if let Some(repair) = &mut self.repair {
            repair.references = references;
        }
        self.timings.repair += took;
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
        let references = std::mem::take(&mut repair.references);
        // Candidates are always those of the last capture.
        let capture = self.captures.last().cloned();
        for candidate in candidates {
            let Candidate { camera, index, is_chosen, ref image, raw_at, .. } = candidate;
            let mounted = &self.layout.cameras()[camera];
            let mut status = RepairStatus::Kept;
            let mut names = Vec::new();
            // The model reads the image, and a failure sends these pixels as they are.
            let mut pixels = image.rgb8.clone();
            if is_chosen {
                let started = Instant::now();
                let inputs = candidate.reference_inputs(&session, mounted, &references);
                let repaired = session.repair(mounted, image, &inputs);
                self.timings.repair += started.elapsed();
                match repaired {
                    Ok(repaired) => {
                        status = RepairStatus::Repaired;
                        names = inputs.names;
                        pixels = repaired;
                        // A repair that fails keeps the reference of the one before.
                        repair.state.references[camera] = inputs.nearest;
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
            // Effects are those of the camera, and come after the repair, which is part of the
            // rendering.
            let effects =
                capture.as_ref().filter(|capture| capture.has_sensor_effects).and_then(|capture| {
                    self.layout.pixel_effects(camera, self.effect_seed, capture.time_us)
                });
            let is_later =
                capture.as_ref().is_some_and(|capture| self.layout.is_shown_later(capture, camera));
            let image = ImageToEncode { camera, pixels: &pixels, is_shown_later: is_later };
            // Few images are repaired, and not on the threads that encode the others.
            let done = encoded(&self.layout, image, effects.as_ref(), false)
                .map_err(|reason| SessionError::Encode { camera: mounted.name.clone(), reason })?;
            // The renderer wrote its pixels there; a raw image is replaced in place.
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
            rendered.repair = Some(ImageRepair { status, rendered_hash, references: names });
        }
        // The last of the copies was dropped with its candidate.
        repair.share = None;
        Ok(())
    }
}
