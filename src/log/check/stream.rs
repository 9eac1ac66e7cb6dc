//! The rows of one sensor in time: their period, and where rows are missing.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::error::LogError;
use crate::row::Row;
use crate::table::Rows;

/// Periods are counted in bins that are one per cent wide.
const BINS_PER_E: f64 = 100.0;

/// Longest gaps that are kept.
const KEPT_GAPS: usize = 32;

/// A gap is this many times as long as the median period.
const GAP_TIMES: f64 = 1.5;

/// Columns of the timing plot.
const COLUMNS: usize = 480;

/// The rows of one sensor in time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stream {
    /// The sensor, such as `camera front`.
    pub sensor: String,
    pub rows: usize,
    /// Times of the first and the last row, in microseconds; `None` without rows.
    pub span_us: Option<[i64; 2]>,
    /// Median time between two rows, in microseconds, to one per cent.
    pub period_us: Option<f64>,
    /// Number of times between two rows that are longer than 1.5 periods.
    pub gaps: usize,
    /// Rows that are missing in these gaps.
    pub missing: usize,
    /// The longest gaps, the longest first.
    pub longest: Vec<Gap>,
    /// Rows in each of equal parts of the span, for the timing plot.
    #[serde(skip)]
    pub columns: Vec<u32>,
}

/// A time without a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Gap {
    /// When it begins: the time of the last row before it, in microseconds.
    pub from_us: i64,
    /// How long it is, in microseconds.
    pub length_us: u64,
}

/// Counts the rows of one sensor in bounded memory.
#[derive(Clone, Debug, Default)]
pub(super) struct StreamCounter {
    rows: usize,
    first_us: Option<i64>,
    last_us: Option<i64>,
    /// Number of periods in each bin of their logarithm.
    bins: BTreeMap<i32, usize>,
    longest: Vec<Gap>,
    columns: Columns,
}

/// Counts of rows in equal parts of time, whose width doubles when they do not reach far enough.
#[derive(Clone, Debug, Default)]
struct Columns {
    width_us: u64,
    counts: Vec<u32>,
}

impl Columns {
    fn add(&mut self, since_us: u64) {
        self.width_us = self.width_us.max(1);
        while since_us / self.width_us >= COLUMNS as u64 {
            // Twice the width: two old columns are one new column, and an odd last one stays alone.
            let halved = self.counts.chunks(2).map(|pair| pair.iter().sum()).collect();
            self.counts = halved;
            self.width_us *= 2;
        }
        let column = (since_us / self.width_us) as usize;
        self.counts.resize(self.counts.len().max(column + 1), 0);
        self.counts[column] += 1;
    }
}

impl StreamCounter {
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    pub(super) fn add(&mut self, time_us: i64) {
        self.rows += 1;
        let first_us = *self.first_us.get_or_insert(time_us);
        self.columns.add(time_us.abs_diff(first_us));
        if let Some(from_us) = self.last_us.replace(time_us) {
            // Unsigned: the times of a file are any 64-bit numbers.
            let length_us = time_us.abs_diff(from_us);
            *self.bins.entry(bin(length_us as f64)).or_default() += 1;
            self.keep(Gap { from_us, length_us });
        }
    }

    /// Keeps a period if it is among the longest.
    fn keep(&mut self, gap: Gap) {
        let place = self.longest.partition_point(|other| other.length_us >= gap.length_us);
        if place < KEPT_GAPS {
            self.longest.insert(place, gap);
            self.longest.truncate(KEPT_GAPS);
        }
    }

