//! The hits of one beam, up to its return.

use crate::lidar::HALF;

/// A Gaussian that a beam of a sector has met.
#[derive(Clone, Copy, Debug)]
pub(super) struct Met {
    /// The global id: the chunk, then the index.
    pub(super) id: u64,
    pub(super) luminance: f32,
    /// Its owner, as in [`Sweep::instance`](crate::lidar::Sweep::instance).
    pub(super) instance: u16,
}

/// Where a beam meets a Gaussian: 16 bytes, because the beams of a tile should fit the cache.
#[derive(Clone, Copy, Debug)]
struct Hit {
    range_m: f32,
    alpha: f32,
    /// The transmittance behind it.
    after: f32,
    /// Among the Gaussians that the sector has met.
    met: u32,
}

/// The hits of a beam from the nearest; at the same range, in the order of ids. A hit behind the
/// return changes nothing and is dropped, so that few are kept.
#[derive(Clone, Debug, Default)]
pub(super) struct Beam {
    hits: Vec<Hit>,
    returned: bool,
}

impl Beam {
    /// Bytes of a hit of a beam.
    pub(super) const HIT_BYTES: usize = size_of::<Hit>();

    pub(super) fn clear(&mut self) {
        self.hits.clear();
        self.returned = false;
    }

    /// Calls `visit` with the place of each hit's Gaussian.
    pub(super) fn visit_hits(&mut self, visit: &mut impl FnMut(&mut u32)) {
        self.hits.iter_mut().for_each(|hit| visit(&mut hit.met));
    }

    /// Adds a hit of the Gaussian that was met last. Returns the range of the return, if there is
    /// one now.
    #[inline(always)]
    pub(super) fn add(&mut self, range_m: f32, alpha: f32, all: &[Met]) -> Option<f32> {
        let met = all.len() - 1;
        let is_before = |other: &Hit| {
            range_m < other.range_m
                || (range_m == other.range_m && all[met].id < all[other.met as usize].id)
        };
        // By hand and not `insert`, whose call costs more than the few hits that are moved.
        let hit = Hit { range_m, alpha, after: 0.0, met: met as u32 };
        self.hits.push(hit);
        let mut at = self.hits.len() - 1;
        while at > 0 && is_before(&self.hits[at - 1]) {
            self.hits[at] = self.hits[at - 1];
            at -= 1;
        }
        let mut transmittance = if at > 0 { self.hits[at - 1].after } else { 1.0 };
        if transmittance <= HALF as f32 {
            // The beam has returned in front of it: nothing behind that changes the return.
            self.hits.pop();
        } else {
            self.hits[at] = hit;
            for later in at..self.hits.len() {
                let alpha = if later == at { alpha } else { self.hits[later].alpha };
                transmittance *= 1.0 - alpha;
                self.hits[later].after = transmittance;
                if transmittance <= HALF as f32 {
                    self.hits.truncate(later + 1);
                    self.returned = true;
                    break;
                }
            }
        }
        self.hits.last().filter(|_| self.returned).map(|last| last.range_m)
    }

    /// The range of the return and what is hit there; and the mean luminance of the hits up to it,
    /// weighted by what each contributes.
    pub(super) fn returned(&self, all: &[Met]) -> Option<(f32, Met, f32)> {
        let last = self.hits.last().filter(|_| self.returned)?;
        let mut before = 1.0;
        let mut sum = 0.0;
        for hit in &self.hits {
            sum += before * hit.alpha * all[hit.met as usize].luminance;
            before = hit.after;
        }
        Some((last.range_m, all[last.met as usize], sum / (1.0 - last.after)))
    }
}
