//! The derivatives of blending: each tile walks its splats from front to back once more, as they
//! were drawn ([`crate::gradient`] has the formulas).
//!
//! Every product that decides (exponent, cut, cap, stop) is computed as in [`super::blend`], so
//! that the walk takes the same decisions. **One splat after the other, and not one block after the
//! other as when it is drawn:** its ten sums stay in registers for all of its blocks, and are added
//! up over the lanes once per tile, while a block's pixels have only two values that change.

use fearless_simd::{f32x16, prelude::*};

use super::batch::Matched;
use super::lanes::splats;
use super::math::exp2;
use super::resolve::{BLOCKS, TileSums};
use crate::gradient::{Partial, partial};
use crate::layout::Cutoffs;
use wildcity_scene::chunk::LANES;

/// The derivatives of a loss by the images, for the 256 pixels of a tile; 0 beyond the image.
#[derive(Clone, Debug)]
#[repr(C, align(64))]
pub(super) struct TileDerivatives {
    pub(super) rgb: [[[f32; LANES]; BLOCKS]; 3],
    pub(super) opacity: [[f32; LANES]; BLOCKS],
    pub(super) depth_m: [[f32; LANES]; BLOCKS],
}

impl Default for TileDerivatives {
    fn default() -> Self {
        let zero = [[0.0; LANES]; BLOCKS];
        Self { rgb: [zero; 3], opacity: zero, depth_m: zero }
    }
}

/// What changes while a tile's splats are walked.
#[derive(Clone, Debug)]
#[repr(C, align(64))]
pub(super) struct TileWalk {
    /// Transmittance in front of the next splat. It continues to fall after a pixel has stopped, as
    /// in [`super::blend`].
    running: [[f32; LANES]; BLOCKS],
    /// Change of the loss with what lies behind: `Σ w (rgb · v_rgb + depth v_depth)` of all splats
    /// from the next one on, minus `T_end v_opacity`.
    behind: [[f32; LANES]; BLOCKS],
    /// A bit for each block in which some pixel has not stopped.
    pub(super) live: u16,
    /// Whether all derivatives by the tile's pixels are finite.
    pub(super) is_finite: bool,
}

impl TileWalk {
    /// In front of the first splat. `sums` are those of the finished tile, without a background.
    #[inline(always)]
    pub(super) fn new<S: Simd, const DEPTH: bool>(
        simd: S,
        sums: &TileSums,
        by: &TileDerivatives,
    ) -> Self {
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let zero = f32x16::splat(simd, 0.0);
        let mut behind = [[0.0; LANES]; BLOCKS];
        // 0 x is NaN for infinity and NaN, and so is a sum with it.
        let mut test = zero;
        for (block, behind) in behind.iter_mut().enumerate() {
            let by_opacity = load(&by.opacity[block]);
            let mut sum = -(load(&sums.transmittance[block]) * by_opacity);
            test = by_opacity.mul_add(zero, test);
            for channel in 0..3 {
                let by_channel = load(&by.rgb[channel][block]);
                sum = load(&sums.rgb[channel][block]).mul_add(by_channel, sum);
                test = by_channel.mul_add(zero, test);
            }
            if DEPTH {
                let by_depth = load(&by.depth_m[block]);
                sum = load(&sums.depth_m[block]).mul_add(by_depth, sum);
                test = by_depth.mul_add(zero, test);
            }
            sum.store_array(behind);
        }
        let is_finite = test.simd_eq(zero).all_true();
        Self { running: [[1.0; LANES]; BLOCKS], behind, live: u16::MAX, is_finite }
    }