    pub(super) fn finish(self, sensor: String) -> Stream {
        let period_us = self.median_us();
        // Without a period nothing exceeds the limit, and `lost` below is never called.
        let limit_us = period_us.map_or(f64::INFINITY, |period_us| GAP_TIMES * period_us);
        let gap_bins = self.bins.iter().filter(|(at, _)| middle_us(**at) > limit_us);
        let lost = |(at, count): (&i32, &usize)| {
            let periods = middle_us(*at) / period_us.unwrap_or(1.0);
            // A gap of two periods lacks one row. From 1.5 periods on, it is rounded to two at
            // least.
            count * (periods.round() as usize).saturating_sub(1)
        };
        let is_gap = |gap: &Gap| gap.length_us as f64 > limit_us;
        Stream {
            sensor,
            rows: self.rows,
            span_us: self.first_us.zip(self.last_us).map(|(first, last)| [first, last]),
            period_us,
            gaps: gap_bins.clone().map(|(_, count)| count).sum(),
            missing: gap_bins.map(lost).sum(),
            longest: self.longest.into_iter().filter(is_gap).collect(),
            columns: self.columns.counts,
        }
    }

    /// The median period; `None` with fewer than two rows.
    fn median_us(&self) -> Option<f64> {
        // There is one period less than rows.
        let half = self.rows.checked_sub(1)? / 2;
        let mut before = 0;
        let median = self.bins.iter().find(|(_, count)| {
            before += **count;
            before > half
        });
        median.map(|(at, _)| middle_us(*at))
    }
}

/// The bin of a period, in microseconds.
fn bin(period_us: f64) -> i32 {
    // Equal widths on a logarithmic scale are equal shares: one bin is one per cent, whatever the
    // rate of the sensor. Two rows at one time have no logarithm, and count as 1 µs.
    (BINS_PER_E * period_us.max(1.0).ln()).round() as i32
}

fn middle_us(bin: i32) -> f64 {
    (f64::from(bin) / BINS_PER_E).exp()
}

/// Measures the rows of a table as one stream.
pub(super) fn measure<R: Row>(sensor: &str, rows: Rows<R>) -> Result<Stream, LogError> {
    let mut counter = StreamCounter::default();
    super::for_each(rows, |row| {
        counter.add(row.time_us());
        Ok(())
    })?;
    Ok(counter.finish(sensor.to_owned()))
}

/// Measures the rows of each camera, LiDAR or track of a table, and calls `look` for each row.
pub(super) fn measure_keys<R: Row>(
    rows: Rows<R>,
    mut look: impl FnMut(&R) -> Result<(), LogError>,
) -> Result<BTreeMap<String, StreamCounter>, LogError> {
    let mut counters: BTreeMap<String, StreamCounter> = BTreeMap::new();
    super::for_each(rows, |row| {
        look(&row)?;
        let key = row.key().unwrap_or_default();
        // Looked up twice only for the first row of a key, so that others allocate nothing.
        match counters.get_mut(key) {
            Some(counter) => counter.add(row.time_us()),
            None => counters.entry(key.to_owned()).or_default().add(row.time_us()),
        }
        Ok(())
    })?;
    Ok(counters)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_against_the_median() {
        let mut counter = StreamCounter::default();
        // 10 Hz with a jitter of 1 ms; rows 50 and 70 to 72 are missing.
        for row in (0..1000).filter(|row| *row != 50 && !(70..73).contains(row)) {
            counter.add(100_000 * row + 1000 * (row % 2) - 5_000_000);
        }
        let stream = counter.finish("camera front".to_owned());
        let period_us = stream.period_us.unwrap();
        assert!((period_us / 1e5 - 1.0).abs() < 0.02, "{period_us}");
        assert_eq!((stream.rows, stream.gaps, stream.missing), (996, 2, 4));
        let starts: Vec<i64> = stream.longest.iter().map(|gap| gap.from_us + 5_000_000).collect();
        assert_eq!(starts, [6_901_000, 4_901_000]);
        assert_eq!(stream.columns.iter().sum::<u32>(), 996);
        assert!(stream.columns.len() <= COLUMNS);
        let one = {
            let mut counter = StreamCounter::default();
            counter.add(7);
            counter.finish("gps".to_owned())
        };
        assert_eq!((one.rows, one.period_us, one.gaps), (1, None, 0));
    }
}
