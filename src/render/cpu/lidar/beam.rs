//! The hits of one beam, up to its return.

use crate::lidar::HALF;

/// Where a beam meets a candidate.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    pub(super) range_m: f32,
    pub(super) alpha: f32,
    /// The global id of the Gaussian: its chunk, then its index.
    pub(super) id: u64,
    pub(super) luminance: f32,
    /// As in [`Sweep::instance`](crate::lidar::Sweep::instance).
    pub(super) instance: u16,
}

impl Hit {
    /// Whether it is in front of another; at the same range, the order is that of ids.
    fn is_before(&self, other: &Self) -> bool {
        self.range_m < other.range_m || (self.range_m == other.range_m && self.id < other.id)
    }
}

/// The hits of a beam from the nearest, each with the transmittance after it. A hit behind the
/// return changes nothing and is dropped, so that few are kept.
#[derive(Clone, Debug, Default)]
pub(super) struct Beam {
    hits: Vec<(Hit, f32)>,
    returned: bool,
}

impl Beam {
    pub(super) fn clear(&mut self) {
        self.hits.clear();
        self.returned = false;
    }

    /// Adds a hit. Returns the range of the return, if there is one now.
    #[inline(always)]
    pub(super) fn add(&mut self, hit: Hit) -> Option<f32> {
        // By hand and not `insert`, whose call costs more than the few hits that are moved.
        self.hits.push((hit, 0.0));
        let mut at = self.hits.len() - 1;
        while at > 0 && hit.is_before(&self.hits[at - 1].0) {
            self.hits[at] = self.hits[at - 1];
            at -= 1;
        }
        let mut transmittance = if at > 0 { self.hits[at - 1].1 } else { 1.0 };
        if transmittance <= HALF as f32 {
            // Behind the return.
            self.hits.pop();
        } else {
            self.hits[at].0 = hit;
            for later in at..self.hits.len() {
                transmittance *= 1.0 - self.hits[later].0.alpha;
                self.hits[later].1 = transmittance;
                if transmittance <= HALF as f32 {
                    self.hits.truncate(later + 1);
                    self.returned = true;
                    break;
                }
            }
        }
        self.hits.last().filter(|_| self.returned).map(|(last, _)| last.range_m)
    }

    /// The hit at which the beam returns, and the mean luminance of the hits up to it, weighted by
    /// what each contributes.
    pub(super) fn returned(&self) -> Option<(Hit, f32)> {
        let (last, after) = self.hits.last().filter(|_| self.returned)?;
        let mut before = 1.0;
        let mut sum = 0.0;
        for (hit, after) in &self.hits {
            sum += before * hit.alpha * hit.luminance;
            before = *after;
        }
        Some((*last, sum / (1.0 - after)))
    }
}
