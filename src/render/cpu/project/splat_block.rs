//! Sixteen splats: their screen ellipses, their visibility on the image, and their storage.
//!
//! **A splat stores a Cholesky factor of its inverse covariance, not the inverse itself (a
//! "conic").** The rasterizer's exponent is then `log2(opacity) - (l0 dx + l1 dy)² - (l2 dy)²`, a
//! sum of squares, which stays correct in sign however thin the needle. Swapping the axes when the
//! ellipse is wider than high would make the larger pivot come first. Needles of 1,000 to 10,000 px
//! at steps of 2° were measured without the swap: alpha is within 2e-3 of f64 at every angle
//! (stress case T1), as the error of either pivot is `1e-7 √(ac/det)`. So there is one form, and
//! the row loop has no branch.

use fearless_simd::{f32x16, mask32x16, prelude::*};

use crate::constants::{EXTENT_SLACK_PX, MAX_SIGMA_PX};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::math::log2;
use crate::layout::{Cutoffs, PixelFilter, Splat};
use wildcity_scene::SemanticClass;
use wildcity_scene::chunk::LANES;

/// `√(log2(e)/2)`: converts standard deviations to the unit of [`Splat::factor`], because
/// `exp(-q/2) = 2^(-q log2(e)/2)`.
pub(super) const LOG2_UNIT: f32 = 0.849_321_8;

/// Screen ellipses of 16 splats, by the factor of their inverse covariance.
pub(super) struct Ellipse<S: Simd> {
    l0: f32x16<S>,
    l1: f32x16<S>,
    l2: f32x16<S>,
    /// Standard deviation along x, in pixels.
    sigma_x: f32x16<S>,
    /// Standard deviation along y, in pixels.
    sigma_y: f32x16<S>,
    /// Determinant before the blur as a share of the one after the blur of native pixels.
    blur_share: f32x16<S>,
    /// For an image below its native size: determinant after the blur of native pixels as a share
    /// of the one after the whole filter.
    shrink_share: Option<f32x16<S>>,
}

impl<S: Simd> Ellipse<S> {
    /// From the rows of `V = J W R S`, in pixels: a square root of the screen covariance before the
    /// blur.
    ///
    /// `Σ′ = V Vᵀ + blur I`. With the 2 x 2 minors `m` of `V` (its rows' cross product), Cauchy and
    /// Binet's formula gives `det Σ′ = |m|² + blur |V|² + blur²`: a sum of positives, exact to
    /// rounding even for needles, for which `ac - b²` cancels to nothing. The determinant is of
    /// fourth order in the size, so that a splat wider than [`MAX_SIGMA_PX`] is computed in a unit
    /// larger than the pixel.
    #[inline(always)]
    pub(super) fn from_root(simd: S, v0: Vec3x16<S>, v1: Vec3x16<S>, filter: &PixelFilter) -> Self {
        let splat = |value: f32| f32x16::splat(simd, value);
        // At least 1e-30, so that a Gaussian of size 0 does not divide by 0.
        let widest = v0.max_abs().max(v1.max_abs()).max(splat(1e-30));
        let units_per_px = (splat(MAX_SIGMA_PX) / widest).min(splat(1.0));
        let px_per_unit = splat(1.0) / units_per_px;
        let v0 = v0.scale(units_per_px);
        let v1 = v1.scale(units_per_px);

        // |v0 x v1|^2 is the sum of the squared 2 x 2 minors.
        let minors = v0.cross(v1);
        let moments =
            Moments { xx: v0.dot(v0), yy: v1.dot(v1), xy: v0.dot(v1), det: minors.dot(minors) };
        let ellipse = Self::from_moments(simd, moments, filter, units_per_px);
        Self {
            // Back to pixels. The factor is in 1/px already, since `log2_unit` has the unit in it.
            sigma_x: ellipse.sigma_x * px_per_unit,
            sigma_y: ellipse.sigma_y * px_per_unit,
            ..ellipse
        }
    }

