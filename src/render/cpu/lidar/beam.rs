//! The hits of 16 beams of a row, up to their returns.
//!
//! The beams of a row are compared with a Gaussian together, and so they keep its hits together:
//! one insertion into sorted lists for 16 beams. A beam also keeps the light that reaches its
//! return: only a hit that leaves half of that light or less moves the return.

use fearless_simd::{f32x16, mask32x16, prelude::*, u32x16};

use crate::lidar::HALF;
use wildcity_scene::chunk::LANES;

/// Candidates between two looks for the farthest beam of each row that has not returned nearer.
pub(super) const LOOKS: usize = 16;

/// Where 16 beams meet a Gaussian.
pub(super) struct Crossing<S: Simd> {
    /// The beams that meet it.
    pub(super) meets: mask32x16<S>,
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
#[repr(align(64))]
struct Slot {
    range_m: [f32; LANES],
    alpha: [f32; LANES],
    luminance: [f32; LANES],
    key: [u32; LANES],
}

/// The hits of each beam from the nearest; at the same range, in the order of keys. A hit behind
/// the return changes nothing and is dropped, so that few are kept.
#[derive(Clone, Debug, Default)]
#[repr(align(64))]
pub(super) struct BeamRow {
    /// The first `len` have hits; there is room for more.
    slots: Vec<Slot>,
    len: usize,
    /// What is left of the light of each beam in front of its return: more than half.
    light: [f32; LANES],
    /// How far each beam is followed: to its return, or the LiDAR's range, in metres.
    pub(super) ends_m: [f32; LANES],
    /// What each beam meets at its return; [`NO_KEY`] without one.
    end_keys: [u32; LANES],
}

/// Larger than any key.
const NO_KEY: u32 = u32::MAX;

/// The returns of 16 beams.
pub(super) struct Returns {
    /// 0 without a return.
    pub(super) range_m: [f32; LANES],
    /// Mean luminance of the hits up to it, weighted by what each contributes; 0 without a return.
    pub(super) luminance: [f32; LANES],
    /// What it meets there.
    pub(super) key: [u32; LANES],
}

impl Slot {
    const EMPTY: Self = Self {
        range_m: [f32::INFINITY; LANES],
        alpha: [0.0; LANES],
        luminance: [0.0; LANES],
        key: [NO_KEY; LANES],
    };
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

    /// Most hits for which a beam has room and that it has not.
    pub(super) const SPARE_HITS: usize = 2 * LOOKS;

    /// Beams without hits that are followed over `ends_m`.
    pub(super) fn begin(&mut self, ends_m: [f32; LANES]) {
        self.len = 0;
        self.light = [1.0; LANES];
        self.ends_m = ends_m;
        self.end_keys = [NO_KEY; LANES];
    }

    /// Makes room for the hits of [`LOOKS`] Gaussians: [`BeamRow::add`] keeps less in registers if
    /// it calls an allocator.
    pub(super) fn reserve(&mut self) {
        if self.slots.len() < self.len + LOOKS {
            self.slots.resize(self.len + Self::SPARE_HITS, Slot::EMPTY);
        }
    }

    /// Adds the hits of a Gaussian. Returns whether a beam may end nearer than before.
    #[inline(always)]
    pub(super) fn add<S: Simd>(&mut self, simd: S, crossing: &Crossing<S>) -> bool {
        let end_m = f32x16::load_array_ref(simd, &self.ends_m);
        let end_key = u32x16::load_array_ref(simd, &self.end_keys);
        let key = u32x16::splat(simd, crossing.key);
        // At the range of the return, the order of keys decides.
        let is_behind = crossing.range_m.simd_eq(end_m) & key.simd_gt(end_key);
        let meets = crossing.meets & !is_behind;
        let light = f32x16::load_array_ref(simd, &self.light);
        let left = light * (f32x16::splat(simd, 1.0) - crossing.alpha);
        self.light = meets.select(left, light).to_array();
        self.insert(
            meets,
            Hits {
                range_m: meets.select(crossing.range_m, f32x16::splat(simd, f32::INFINITY)),
                alpha: meets.select(crossing.alpha, f32x16::splat(simd, 0.0)),
                luminance: f32x16::splat(simd, crossing.luminance),
                // After all others that are infinitely far away.
                key: meets.select(key, u32x16::splat(simd, NO_KEY)),
            },
        );
        // `left` is a product in the order in which hits were found, and rounded accordingly. `end`
        // multiplies in the order of ranges and decides, also if a little more than half is left.
        let ends = meets & left.simd_le(f32x16::splat(simd, (1.0 + 1e-4) * HALF as f32));
        if ends.any_true() {
            self.end(simd, ends);
            return true;
        }
        false
    }

