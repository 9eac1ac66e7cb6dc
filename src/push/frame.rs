//! The frame of a push: from the axes and unit of the capture to the twin's.
//!
//! A twin that was aligned (`wildcity twin align`, an edit) has different axes from the capture
//! that it was trained from. Its manifest has the transform between the two, so that a training
//! pipeline can push its result unchanged.

use wildcity_scene::align::Alignment;
use wildcity_twin::store::{StoreError, Version};

use crate::error::PushError;

/// The frame of a push's Gaussians, after the axes and the scale of each file, and of its preview
/// poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Frame {
    /// The axes and metres of the base version.
    #[default]
    Twin,
    /// The axes and the unit with which the capture was imported, before the twin was aligned. The
    /// axes and the unit of the twin if it never was.
    Capture,
}

impl Frame {
    /// The change from this frame to that of a version; none if they are the same.
    pub(crate) fn alignment(self, base: Option<&Version>) -> Result<Option<Alignment>, PushError> {
        match (self, base) {
            (Self::Capture, Some(base)) => twin_from_capture(base),
            // A new twin has no alignment yet, so that both frames are the same.
            (Self::Capture, None) | (Self::Twin, _) => Ok(None),
        }
    }
}

/// The change from the capture's frame to that of a version; none if the version records no
/// alignment.
pub(crate) fn twin_from_capture(base: &Version) -> Result<Option<Alignment>, PushError> {
    Ok(base.manifest.alignment().map_err(StoreError::from)?)
}
