//! A point of a capture.

/// A point in the axes and unit of the capture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CapturePoint {
    pub at: [f64; 3],
    pub rgb8: [u8; 3],
}