    /// From the covariance before the blur, whose unit of length is a pixel divided by
    /// `units_per_px`.
    ///
    /// With `Σ′ = [a b; b c]` the exponent's form is
    /// `q(dx, dy) = (dx, dy) Σ′⁻¹ (dx, dy)ᵀ = (c dx - b dy)²/(c det) + dy²/c`, and so
    /// `l0 = √c/√det`, `l1 = -b/(√c √det)` and `l2 = 1/√c`, each times `log2_unit`. An image below
    /// its native size is filtered by another variance along each axis ([`PixelFilter`]). Native
    /// images have their own branch, since another order of the sums would change their bytes.
    #[inline(always)]
    pub(super) fn from_moments(
        simd: S,
        moments: Moments<S>,
        filter: &PixelFilter,
        units_per_px: f32x16<S>,
    ) -> Self {
        let Moments { xx, yy, xy, det: det_before } = moments;
        let log2_unit = f32x16::splat(simd, LOG2_UNIT) * units_per_px;
        // A variance in the moments' unit of area.
        let area = |px2: f64| f32x16::splat(simd, px2 as f32) * units_per_px * units_per_px;
        let blur_x = area(filter.total_px2.x);
        let sigma_x;
        let sigma_y;
        let det;
        let blur_share;
        let shrink_share;
        if filter.is_shrunk() {
            let blur_y = area(filter.total_px2.y);
            let native_x = area(filter.native_px2.x);
            let native_y = area(filter.native_px2.y);
            // det(C + diag(u, v)) = det C + u C_yy + v C_xx + u v, a sum of positives, too.
            let det_native = native_x.mul_add(yy + native_y, native_y.mul_add(xx, det_before));
            det = blur_x.mul_add(yy + blur_y, blur_y.mul_add(xx, det_before));
            sigma_x = (xx + blur_x).sqrt();
            sigma_y = (yy + blur_y).sqrt();
            blur_share = det_before / det_native;
            shrink_share = Some(det_native / det);
        } else {
            det = blur_x.mul_add(xx + yy + blur_x, det_before);
            sigma_x = (xx + blur_x).sqrt();
            sigma_y = (yy + blur_x).sqrt();
            blur_share = det_before / det;
            shrink_share = None;
        }
        let l2 = log2_unit / sigma_y;
        let root_det = det.sqrt();
        Self {
            l0: log2_unit * sigma_y / root_det,
            l1: -(xy * l2) / root_det,
            l2,
            sigma_x,
            sigma_y,
            blur_share,
            shrink_share,
        }
    }
}

/// Screen covariances of 16 splats before the blur, and their determinants.
///
/// The determinant is given and not computed from the others: see [`Ellipse::from_root`].
pub(super) struct Moments<S: Simd> {
    pub(super) xx: f32x16<S>,
    pub(super) yy: f32x16<S>,
    pub(super) xy: f32x16<S>,
    pub(super) det: f32x16<S>,
}

/// Sixteen projected Gaussians, not yet tested against the image.
pub(super) struct ProjectedBlock<S: Simd> {
    pub(super) mean_x: f32x16<S>,
    /// Row of the centre, in pixels from the top of the image.
    pub(super) mean_y: f32x16<S>,
    /// Depth of the centre, in metres.
    pub(super) depth_m: f32x16<S>,
    /// Base-2 logarithm of the peak opacity, as stored.
    pub(super) log2_opacity: f32x16<S>,
    pub(super) ellipse: Ellipse<S>,
    /// The Gaussians that can be visible.
    pub(super) in_range: mask32x16<S>,
}

impl<S: Simd> ProjectedBlock<S> {
    /// The splats that reach a pixel's centre of an image of this size, without their colours.
    #[inline(always)]
    pub(super) fn clip(self, simd: S, size_px: [f32; 2], cutoffs: &Cutoffs) -> SplatBlock {
        let splat = |value: f32| f32x16::splat(simd, value);
        let Self { mean_x, mean_y, depth_m, mut log2_opacity, ellipse, in_range } = self;
        if cutoffs.antialiased {
            // Yu et al. 2024 (Mip-Splatting): √(det before / det after), with gsplat's floor of
            // 0.005.
            // The root of the determinants' ratio becomes half of the logarithm.
            let ratio = ellipse.blur_share.max(splat(0.005 * 0.005));
            log2_opacity = splat(0.5).mul_add(log2(simd, ratio), log2_opacity);
        }
        if let Some(ratio) = ellipse.shrink_share {
            let power = splat(PixelFilter::SHRINK_POWER as f32);
            log2_opacity = power.mul_add(log2(simd, ratio), log2_opacity);
        }

        // The box where alpha reaches the cut: u² + v² = log2(opacity) - log2(alpha_cut), and along
        // x and y the ellipse extends by √ of that in standard deviations, divided by the unit.
        let power = log2_opacity - splat(cutoffs.log2_alpha_cut);
        // The unit is that of the factor: u^2 + v^2 = (standard deviations)^2 x LOG2_UNIT^2.
        let reach = power.max(splat(0.0)).sqrt() / splat(LOG2_UNIT);
        let extent_x = reach.mul_add(ellipse.sigma_x, splat(EXTENT_SLACK_PX));
        let extent_y = reach.mul_add(ellipse.sigma_y, splat(EXTENT_SLACK_PX));

        let visible = in_range
            & power.simd_ge(splat(0.0))
            & on_image(simd, mean_x, extent_x, size_px[0])
            & on_image(simd, mean_y, extent_y, size_px[1]);
        if visible.all_false() {
            return SplatBlock::default();
        }
        SplatBlock {
            visible: visible.to_bitmask(),
            mean_x: mean_x.to_array(),
            mean_y: mean_y.to_array(),
            l0: ellipse.l0.to_array(),
            l1: ellipse.l1.to_array(),
            l2: ellipse.l2.to_array(),
            log2_opacity: log2_opacity.to_array(),
            depth_m: depth_m.to_array(),
            extent_x: extent_x.to_array(),
            extent_y: extent_y.to_array(),
            ..SplatBlock::default()
        }
    }
}

