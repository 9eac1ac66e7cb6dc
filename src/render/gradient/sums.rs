//! The sums over a splat's pixels that all its derivatives need.

use glam::{DVec2, DVec3};

use super::FootprintGradient;
use crate::layout::PixelFilter;

/// Sums over pixels of a splat, by the places in [`partial`].
pub(crate) type Partial = [f32; partial::COUNT];

/// Places of the sums of g, g u, g v, g u², g u v and g v², and of the derivatives by colour and
/// depth. `g` is the derivative by the logarithm of alpha, u and v are those of a splat's exponent.
pub(crate) mod partial {
    pub(crate) const G: usize = 0;
    pub(crate) const U: usize = 1;
    pub(crate) const V: usize = 2;
    pub(crate) const UU: usize = 3;
    pub(crate) const UV: usize = 4;
    pub(crate) const VV: usize = 5;
    pub(crate) const RGB: usize = 6;
    pub(crate) const DEPTH: usize = 9;
    pub(crate) const COUNT: usize = 10;
}

impl FootprintGradient {
    /// The derivatives by the place and the covariance of a splat with this factor (l0, l1, l2) of
    /// its inverse covariance, given those by the vector from the camera to the centre.
    pub(crate) fn from_sums(
        sums: &Partial,
        factor: [f32; 3],
        filter: &PixelFilter,
        antialiased: bool,
        toward: DVec3,
    ) -> Self {
        let sum = |place: usize| f64::from(sums[place]);
        let [l0, l1, l2] = factor.map(f64::from);
        let ln2 = std::f64::consts::LN_2;
        let g = sum(partial::G);
        let shrink = if filter.is_shrunk() { PixelFilter::SHRINK_POWER * g } else { 0.0 };
        // The total covariance has the inverse 2 ln2 Fᵀ F, which fits into the moments.
        let uu = sum(partial::UU) - shrink / ln2;
        let vv = sum(partial::VV) - shrink / ln2;
        let uv = sum(partial::UV);
        let row = uu * l1 + uv * l2;
        let unit = 2.0 * ln2 * ln2;
        Self {
            mean_px: 2.0
                * ln2
                * DVec2::new(l0 * sum(partial::U), l1 * sum(partial::U) + l2 * sum(partial::V)),
            covariance: unit
                * DVec3::new(l0 * l0 * uu, l0 * row, l1 * row + l2 * (uv * l1 + vv * l2)),
            ln_blur_share: if antialiased { 0.5 * g } else { 0.0 },
            ln_det_native: shrink,
            native_px2: filter.native_px2,
            depth_m: sum(partial::DEPTH),
            depth_is_z: false,
            toward,
        }
    }
}