    #[inline(always)]
    fn insert<S: Simd>(&mut self, meets: mask32x16<S>, mut added: Hits<S>) {
        let never = f32x16::splat(added.range_m.simd, f32::INFINITY);
        // Slots in front of all that is added stay as they are.
        let mut first = self.len;
        let may_go_before = |slot: &Slot| {
            let slot_m = f32x16::load_array_ref(added.range_m.simd, &slot.range_m);
            (meets & added.range_m.simd_le(slot_m)).any_true()
        };
        while first > 0 && may_go_before(&self.slots[first - 1]) {
            first -= 1;
        }
        for slot in &mut self.slots[first..self.len] {
            // What comes first takes the slot; the other goes on to the next.
            let goes_here = added.is_before(slot);
            let old = Hits::load(added.range_m.simd, slot);
            *slot = added.or(old, goes_here).store();
            added = old.or(added, goes_here);
            if added.range_m.simd_ge(never).all_true() {
                return;
            }
        }
        self.slots[self.len] = added.store();
        self.len += 1;
    }

    /// Finds the returns of some beams among all of their hits, and drops what is behind.
    #[inline(always)]
    fn end<S: Simd>(&mut self, simd: S, ends: mask32x16<S>) {
        let half = f32x16::splat(simd, HALF as f32);
        let one = f32x16::splat(simd, 1.0);
        let never = f32x16::splat(simd, f32::INFINITY);
        let mut light = f32x16::load_array_ref(simd, &self.light);
        let mut end_m = f32x16::load_array_ref(simd, &self.ends_m);
        let mut end_key = u32x16::load_array_ref(simd, &self.end_keys);
        let mut before = one;
        for slot in &mut self.slots[..self.len] {
            let hit = Hits::load(simd, slot);
            let is_behind = ends & before.simd_le(half);
            let after = before * (one - hit.alpha);
            let is_end = ends & after.simd_le(half) & !is_behind;
            light = is_end.select(before, light);
            end_m = is_end.select(hit.range_m, end_m);
            end_key = is_end.select(hit.key, end_key);
            // Nothing is behind a return in most slots, which are then not written.
            if is_behind.any_true() {
                slot.range_m = is_behind.select(never, hit.range_m).to_array();
                slot.alpha = is_behind.select(f32x16::splat(simd, 0.0), hit.alpha).to_array();
            }
            before = after;
        }
        self.light = light.to_array();
        self.ends_m = end_m.to_array();
        self.end_keys = end_key.to_array();
        let is_empty =
            |slot: &Slot| f32x16::load_array_ref(simd, &slot.range_m).simd_ge(never).all_true();
        while self.len > 0 && is_empty(&self.slots[self.len - 1]) {
            self.len -= 1;
        }
    }

    /// The returns of the beams.
    #[inline(always)]
    pub(super) fn returns<S: Simd>(&self, simd: S) -> Returns {
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        let one = f32x16::splat(simd, 1.0);
        let mut before = one;
        let mut sum = f32x16::splat(simd, 0.0);
        for slot in &self.slots[..self.len] {
            let alpha = load(&slot.alpha);
            sum += before * alpha * load(&slot.luminance);
            before *= one - alpha;
        }
        let end_keys = u32x16::load_array_ref(simd, &self.end_keys);
        let returns = !end_keys.simd_eq(u32x16::splat(simd, NO_KEY));
        let zero = f32x16::splat(simd, 0.0);
        Returns {
            range_m: returns.select(load(&self.ends_m), zero).to_array(),
            // At a return, half of the light is lost: this divides by 0 only where no value is
            // taken.
            luminance: returns.select(sum / (one - before), zero).to_array(),
            key: returns.select(end_keys, u32x16::splat(simd, 0)).to_array(),
        }
    }
}

impl<S: Simd> Hits<S> {
    #[inline(always)]
    fn load(simd: S, slot: &Slot) -> Self {
        let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
        Self {
            range_m: load(&slot.range_m),
            alpha: load(&slot.alpha),
            luminance: load(&slot.luminance),
            key: u32x16::load_array_ref(simd, &slot.key),
        }
    }

    #[inline(always)]
    fn store(self) -> Slot {
        Slot {
            range_m: self.range_m.to_array(),
            alpha: self.alpha.to_array(),
            luminance: self.luminance.to_array(),
            key: self.key.to_array(),
        }
    }

    /// Whether hits come before those of a slot on their beams.
    #[inline(always)]
    fn is_before(&self, slot: &Slot) -> mask32x16<S> {
        let simd = self.range_m.simd;
        let slot_m = f32x16::load_array_ref(simd, &slot.range_m);
        // Gaussians in one place: the order of keys makes the return the same at any number of
        // threads.
        let is_first = self.key.simd_lt(u32x16::load_array_ref(simd, &slot.key));
        self.range_m.simd_lt(slot_m) | (self.range_m.simd_eq(slot_m) & is_first)
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
