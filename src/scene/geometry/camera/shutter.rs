//! Rolling shutters: rows, or columns, are exposed one after the other.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::{Camera, CameraError};

/// How an image is exposed. A global shutter is none of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shutter {
    /// Which row or column comes first.
    pub direction: ShutterDirection,
    /// From the exposure of the first row to that of the last, in microseconds. The image's time is
    /// that of the last.
    pub duration_us: i64,
}

/// The way a shutter rolls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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

impl Shutter {
    /// Longest exposure, in microseconds: a tenth of the slowest cameras' second.
    pub const MAX_US: i64 = 100_000;

    /// # Errors
    /// The duration is not within 1 µs to [`Shutter::MAX_US`].
    pub fn check(&self) -> Result<(), CameraError> {
        if (1..=Self::MAX_US).contains(&self.duration_us) {
            return Ok(());
        }
        let must = "a shutter rolls for 1 to 100,000 µs; leave shutter out for a global one";
        let value = self.duration_us as f64;
        Err(CameraError::Intrinsic { field: "shutter.duration_us", value, must })
    }
}

impl ShutterDirection {
    /// When a place on the image is exposed: 0 with the first row's middle, 1 with the last's, and
    /// neither sooner nor later.
    #[inline(always)]
    pub fn fraction(self, at_px: DVec2, camera: &Camera) -> f64 {
        let along = |at_px: f64, size_px: u32| {
            let last_px = f64::from(size_px) - 1.0;
            // A single row is the last one.
            if last_px > 0.0 { (at_px - 0.5) / last_px } else { 1.0 }
        };
        let fraction = match self {
            Self::TopToBottom => along(at_px.y, camera.height_px),
            Self::BottomToTop => along(f64::from(camera.height_px) - at_px.y, camera.height_px),
            Self::LeftToRight => along(at_px.x, camera.width_px),
            Self::RightToLeft => along(f64::from(camera.width_px) - at_px.x, camera.width_px),
        };
        fraction.clamp(0.0, 1.0)
    }
}
