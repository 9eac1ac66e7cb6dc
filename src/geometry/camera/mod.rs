//! Camera models: one file each.

pub mod pinhole;

pub use pinhole::Pinhole;

/// An image size and the model that maps camera rays to its pixels.
///
/// Pixel (column, row) covers `[column, column + 1) x [row, row + 1)`; its centre is at +0.5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width, in pixels.
    pub width_px: u32,
    /// Image height, in pixels.
    pub height_px: u32,
    /// Intrinsics.
    pub pinhole: Pinhole,
}

/// Why a camera was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A side is zero or above the limit.
    #[error("{field} is {value}; a side is from 1 to {limit} pixels")]
    Size {
        /// `width` or `height`.
        field: &'static str,
        /// The refused value, in pixels.
        value: u64,
        /// The largest accepted side, in pixels.
        limit: u32,
    },
    /// An intrinsic is not a usable number.
    #[error("{field} is {value}; {must}")]
    Intrinsic {
        /// `fx`, `fy`, `cx` or `cy`.
        field: &'static str,
        /// The refused value, in pixels.
        value: f64,
        /// What must hold instead.
        must: &'static str,
    },
}

impl CameraError {
    /// The field at fault, as it is called in camera files and on the wire.
    pub fn field(&self) -> &'static str {
        match self {
            Self::Size { field, .. } | Self::Intrinsic { field, .. } => field,
        }
    }
}

impl Camera {
    /// The largest accepted side, in pixels: 16 K panoramas, and 16-bit tile coordinates suffice.
    pub const MAX_SIDE_PX: u32 = 16_384;

    /// A pinhole camera from outside, all in pixels.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    pub fn checked(width_px: u64, height_px: u64, pinhole: Pinhole) -> Result<Self, CameraError> {
        let side = |field, value| match u32::try_from(value) {
            Ok(side) if (1..=Self::MAX_SIDE_PX).contains(&side) => Ok(side),
            _ => Err(CameraError::Size { field, value, limit: Self::MAX_SIDE_PX }),
        };
        let (width_px, height_px) = (side("width", width_px)?, side("height", height_px)?);
        pinhole.check()?;
        Ok(Self { width_px, height_px, pinhole })
    }

    /// Pixels in the image.
    pub fn pixels(&self) -> usize {
        self.width_px as usize * self.height_px as usize
    }
}
