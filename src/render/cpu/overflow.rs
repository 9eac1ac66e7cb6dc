//! Why a part of a frame is not drawn as it is: what no part may hold, and what fails the frame.

use crate::RenderError;

/// A part of a frame needs more memory than it may have between its stages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Overflow;

/// Why a part of a frame was not drawn.
#[derive(Debug)]
pub(super) enum PartError {
    /// It is to be drawn in smaller parts.
    Overflow,
    /// The frame fails.
    Render(RenderError),
}

impl From<Overflow> for PartError {
    fn from(_: Overflow) -> Self {
        Self::Overflow
    }
}

impl From<RenderError> for PartError {
    fn from(error: RenderError) -> Self {
        Self::Render(error)
    }
}
