//! Why a part of a frame is not drawn as it is: it exceeds a limit of memory, or the frame fails.

use crate::RenderError;

/// A part of a frame needs larger intermediate buffers than it may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Overflow;

/// Why a part of a frame was not drawn.
#[derive(Debug)]
pub(super) enum PartError {
    /// It must be drawn in smaller parts.
    Overflow,
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
