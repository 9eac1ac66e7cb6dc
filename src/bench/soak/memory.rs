//! The memory of the process during a soak.
//!
//! A push takes memory for seconds. The maximum of a longer time therefore is higher, although
//! nothing grows; the median of a window is not.

/// Windows of equal length. The first is not compared: in it caches and pools fill, which takes
/// about two minutes.
const WINDOWS: usize = 6;

/// Memory of one kind, in bytes, sample by sample.
#[derive(Default)]
pub(super) struct Memory {
    windows: [Vec<u64>; WINDOWS],
}

/// Memory at the beginning of a soak, later, and at most.
#[derive(Debug, PartialEq)]
pub(super) struct Growth {
    /// Median of the window after the first, in bytes.
    pub(super) early: u64,
    /// The largest median of a later window, in bytes.
    pub(super) later: u64,
    /// The largest sample, in bytes.
    pub(super) most: u64,
}

impl Memory {
    /// Adds a sample, taken after this share of the soak.
    pub(super) fn add(&mut self, share: f64, bytes: u64) {
        let window = ((share * WINDOWS as f64) as usize).min(WINDOWS - 1);
        self.windows[window].push(bytes);
    }

    /// How memory changed; `None` if fewer than two windows after the first have samples.
    pub(super) fn growth(&self) -> Option<Growth> {
        let mut medians = self.windows[1..].iter().filter_map(|window| median(window));
        Some(Growth {
            early: medians.next()?,
            later: medians.max()?,
            most: self.windows.iter().flatten().copied().max()?,
        })
    }
}

impl Growth {
    /// By how much the larger later median exceeds the early one, in per cent.
    pub(super) fn percent(&self) -> f64 {
        100.0 * (self.later as f64 / self.early as f64 - 1.0)
    }
}

/// The middle sample; of an even number, the upper one of the two.
fn median(samples: &[u64]) -> Option<u64> {
    let mut sorted = samples.to_vec();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The memory of 60 samples.
    fn memory(bytes: impl Fn(usize) -> u64) -> Growth {
        let mut memory = Memory::default();
        for sample in 0..60 {
            memory.add(sample as f64 / 60.0, bytes(sample));
        }
        memory.growth().unwrap()
    }

    #[test]
    fn moments_do_not_count_and_growth_does() {
        let pushes = memory(|sample| if sample % 7 == 6 { 1500 } else { 1000 });
        assert_eq!(pushes, Growth { early: 1000, later: 1000, most: 1500 });
        assert_eq!(pushes.percent(), 0.0);
        let leak = memory(|sample| 1000 + sample as u64);
        assert_eq!(leak, Growth { early: 1015, later: 1055, most: 1059 });
        assert!((leak.percent() - 3.941).abs() < 1e-3, "{}", leak.percent());
        // What fills at the beginning does not count.
        assert_eq!(memory(|sample| if sample < 9 { 100 } else { 1000 }).percent(), 0.0);
        // Memory that grew in the middle counts, although it is free in the end.
        assert_eq!(
            memory(|sample| if (30..40).contains(&sample) { 1100 } else { 1000 }).later,
            1100
        );
    }

    #[test]
    fn a_window_without_samples_does_not_count() {
        let mut memory = Memory::default();
        assert_eq!(memory.growth(), None);
        memory.add(0.0, 10);
        memory.add(0.5, 11);
        assert_eq!(memory.growth(), None);
        memory.add(1.5, 12);
        assert_eq!(memory.growth(), Some(Growth { early: 11, later: 12, most: 12 }));
    }
}
