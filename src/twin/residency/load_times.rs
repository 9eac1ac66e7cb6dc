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
        for ms in 0..2 * limits::LOAD_TIMES as u64 {
            times.add(Duration::from_millis(ms));
        }
        let first = limits::LOAD_TIMES as u64;
        assert_eq!(times.quantile(0.0), Duration::from_millis(first));
        assert_eq!(times.quantile(1.0), Duration::from_millis(2 * first - 1));
    }
}
