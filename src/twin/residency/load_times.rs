//! Durations of the last loads.

use std::time::Duration;

use crate::limits;

/// A ring buffer with the durations of the last [`limits::LOAD_TIMES`] loads.
#[derive(Clone, Debug, Default)]
pub(super) struct LoadTimes {
    times: Vec<Duration>,
    next: usize,
}

impl LoadTimes {
    pub(super) fn add(&mut self, took: Duration) {
        if self.times.len() < limits::LOAD_TIMES {
            self.times.push(took);
        } else {
            self.times[self.next] = took;
            self.next = (self.next + 1) % limits::LOAD_TIMES;
        }
    }

    /// The duration that a share of the loads, 0 to 1, did not exceed; zero before the first load.
    pub(super) fn quantile(&self, share: f64) -> Duration {
        let mut sorted = self.times.clone();
        sorted.sort_unstable();
        // The nearest rank: a share of 0 is the least duration, a share of 1 the largest.
        let last = sorted.len().saturating_sub(1);
        sorted.get((share * last as f64).round() as usize).copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_of_the_last_loads() {
        let mut times = LoadTimes::default();
        assert_eq!(times.quantile(0.99), Duration::ZERO);
        // Twice the capacity, so that the first half is overwritten.
        for ms in 0..2 * limits::LOAD_TIMES as u64 {
            times.add(Duration::from_millis(ms));
        }
        // The ring holds `first..2 * first` ms then.
        let first = limits::LOAD_TIMES as u64;
        assert_eq!(times.quantile(0.0), Duration::from_millis(first));
        assert_eq!(times.quantile(1.0), Duration::from_millis(2 * first - 1));
    }
}
