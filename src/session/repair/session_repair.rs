//! The model of a session, and the repair of one image.

use std::sync::Arc;
use std::time::Duration;

use wildcity_options::{OnFailure, Repair};
use wildcity_repair::reference::Rays;
use wildcity_repair::{Image, InputRole, Model, Models, RepairError, RepairTimes, Selection, View};
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::rig::RigCamera;

use crate::error::SessionError;

use super::drawn::{CameraRays, ReferenceInputs};
use super::references::ReferenceViews;
use super::rendered_image::RenderedImage;

/// The repair of a session: the model, and when it is used.
#[derive(Debug)]
pub struct SessionRepair {
    pub model: Arc<Model>,
    pub selection: Selection,
    /// Behaviour when the model fails.
    pub on_failure: OnFailure,
    /// Whether observations contain the trust, by which the images are selected.
    pub(crate) reports_trust: bool,
    /// Rays of the cameras, for references.
    rays: CameraRays,
}

impl SessionRepair {
    /// Finds and loads the model, and checks that it can repair the images of some cameras. Blocks.
    ///
    /// # Errors
    /// There is no such model, it cannot be loaded or used, or an option is out of range.
    pub(crate) fn open(
        models: &Models,
        options: &Repair,
        cameras: &[RigCamera],
        deadline: Duration,
        reports_trust: bool,
    ) -> Result<Self, SessionError> {
        let selection = select(options)?;
        let name = &options.model;
        let unavailable =
            |reason: String| SessionError::RepairUnavailable { name: name.clone(), reason };
        // A wrong name is a mistake of the request; anything else is one of the model.
        let model = models.get(name).map_err(|error| match error {
            RepairError::Unknown { name, known } => SessionError::UnknownRepair { name, known },
            other => unavailable(other.to_string()),
        })?;
        check_cameras(&model, cameras)?;
        // A model that hangs is stopped after its time. With a shorter deadline, the whole step
        // would fail.
        let timeout_ms = model.manifest().timeout_ms;
        if Duration::from_millis(timeout_ms) >= deadline {
            let must = format!(
                "{} ms, and the repair model may run for {timeout_ms} ms per image (its timeout_ms); give more",
                deadline.as_millis()
            );
            return Err(SessionError::OutOfRange { field: "deadline_ms", must });
        }
        let rays = CameraRays::new(cameras.len());
        let on_failure = options.on_failure.unwrap_or_default();
        Ok(Self { model, selection, on_failure, reports_trust, rays })
    }

    /// Whether the model needs depth; normals are computed from it.
    pub(crate) fn needs_depth(&self) -> bool {
        self.model.needs(InputRole::Depth) || self.needs_normals() || self.needs_warped()
    }

    /// Whether the model needs images warped into the view.
    pub(crate) fn needs_warped(&self) -> bool {
        needs_warped(&self.model)
    }

    /// Whether the model needs an image of the same camera nearby.
    pub(crate) fn needs_reference(&self) -> bool {
        self.model.needs(InputRole::Reference)
    }

    /// Whether the model needs images in addition to the rendered one.
    pub(crate) fn needs_images(&self) -> bool {
        self.needs_warped() || self.needs_reference()
    }

    /// The rays of a camera, by its index.
    pub(crate) fn rays(&self, index: usize, camera: &RigCamera) -> &Rays {
        self.rays.camera_rays(index, camera)
    }

    /// Checks that each camera has an image for the role `reference`, if the model needs one.
    ///
    /// # Errors
    /// [`SessionError::RepairUnavailable`].
    pub(crate) fn check_references(
        &self,
        views: Option<&ReferenceViews>,
        cameras: &[RigCamera],
    ) -> Result<(), SessionError> {
        check_references(&self.model, views, cameras)
    }

    /// Whether the model needs normals.
    pub(crate) fn needs_normals(&self) -> bool {
        self.model.needs(InputRole::Normals)
    }

    /// The repaired pixels of an image. Blocks.
    pub(crate) fn repair(
        &self,
        camera: &RigCamera,
        rendered: &RenderedImage,
        inputs: &ReferenceInputs,
    ) -> Result<Vec<u8>, RepairError> {
        repair(&self.model, camera, rendered, inputs)
    }
}

/// Whether a model needs images warped into the view.
pub(crate) fn needs_warped(model: &Model) -> bool {
    model.needs(InputRole::ReferenceWarped) || model.needs(InputRole::ReferenceValid)
}

/// Checks that a model can repair the images of some cameras.
///
/// # Errors
/// [`SessionError::RepairUnavailable`].
pub(crate) fn check_cameras(model: &Model, cameras: &[RigCamera]) -> Result<(), SessionError> {
    let unavailable = |reason: String| {
        let name = model.manifest().name.clone();
        SessionError::RepairUnavailable { name, reason }
    };
    let scale = model.manifest().outputs[0].scale;
    if scale != 1 {
        return Err(unavailable(format!(
            "its output is {scale} times as large as its input, and images keep their size here; give a model of scale 1"
        )));
    }
    for RigCamera { name, camera, .. } in cameras {
        let checked = model.check_size(camera.width_px as usize, camera.height_px as usize);
        checked.map_err(|error| unavailable(format!("camera {name:?}: {error}")))?;
    }
    Ok(())
}

