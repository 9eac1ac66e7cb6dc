//! The hits of 16 beams of a row, up to their returns.
//!
//! The beams of a row are compared with a Gaussian together, and so they keep its hits together:
//! one insertion into sorted lists for 16 beams.

use fearless_simd::{f32x16, mask32x16, prelude::*, u32x16};

use crate::lidar::HALF;
use wildcity_scene::chunk::LANES;

/// A Gaussian that a beam of a sector has met.
#[derive(Clone, Copy, Debug)]
pub(super) struct Met {
    /// The global id: the chunk, then the index.
    pub(super) id: u64,
    pub(super) luminance: f32,
    /// Its owner, as in [`Sweep::instance`](crate::lidar::Sweep::instance).
    pub(super) instance: u16,
}

/// Where 16 beams meet a Gaussian.
pub(super) struct Crossing<S: Simd> {
    /// Infinite for a beam that does not meet it.
    pub(super) range_m: f32x16<S>,
    /// 0 for a beam that does not meet it.
    pub(super) alpha: f32x16<S>,
}

/// The n-th hit of each beam. A beam that has fewer hits has one here that is infinitely far away,
/// with an alpha of 0.
#[derive(Clone, Copy, Debug)]
struct Slot {
    range_m: [f32; LANES],
    alpha: [f32; LANES],
    /// The transmittance behind it.
    after: [f32; LANES],
    /// Places among the Gaussians that the sector has met.
    met: [u32; LANES],
}

/// The hits of each beam from the nearest; at the same range, in the order of ids. A hit behind the
/// return changes nothing and is dropped, so that few are kept.
#[derive(Clone, Debug, Default)]
pub(super) struct BeamRow {
    slots: Vec<Slot>,
}

/// Where a beam returns.
pub(super) struct Return {
    pub(super) range_m: f32,
    /// What it meets there.
    pub(super) met: Met,
    /// Mean luminance of the hits up to it, weighted by what each contributes.
    pub(super) luminance: f32,
}

impl BeamRow {
    /// Bytes of a hit of a beam.
    pub(super) const HIT_BYTES: usize = size_of::<Slot>() / LANES;

    pub(super) fn clear(&mut self) {
        self.slots.clear();
    }

    /// Calls `visit` with the place of each hit's Gaussian.
    pub(super) fn visit_hits(&mut self, visit: &mut impl FnMut(&mut u32)) {
        for slot in &mut self.slots {
            let hits = slot.met.iter_mut().zip(&slot.range_m);
            hits.filter(|(_, range_m)| range_m.is_finite()).for_each(|(met, _)| visit(met));
        }
    }

    /// Adds the hits of the Gaussian that was met last. `ends_m` becomes the ranges of the returns,
    /// for beams that have one.
    #[inline(always)]
    pub(super) fn add<S: Simd>(
        &mut self,
        simd: S,
        crossing: Crossing<S>,
        all: &[Met],
        ends_m: &mut [f32; LANES],
    ) {
        let half = f32x16::splat(simd, HALF as f32);
        let never = f32x16::splat(simd, f32::INFINITY);
        let zero = f32x16::splat(simd, 0.0);
        let one = f32x16::splat(simd, 1.0);
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let Crossing { mut range_m, mut alpha } = crossing;
        let mut met = [(all.len() - 1) as u32; LANES];

        // Slots in front of all that is added stay as they are.
        let mut first = self.slots.len();
        while first > 0 {
            let slot = &self.slots[first - 1];
            if is_before(simd, (range_m, &met), (load(&slot.range_m), &slot.met), all).all_false() {
                break;
            }
            first -= 1;
        }
        let mut after = match first.checked_sub(1) {
            Some(last) => load(&self.slots[last].after),
            None => one,
        };
        let mut end_m = load(ends_m);
        for slot in &mut self.slots[first..] {
            let old_range_m = load(&slot.range_m);
            let old_alpha = load(&slot.alpha);
            // What comes first takes the slot; the other goes on to the next.
            let goes_here = is_before(simd, (range_m, &met), (old_range_m, &slot.met), all);
            let has_returned = after.simd_le(half);
            let here_m = has_returned.select(never, goes_here.select(range_m, old_range_m));
            let here_alpha = has_returned.select(zero, goes_here.select(alpha, old_alpha));
            range_m = goes_here.select(old_range_m, range_m);
            alpha = goes_here.select(old_alpha, alpha);
            swap(simd, goes_here, &mut met, &mut slot.met);
            after *= one - here_alpha;
            end_m = (after.simd_le(half) & !has_returned).select(here_m, end_m);
            slot.range_m = here_m.to_array();
            slot.alpha = here_alpha.to_array();
            slot.after = after.to_array();
        }
        let is_kept = range_m.simd_lt(never) & after.simd_gt(half);
        if is_kept.any_true() {
            let range_m = is_kept.select(range_m, never);
            let alpha = is_kept.select(alpha, zero);
            after *= one - alpha;
            end_m = (after.simd_le(half) & is_kept).select(range_m, end_m);
            self.slots.push(Slot {
                range_m: range_m.to_array(),
                alpha: alpha.to_array(),
                after: after.to_array(),
                met,
            });
        } else {
            while self
                .slots
                .last()
                .is_some_and(|slot| load(&slot.range_m).simd_ge(never).all_true())
            {
                self.slots.pop();
            }
        }
        *ends_m = end_m.to_array();
    }

    /// The return of a beam, if it has one.
    pub(super) fn returned(&self, lane: usize, all: &[Met]) -> Option<Return> {
        let mut before = 1.0;
        let mut sum = 0.0;
        for slot in &self.slots {
            // The beam has no hit here or behind, and the place of its Gaussian is out of date.
            if slot.range_m[lane].is_infinite() {
                return None;
            }
            let met = all[slot.met[lane] as usize];
            sum += before * slot.alpha[lane] * met.luminance;
            before = slot.after[lane];
            if before <= HALF as f32 {
                let range_m = slot.range_m[lane];
                return Some(Return { range_m, met, luminance: sum / (1.0 - before) });
            }
        }
        None
    }
}

/// Whether hits come before others on their beams.
#[inline(always)]
fn is_before<S: Simd>(
    simd: S,
    (range_m, met): (f32x16<S>, &[u32; LANES]),
    (other_m, other): (f32x16<S>, &[u32; LANES]),
    all: &[Met],
) -> mask32x16<S> {
    let is_nearer = range_m.simd_lt(other_m);
    let is_equal = range_m.simd_eq(other_m) & range_m.simd_lt(f32x16::splat(simd, f32::INFINITY));
    if is_equal.all_false() {
        return is_nearer;
    }
    // Gaussians in one place: the order of ids makes the return the same at any number of threads.
    let mut lanes = is_equal.to_bitmask();
    let mut earlier = 0;
    while lanes != 0 {
        let lane = lanes.trailing_zeros() as usize % LANES;
        lanes &= lanes - 1;
        let is_earlier = all[met[lane] as usize].id < all[other[lane] as usize].id;
        earlier |= u64::from(is_earlier) << lane;
    }
    is_nearer | mask32x16::from_bitmask(simd, earlier)
}

/// Exchanges the chosen lanes.
#[inline(always)]
fn swap<S: Simd>(simd: S, chosen: mask32x16<S>, one: &mut [u32; LANES], other: &mut [u32; LANES]) {
    let a = u32x16::load_array_ref(simd, one);
    let b = u32x16::load_array_ref(simd, other);
    *one = chosen.select(b, a).to_array();
    *other = chosen.select(a, b).to_array();
}
