//! Rolling shutters: the rows or columns of an image are exposed one after the other.

use glam::DVec2;
use wildcity_options::camera as options;

use super::{Camera, CameraError};

/// A rolling shutter. A camera with a global shutter has none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shutter {
    /// The order of exposure.
    pub direction: ShutterDirection,
    /// Time from the exposure of the first row to that of the last, in microseconds. The time of
    /// the image is that of the last row.
    pub duration_us: i64,
}

/// The order in which a rolling shutter exposes rows or columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ShutterDirection {
    /// The top row first.
    TopToBottom,
    /// The bottom row first.
    BottomToTop,
    /// The left column first.
    LeftToRight,
    /// The right column first.
    RightToLeft,
}

impl From<options::Shutter> for Shutter {
    fn from(options::Shutter { direction, duration_us }: options::Shutter) -> Self {
        let direction = match direction {
            options::ShutterDirection::TopToBottom => ShutterDirection::TopToBottom,
            options::ShutterDirection::BottomToTop => ShutterDirection::BottomToTop,
            options::ShutterDirection::LeftToRight => ShutterDirection::LeftToRight,
            options::ShutterDirection::RightToLeft => ShutterDirection::RightToLeft,
        };
        Self { direction, duration_us }
    }
}

impl From<Shutter> for options::Shutter {
    fn from(Shutter { direction, duration_us }: Shutter) -> Self {
        let direction = match direction {
            ShutterDirection::TopToBottom => options::ShutterDirection::TopToBottom,
            ShutterDirection::BottomToTop => options::ShutterDirection::BottomToTop,
            ShutterDirection::LeftToRight => options::ShutterDirection::LeftToRight,
            ShutterDirection::RightToLeft => options::ShutterDirection::RightToLeft,
        };
        Self { direction, duration_us }
    }
}

impl Shutter {
    /// Longest accepted duration, in microseconds: 0.1 s, the period of a camera at 10 Hz.
    pub const MAX_US: i64 = 100_000;

    /// Checks the duration.
    ///
    /// # Errors
    /// The duration is not from 1 µs to [`Shutter::MAX_US`].
    pub fn check(&self) -> Result<(), CameraError> {
        if (1..=Self::MAX_US).contains(&self.duration_us) {
            return Ok(());
        }
        let must = "a rolling shutter takes 1 to 100,000 µs; omit shutter for a global one";
        let value = self.duration_us as f64;
        Err(CameraError::Intrinsic { field: "shutter.duration_us", value, must })
    }
}

impl ShutterDirection {
    /// When an image position (in pixels) is exposed, as a fraction of the duration: 0 at the
    /// centre of the first row, 1 at the centre of the last row, clamped to [0, 1].
    #[inline(always)]
    pub fn fraction(self, at_px: DVec2, camera: &Camera) -> f64 {
        let along = |at_px: f64, size_px: u32| {
            let last_px = f64::from(size_px) - 1.0;
            // The only row of an image of one row counts as the last row.
            if last_px > 0.0 { (at_px - 0.5) / last_px } else { 1.0 }
        };
        let fraction = match self {
            // Position of the row's centre, (row + 0.5 - 0.5) / (rows - 1).
            Self::TopToBottom => along(at_px.y, camera.height_px),
            // From below, the distance to the lower edge counts.
            Self::BottomToTop => along(f64::from(camera.height_px) - at_px.y, camera.height_px),
            Self::LeftToRight => along(at_px.x, camera.width_px),
            Self::RightToLeft => along(f64::from(camera.width_px) - at_px.x, camera.width_px),
        };
        fraction.clamp(0.0, 1.0)
    }
}
