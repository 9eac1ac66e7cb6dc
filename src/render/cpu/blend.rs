//! Blends the splats of a batch over one block of pixels.

use fearless_simd::{f32x16, prelude::*};

use super::batch::{BATCH, Batch};
use super::math::exp2;
use super::resolve::{HalvedBy, TileSums};
use crate::layout::Cutoffs;
use wildcity_scene::chunk::LANES;

/// Blends the splats that touch a block over it, from front to back. Returns whether all pixels of
/// the block have stopped, and how many splats were blended.
///
/// Each splat has `alpha = min(cap, 2^(log2(opacity) - u² - v²))`, and adds `alpha T` of its
/// colour; then the transmittance T is multiplied by `1 - alpha` (Kerbl et al. 2023, eq. 3). A
/// pixel stops before the splat that would bring T to the stop or below.
///
/// **The transmittance that decides about stopping continues to fall after a pixel has stopped.**
/// It never rises, so that the test `after > stop` remains false without a mask, and each iteration
/// depends on the previous one by a single multiply-add. The transmittance of the image is a
/// separate value, which changes only where the test holds.
#[inline(always)]
pub(super) fn blend<S: Simd, const DEPTH: bool, const OWNERS: bool>(
    simd: S,
    batch: &Batch,
    block: usize,
    cutoffs: &Cutoffs,
    sums: &mut TileSums,
    halved_by: &mut HalvedBy,
) -> (bool, usize) {
    let splat = |value: f32| f32x16::splat(simd, value);
    let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
    let cap = splat(cutoffs.alpha_cap);
    let cut = splat(cutoffs.log2_alpha_cut);
    let stop = splat(cutoffs.stop);
    // Less than any stop, and larger than the denormal numbers, whose multiplication is slow.
    let floor = splat(1e-20);

    // Keep all sums in registers.
    let mut r = load(&sums.rgb[0][block]);
    let mut g = load(&sums.rgb[1][block]);
    let mut b = load(&sums.rgb[2][block]);
    let mut depth = load(&sums.depth_m[block]);
    let mut transmittance = load(&sums.transmittance[block]);
    let mut running = load(&sums.running[block]);
    let mut touching = batch.touching[block];
    let mut count = 0;
    let mut stopped = false;
    // The bits of a batch are in order of depth, so the lowest bit is the nearest splat.
    while touching != 0 {
        count += 1;
        let index = touching.trailing_zeros() as usize % BATCH;
        let matched = &batch.matched[index];
        touching &= touching - 1;

        // Alpha; 0 where it is below the cut.
        let u = load(&matched.lane_u) + splat(matched.u[block]);
        let v = load(&matched.lane_v) + splat(matched.v[block]);
        let exponent = (-v).mul_add(v, (-u).mul_add(u, splat(matched.log2_opacity)));
        let uncut = exp2(simd, exponent).min(cap);
        let alpha = exponent.simd_ge(cut).select(uncut, splat(0.0));

        // The weight; 0 in pixels that stop here or stopped before.
        // Each splat is weighted by the transmittance before it: T (1 - alpha) is that after it.
        let after = (-alpha).mul_add(running, running);
        let counts = after.simd_gt(stop);
        let weight = counts.select(alpha * running, splat(0.0));
        running = after.max(floor);

        r = weight.mul_add(splat(matched.rgb[0]), r);
        g = weight.mul_add(splat(matched.rgb[1]), g);
        b = weight.mul_add(splat(matched.rgb[2]), b);
        if DEPTH {
            depth = weight.mul_add(splat(matched.depth_m), depth);
        }
        if OWNERS {
            let half = splat(0.5);
            // The transmittance passes 1/2 only once, so that at most one splat is noted per pixel.
            let halves = counts & after.simd_le(half) & transmittance.simd_gt(half);
            let mut lanes = halves.to_bitmask();
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % LANES;
                // 0 means none, so that places are counted from 1.
                halved_by[block][lane] = batch.places[index] + 1;
                lanes &= lanes - 1;
            }
        }
        transmittance = counts.select(after, transmittance);
        // Only here and not per pixel: one test per splat and block.
        if counts.all_false() {
            stopped = true;
            break;
        }
    }
    r.store_array(&mut sums.rgb[0][block]);
    g.store_array(&mut sums.rgb[1][block]);
    b.store_array(&mut sums.rgb[2][block]);
    depth.store_array(&mut sums.depth_m[block]);
    transmittance.store_array(&mut sums.transmittance[block]);
    running.store_array(&mut sums.running[block]);
    (stopped, count)
}