    /// Walks past one splat in the blocks that it touches, and returns its sums over them.
    #[inline(always)]
    pub(super) fn pass<S: Simd, const DEPTH: bool>(
        &mut self,
        simd: S,
        matched: &Matched,
        touching: u16,
        cutoffs: &Cutoffs,
        by: &TileDerivatives,
    ) -> Partial {
        let splat = |value: f32| f32x16::splat(simd, value);
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let zero = splat(0.0);
        let cap = splat(cutoffs.alpha_cap);
        let cut = splat(cutoffs.log2_alpha_cut);
        let stop = splat(cutoffs.stop);
        let floor = splat(1e-20);
        let lane_u = load(&matched.lane_u);
        let lane_v = load(&matched.lane_v);
        let log2_opacity = splat(matched.log2_opacity);
        let [red, green, blue] = splats(simd, matched.rgb);
        let depth_m = splat(matched.depth_m);

        let mut sums = [zero; partial::COUNT];
        let mut blocks = touching & self.live;
        while blocks != 0 {
            let block = blocks.trailing_zeros() as usize % BLOCKS;
            blocks &= blocks - 1;

            let u = lane_u + splat(matched.u[block]);
            let v = lane_v + splat(matched.v[block]);
            let exponent = (-v).mul_add(v, (-u).mul_add(u, log2_opacity));
            let raw = exp2(simd, exponent);
            let alpha = exponent.simd_ge(cut).select(raw.min(cap), zero);
            let running = load(&self.running[block]);
            let after = (-alpha).mul_add(running, running);
            let counts = after.simd_gt(stop);
            let weight = counts.select(alpha * running, zero);
            let after = after.max(floor);
            after.store_array(&mut self.running[block]);

            let by_red = load(&by.rgb[0][block]);
            let by_green = load(&by.rgb[1][block]);
            let by_blue = load(&by.rgb[2][block]);
            let mut energy = red.mul_add(by_red, green.mul_add(by_green, blue * by_blue));
            if DEPTH {
                let by_depth = load(&by.depth_m[block]);
                energy = depth_m.mul_add(by_depth, energy);
                sums[partial::DEPTH] = weight.mul_add(by_depth, sums[partial::DEPTH]);
            }
            let behind = (-weight).mul_add(energy, load(&self.behind[block]));
            behind.store_array(&mut self.behind[block]);

            // T e - behind/(1 - alpha) is (e - behind/T') T with the transmittance T' behind the
            // splat, and T alpha is the weight. Nothing at the cap: alpha does not change there.
            let by_weight = energy - behind / after;
            let g = (counts & raw.simd_le(cap)).select(weight * by_weight, zero);
            let gu = g * u;
            let gv = g * v;
            sums[partial::G] += g;
            sums[partial::U] += gu;
            sums[partial::V] += gv;
            sums[partial::UU] = gu.mul_add(u, sums[partial::UU]);
            sums[partial::UV] = gu.mul_add(v, sums[partial::UV]);
            sums[partial::VV] = gv.mul_add(v, sums[partial::VV]);
            sums[partial::RGB] = weight.mul_add(by_red, sums[partial::RGB]);
            sums[partial::RGB + 1] = weight.mul_add(by_green, sums[partial::RGB + 1]);
            sums[partial::RGB + 2] = weight.mul_add(by_blue, sums[partial::RGB + 2]);
            if counts.all_false() {
                self.live &= !(1 << block);
            }
        }
        lane_sums(sums)
    }
}

/// The sums over the lanes of ten vectors.
///
/// Neighbours are added two vectors at a time, so that one vector holds all sums after four rounds
/// of 5, 3, 2 and 1 additions; ten vectors one by one would take four each.
#[inline(always)]
fn lane_sums<S: Simd>(sums: [f32x16<S>; partial::COUNT]) -> Partial {
    let [a, b, c, d, e, f, g, h, i, k] = sums;
    let two = neighbours(i, k);
    let eight = neighbours(
        neighbours(neighbours(a, b), neighbours(c, d)),
        neighbours(neighbours(e, f), neighbours(g, h)),
    );
    let two = neighbours(two, two);
    let all = neighbours(eight, neighbours(two, two)).to_array();
    let mut partial = [0.0; partial::COUNT];
    partial.copy_from_slice(&all[..partial::COUNT]);
    partial
}

/// Sums of neighbouring lanes: those of `a` in the lower half, those of `b` in the upper half.
#[inline(always)]
fn neighbours<S: Simd>(a: f32x16<S>, b: f32x16<S>) -> f32x16<S> {
    a.unzip_low(b) + a.unzip_high(b)
}
