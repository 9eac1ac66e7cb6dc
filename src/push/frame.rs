//! The frame of a push: from the axes and unit of the capture to the twin's.
//!
//! A twin that was aligned (`wildcity twin align`, an edit) lies in other axes than the capture that it was trained
//! from. Its manifest has the way from one to the other, and a training pipeline pushes what it trained.

use wildcity_scene::align::Alignment;
use wildcity_scene::validate::{self, Field};
use wildcity_twin::store::{StoreError, Version};

use crate::error::PushError;
use crate::read::PushedScene;
use crate::report::Ranges;

/// The frame of a push's Gaussians, after the axes and the scale of each file, and of its preview poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Frame {
    /// The axes and metres of the base version.
    #[default]
    Twin,
    /// The axes and the unit with which the capture was imported, before the twin was aligned. Those of the twin if it
    /// never was.
    Capture,
}

impl Frame {
    /// The change from this frame to that of a version; none if they are the same.
    pub(crate) fn alignment(self, base: Option<&Version>) -> Result<Option<Alignment>, PushError> {
        match (self, base) {
            (Self::Capture, Some(base)) => twin_from_capture(base),
            (Self::Capture, None) | (Self::Twin, _) => Ok(None),
        }
    }
}

/// The change from the capture's frame to that of a version; none if the twin was never aligned.
fn twin_from_capture(base: &Version) -> Result<Option<Alignment>, PushError> {
    Ok(base.manifest.alignment().map_err(StoreError::from)?)
}

/// Turns, moves and scales a scene to the frame of its base. The report says in which frame it was.
///
/// # Errors
/// [`PushError::Content`]: a Gaussian is outside its bounds there.
pub(crate) fn to_twin(
    frame: Frame,
    scene: &mut PushedScene,
    base: Option<&Version>,
) -> Result<(), PushError> {
    let PushedScene { gaussians, options, report, .. } = scene;
    report.frame = frame;
    report.is_aligned = base.map(twin_from_capture).transpose()?.flatten().is_some();
    let Some(alignment) = frame.alignment(base)? else { return Ok(()) };
    alignment.apply(gaussians);
    report.ranges = Ranges::of(gaussians);
    validate::check(gaussians, &Field::twin_name).map_err(|bad| PushError::Content {
        reason: format!("in the axes of the twin, {bad}: check the scale of the files"),
        cells: Vec::new(),
    })?;
    options.push(format!("align={alignment}"));
    Ok(())
}
