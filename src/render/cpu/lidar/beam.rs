//! The hits of 16 beams of a row, up to their returns.
//!
//! The beams of a row are compared with a Gaussian together, and so they keep its hits together:
//! one insertion into sorted lists for 16 beams.

use fearless_simd::{f32x16, mask32x16, prelude::*, u32x16};

use crate::lidar::HALF;
use wildcity_scene::chunk::LANES;

/// Where 16 beams meet a Gaussian.
pub(super) struct Crossing<S: Simd> {
    /// Infinite for a beam that does not meet it.
    pub(super) range_m: f32x16<S>,
    /// 0 for a beam that does not meet it.
    pub(super) alpha: f32x16<S>,
    pub(super) luminance: f32,
    /// Its place among all Gaussians of the scene.
    pub(super) key: u32,
}

/// The n-th hit of each beam. A beam that has fewer hits has one here that is infinitely far away,
/// with an alpha of 0.
#[derive(Clone, Copy, Debug)]
struct Slot {
    range_m: [f32; LANES],
    alpha: [f32; LANES],
    /// The transmittance behind it.
    after: [f32; LANES],
    luminance: [f32; LANES],
    key: [u32; LANES],
}

/// The hits of each beam from the nearest; at the same range, in the order of keys. A hit behind
/// the return changes nothing and is dropped, so that few are kept.
#[derive(Clone, Debug, Default)]
pub(super) struct BeamRow {
    slots: Vec<Slot>,
}

/// The returns of 16 beams.
pub(super) struct Returns {
    /// 0 without a return.
    pub(super) range_m: [f32; LANES],
    /// Mean luminance of the hits up to it, weighted by what each contributes; 0 without a return.
    pub(super) luminance: [f32; LANES],
    /// What it meets there.
    pub(super) key: [u32; LANES],
}

/// Hits that look for their slots, one of each beam.
#[derive(Clone, Copy)]
struct Hits<S: Simd> {
    range_m: f32x16<S>,
    alpha: f32x16<S>,
    luminance: f32x16<S>,
    key: u32x16<S>,
}

impl BeamRow {
    /// Bytes of a hit of a beam.
    pub(super) const HIT_BYTES: usize = size_of::<Slot>() / LANES;

    pub(super) fn clear(&mut self) {
        self.slots.clear();
    }

    /// Adds the hits of a Gaussian. `ends_m` becomes the ranges of the returns, for beams that have
    /// one.
    #[inline(always)]
    pub(super) fn add<S: Simd>(
        &mut self,
        simd: S,
        crossing: &Crossing<S>,
        ends_m: &mut [f32; LANES],
    ) {
        let half = f32x16::splat(simd, HALF as f32);
        let never = f32x16::splat(simd, f32::INFINITY);
        let zero = f32x16::splat(simd, 0.0);
        let one = f32x16::splat(simd, 1.0);
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let mut added = Hits {
            range_m: crossing.range_m,
            alpha: crossing.alpha,
            luminance: f32x16::splat(simd, crossing.luminance),
            key: u32x16::splat(simd, crossing.key),
        };

        // Slots in front of all that is added stay as they are.
        let mut first = self.slots.len();
        while first > 0 {
            let slot = &self.slots[first - 1];
            if added
                .is_before(load(&slot.range_m), u32x16::load_array_ref(simd, &slot.key))
                .all_false()
            {
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
            let old = Hits {
                range_m: load(&slot.range_m),
                alpha: load(&slot.alpha),
                luminance: load(&slot.luminance),
                key: u32x16::load_array_ref(simd, &slot.key),
            };
            // What comes first takes the slot; the other goes on to the next.
            let goes_here = added.is_before(old.range_m, old.key);
            let has_returned = after.simd_le(half);
            let here = added.or(old, goes_here);
            let here_m = has_returned.select(never, here.range_m);
            let here_alpha = has_returned.select(zero, here.alpha);
            added = old.or(added, goes_here);
            after *= one - here_alpha;
            end_m = (after.simd_le(half) & !has_returned).select(here_m, end_m);
            slot.range_m = here_m.to_array();
            slot.alpha = here_alpha.to_array();
            slot.after = after.to_array();
            slot.luminance = here.luminance.to_array();
            slot.key = here.key.to_array();
        }
        let is_kept = added.range_m.simd_lt(never) & after.simd_gt(half);
        if is_kept.any_true() {
            let range_m = is_kept.select(added.range_m, never);
            let alpha = is_kept.select(added.alpha, zero);
            after *= one - alpha;
            end_m = (after.simd_le(half) & is_kept).select(range_m, end_m);
            self.slots.push(Slot {
                range_m: range_m.to_array(),
                alpha: alpha.to_array(),
                after: after.to_array(),
                luminance: added.luminance.to_array(),
                key: added.key.to_array(),
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

    /// The returns of the beams.
    #[inline(always)]
    pub(super) fn returns<S: Simd>(&self, simd: S) -> Returns {
        let half = f32x16::splat(simd, HALF as f32);
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let mut before = f32x16::splat(simd, 1.0);
        let mut sum = f32x16::splat(simd, 0.0);
        let mut range_m = f32x16::splat(simd, 0.0);
        let mut luminance = f32x16::splat(simd, 0.0);
        let mut key = u32x16::splat(simd, 0);
        for slot in &self.slots {
            sum += before * load(&slot.alpha) * load(&slot.luminance);
            let after = load(&slot.after);
            let returns = before.simd_gt(half) & after.simd_le(half);
            range_m = returns.select(load(&slot.range_m), range_m);
            luminance = returns.select(sum / (f32x16::splat(simd, 1.0) - after), luminance);
            key = returns.select(u32x16::load_array_ref(simd, &slot.key), key);
            before = after;
        }
        Returns {
            range_m: range_m.to_array(),
            luminance: luminance.to_array(),
            key: key.to_array(),
        }
    }
}

impl<S: Simd> Hits<S> {
    /// Whether hits come before others on their beams.
    #[inline(always)]
    fn is_before(&self, other_m: f32x16<S>, other: u32x16<S>) -> mask32x16<S> {
        // Gaussians in one place: the order of keys makes the return the same at any number of
        // threads.
        let is_equal = self.range_m.simd_eq(other_m)
            & self.range_m.simd_lt(f32x16::splat(self.range_m.simd, f32::INFINITY));
        self.range_m.simd_lt(other_m) | (is_equal & self.key.simd_lt(other))
    }

    /// These hits where chosen, and others elsewhere.
    #[inline(always)]
    fn or(self, other: Self, chosen: mask32x16<S>) -> Self {
        Self {
            range_m: chosen.select(self.range_m, other.range_m),
            alpha: chosen.select(self.alpha, other.alpha),
            luminance: chosen.select(self.luminance, other.luminance),
            key: chosen.select(self.key, other.key),
        }
    }
}