/// The splats that reach a pixel's centre of an image of this size along one axis: these lie at 0.5
/// to size - 0.5.
#[inline(always)]
fn on_image<S: Simd>(simd: S, mean: f32x16<S>, extent: f32x16<S>, size_px: f32) -> mask32x16<S> {
    let first = f32x16::splat(simd, 0.5);
    let last = f32x16::splat(simd, size_px - 0.5);
    (mean + extent).simd_ge(first) & (mean - extent).simd_le(last)
}

/// Sixteen splats as columns (the fields of [`Splat`]), and which of them are visible, one bit
/// each.
#[derive(Default)]
pub(super) struct SplatBlock {
    pub(super) visible: u64,
    pub(super) mean_x: [f32; LANES],
    pub(super) mean_y: [f32; LANES],
    pub(super) l0: [f32; LANES],
    pub(super) l1: [f32; LANES],
    pub(super) l2: [f32; LANES],
    pub(super) log2_opacity: [f32; LANES],
    pub(super) red: [f32; LANES],
    pub(super) green: [f32; LANES],
    pub(super) blue: [f32; LANES],
    pub(super) depth_m: [f32; LANES],
    pub(super) extent_x: [f32; LANES],
    pub(super) extent_y: [f32; LANES],
}

impl SplatBlock {
    #[inline(always)]
    pub(super) fn set_colors<S: Simd>(&mut self, rgb: Vec3x16<S>) {
        rgb.x.store_array(&mut self.red);
        rgb.y.store_array(&mut self.green);
        rgb.z.store_array(&mut self.blue);
    }

    /// Takes the visible splats of another block of the same Gaussians into their lanes.
    pub(super) fn merge(&mut self, other: &Self) {
        // Colours are not taken: they are computed once for both blocks.
        for i in (0..LANES).filter(|i| other.visible >> i & 1 == 1) {
            self.mean_x[i] = other.mean_x[i];
            self.mean_y[i] = other.mean_y[i];
            self.l0[i] = other.l0[i];
            self.l1[i] = other.l1[i];
            self.l2[i] = other.l2[i];
            self.log2_opacity[i] = other.log2_opacity[i];
            self.depth_m[i] = other.depth_m[i];
            self.extent_x[i] = other.extent_x[i];
            self.extent_y[i] = other.extent_y[i];
        }
        self.visible |= other.visible;
    }

    #[inline(always)]
    pub(super) fn colors<S: Simd>(&self, simd: S) -> Vec3x16<S> {
        Vec3x16 {
            x: f32x16::load_array_ref(simd, &self.red),
            y: f32x16::load_array_ref(simd, &self.green),
            z: f32x16::load_array_ref(simd, &self.blue),
        }
    }

    /// Appends the classes of the visible splats, in their order; `own` begins with the class of
    /// the first lane.
    pub(super) fn append_classes(&self, own: &[SemanticClass], classes: &mut Vec<SemanticClass>) {
        // The lanes after the last Gaussian of a chunk are never visible.
        let visible =
            own.iter().take(LANES).enumerate().filter(|(i, _)| self.visible >> i & 1 == 1);
        classes.extend(visible.map(|(_, class)| *class));
    }

    /// Appends the visible splats, in order of lanes and so of global ids.
    #[inline(always)]
    pub(super) fn append_visible(&self, splats: &mut Vec<Splat>) {
        let mut visible = self.visible;
        while visible != 0 {
            // At most 16 bits are set; the remainder saves the tests of the bounds below.
            let i = visible.trailing_zeros() as usize % LANES;
            visible &= visible - 1;
            splats.push(Splat {
                mean_px: [self.mean_x[i], self.mean_y[i]],
                factor: [self.l0[i], self.l1[i], self.l2[i]],
                log2_opacity: self.log2_opacity[i],
                rgb: [self.red[i], self.green[i], self.blue[i]],
                depth_m: self.depth_m[i],
                extent_px: [self.extent_x[i], self.extent_y[i]],
            });
        }
    }
}