/// Checks that each camera has an image for the role `reference`, if a model needs one, and that
/// there are images at all.
///
/// # Errors
/// [`SessionError::RepairUnavailable`].
pub(crate) fn check_references(
    model: &Model,
    views: Option<&ReferenceViews>,
    cameras: &[RigCamera],
) -> Result<(), SessionError> {
    let refused = |reason: String| {
        let name = model.manifest().name.clone();
        Err(SessionError::RepairUnavailable { name, reason })
    };
    let Some(views) = views else {
        return refused(
            "it needs images of a recorded drive, and the twin has none; `wildcity twin drive` and `wildcity twin views` \
             add them"
                .to_owned(),
        );
    };
    let is_missing = |camera: &&RigCamera| !views.has_camera(&camera.name);
    let missing = cameras.iter().find(is_missing);
    // Only this role needs every camera: a warp takes the images of any.
    match missing.filter(|_| model.needs(InputRole::Reference)) {
        None => Ok(()),
        Some(RigCamera { name, .. }) => refused(format!(
            "it needs a recorded image of each camera, and the twin has none of {name:?}; `wildcity twin views` \
             adds images, outputs.cameras leaves cameras out"
        )),
    }
}

/// The repaired pixels of a camera's image: black outside of the lens' field, with the camera's
/// overlay.
pub(crate) fn repair(
    model: &Model,
    camera: &RigCamera,
    rendered: &RenderedImage,
    inputs: &ReferenceInputs,
) -> Result<Vec<u8>, RepairError> {
    repair_timed(model, camera, rendered, inputs).map(|(repaired, _)| repaired)
}

/// As [`repair`], and also returns how long its parts took.
pub(crate) fn repair_timed(
    model: &Model,
    camera: &RigCamera,
    rendered: &RenderedImage,
    inputs: &ReferenceInputs,
) -> Result<(Vec<u8>, RepairTimes), RepairError> {
    let RenderedImage { rgb8, depth_m, opacity, normals, trust } = rendered;
    let width = camera.camera.width_px as usize;
    let height = camera.camera.height_px as usize;
    let image = Image { width, height, rgb8: rgb8.clone() };
    let mut mask = Vec::new();
    let field = FieldMask::from_camera(&camera.camera);
    // With a limited field, every model gets the mask, so that the result is black outside.
    if field.is_some() || model.needs(InputRole::Mask) {
        mask = vec![1.0; width * height];
    }
    if let Some(field) = field {
        field.clear_outside(&camera.camera, 1, &mut mask);
    }
    let normals = planar(normals);
    // Maps that the model does not ask for are empty, and an empty map is no input.
    let given = |role: InputRole, values| model.needs(role).then_some(values);
    let view = View {
        depth_m: given(InputRole::Depth, &depth_m[..]),
        opacity: given(InputRole::Opacity, &opacity[..]),
        normals: given(InputRole::Normals, &normals[..]),
        mask: (!mask.is_empty()).then_some(&mask[..]),
        trust: Some(*trust as f32),
        reference: inputs.reference.as_ref(),
        reference_warped: inputs.warped.as_ref().map(|(image, _)| image),
        reference_valid: inputs.warped.as_ref().map(|(_, valid)| &valid[..]),
        ..View::new(&image)
    };
    let (repaired, times) = model.repair_timed(&view)?;
    let mut repaired = repaired.image.rgb8;
    // The model may have changed the overlay, which is no part of the scene.
    if let Some(overlay) = &camera.appearance.overlay {
        let alphas = overlay.rgba8().chunks_exact(4).map(|pixel| u32::from(pixel[3]));
        let pixels = repaired.chunks_exact_mut(3).zip(rgb8.chunks_exact(3));
        for ((out, rendered), alpha) in pixels.zip(alphas) {
            for (out, rendered) in out.iter_mut().zip(rendered) {
                // At most 255², and + 127 rounds the quotient to the nearest.
                let sum = (255 - alpha) * u32::from(*out) + alpha * u32::from(*rendered);
                *out = ((sum + 127) / 255) as u8;
            }
        }
    }
    Ok((repaired, times))
}

/// All x, then all y, then all z.
fn planar(interleaved: &[f32]) -> Vec<f32> {
    // The renderer writes the three values of a pixel side by side; a model takes planes.
    let axis = |axis: usize| interleaved.iter().skip(axis).step_by(3).copied();
    axis(0).chain(axis(1)).chain(axis(2)).collect()
}

fn select(options: &Repair) -> Result<Selection, SessionError> {
    let default = Selection::default();
    let selection = Selection {
        below: options.below.unwrap_or(default.below),
        above: options.above.unwrap_or(default.above),
        at_least: options.at_least.unwrap_or(default.at_least),
        per_step: options.per_step.map_or(default.per_step, |count| count as usize),
    };
    selection.check().map_err(|(field, must)| {
        let field = match field {
            "below" => "repair.below",
            "above" => "repair.above",
            _ => "repair.at_least",
        };
        SessionError::OutOfRange { field, must }
    })?;
    Ok(selection)
}
