//! A frame that a device cannot hold at once is drawn region by region.
//!
//! The rows of tiles of all views, one view after another, form one sequence. A region is a range
//! of it: some whole views, or a band of rows of one view. Each region is drawn by the same stages,
//! to the same bytes: no pixel depends on the region in which it is drawn, since its splats are
//! those of the whole image in the same order.
//!
//! Nothing is read back in the middle of a frame. The device counts what a region needs, and draws
//! nothing if that does not fit; then the region is drawn again, in larger buffers or split into
//! more regions. The next frame of the same kind starts with the regions that fitted. If a single
//! row of tiles exceeds the device, drawing is an error.
//!
//! The alternative would be splats and lists in several pages. Then a splat's index would be a page
//! and an index in every stage, and a radix sort would scatter into all pages at once. Regions cost
//! nothing when the frame fits. Gaussians and pixels are in pages nevertheless, because stages only
//! stream through them.

use std::ops::Range;

use crate::constants::TILE_PX;
use crate::{Frame, View, limits};

/// A range of rows of tiles, counted through all views of a frame.
pub(super) type Region = Range<u32>;

/// Counts of what a region needs on a device, or of what the device's buffers can hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Capacity {
    /// (Gaussian, view) pairs that reach into the region.
    pub(super) splats: u64,
    /// (Splat, macro tile) pairs.
    pub(super) touches: u64,
    /// (Splat, tile) pairs in the region.
    pub(super) instances: u64,
}

impl Capacity {
    /// The smallest number of regions into which a region with these needs must be split to fit a
    /// limit.
    pub(super) fn min_regions(self, limit: Self) -> u64 {
        let Self { splats, touches, instances } = self.combine(limit, u64::div_ceil);
        splats.max(touches).max(instances)
    }

    /// The larger of both, count by count.
    pub(super) fn max(self, other: Self) -> Self {
        self.combine(other, u64::max)
    }

    fn plus(self, other: Self) -> Self {
        self.combine(other, |a, b| a + b)
    }

    fn times(self, numerator: u64, denominator: u64) -> Self {
        self.combine(self, |n, _| n * numerator / denominator)
    }

    fn combine(self, other: Self, combine: impl Fn(u64, u64) -> u64) -> Self {
        Self {
            splats: combine(self.splats, other.splats),
            touches: combine(self.touches, other.touches),
            instances: combine(self.instances, other.instances),
        }
    }
}

/// The rows of tiles of all views of a frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TileRows {
    /// For each view, the row after its last one.
    ends: Vec<u32>,
}

impl TileRows {
    /// The rows of a frame.
    pub(super) fn from_frame(frame: &Frame<'_>) -> Self {
        let mut end = 0;
        let view_end = |view: &View| {
            end += view.camera.height_px.div_ceil(TILE_PX);
            end
        };
        Self { ends: frame.views.iter().map(view_end).collect() }
    }

    /// The whole frame as one region.
    pub(super) fn all(&self) -> Region {
        0..self.ends.last().copied().unwrap_or(0)
    }

    /// The views of which a region has rows.
    pub(super) fn views(&self, region: &Region) -> Range<usize> {
        let view_of = |row: u32| self.ends.partition_point(|&end| end <= row);
        // A region has at least one row, so `end - 1` is a row of it.
        view_of(region.start)..view_of(region.end - 1) + 1
    }

    /// A region's rows of one view, counted from the view's first row; empty if it has none.
    pub(super) fn for_view(&self, view: usize, region: &Region) -> Range<u32> {
        let start = if view == 0 { 0 } else { self.ends[view - 1] };
        let within = |row: u32| row.clamp(start, self.ends[view]) - start;
        within(region.start)..within(region.end)
    }

    /// Splits a region into about `count` regions: between views, or into bands if it lies in one
    /// view. `None` for a single row, which cannot be split.
    pub(super) fn split(&self, region: &Region, count: u64) -> Option<Vec<Region>> {
        let views = self.views(region);
        let bounds: Vec<u32> = if views.len() > 1 {
            let ends = views.map(|view| self.ends[view].min(region.end));
            std::iter::once(region.start).chain(ends).collect()
        } else {
            (region.start..=region.end).collect()
        };
        let units = bounds.len() as u64 - 1;
        if units < 2 {
            return None;
        }
        // At least two parts: a region that is not split would overflow the device again.
        let count = count.clamp(2, units);
        let bound = |index: u64| bounds[(index * units / count) as usize];
        Some((0..count).map(|index| bound(index)..bound(index + 1)).collect())
    }
}

/// The regions in which recent frames fitted, so that the next frame of the same kind starts with
/// them.
#[derive(Debug, Default)]
pub(super) struct PartitionCache {
    /// The most recently drawn one first. Frames that fit at once are not listed.
    entries: Vec<(PartitionKey, Vec<Region>)>,
}

/// The properties that two frames must share to be drawn in the same regions: the number of
/// Gaussians and the sizes of the images.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PartitionKey {
    gaussians: usize,
    sizes_px: Vec<[u32; 2]>,
}

impl PartitionKey {
    pub(super) fn from_frame(frame: &Frame<'_>) -> Self {
        let size = |view: &View| [view.camera.width_px, view.camera.height_px];
        Self {
            gaussians: frame.scene.gaussians(),
            sizes_px: frame.views.iter().map(size).collect(),
        }
    }
}

impl PartitionCache {
    /// The regions in which to draw such a frame, in order.
    pub(super) fn get(&self, key: &PartitionKey, rows: &TileRows) -> Vec<Region> {
        let known = self.entries.iter().find(|(known, _)| known == key);
        known.map_or_else(|| vec![rows.all()], |(_, regions)| regions.clone())
    }

    /// Stores the regions of a frame with what each needed. Neighbours that fit together are
    /// merged. They must fit with an eighth to spare, so that a moving camera does not undo the
    /// merge in the next frame.
    pub(super) fn insert(
        &mut self,
        key: PartitionKey,
        drawn: Vec<(Region, Capacity)>,
        limit: Capacity,
    ) {
        let limit = limit.times(7, 8);
        let mut merged: Vec<(Region, Capacity)> = Vec::with_capacity(drawn.len());
        for (region, needs) in drawn {
            match merged.last_mut() {
                // The sum is an upper bound: a splat on the border of two bands counts in both.
                Some((before, sum)) if sum.plus(needs).min_regions(limit) <= 1 => {
                    before.end = region.end;
                    *sum = sum.plus(needs);
                }
                _ => merged.push((region, needs)),
            }
        }
        self.entries.retain(|(known, _)| *known != key);
        // One region is what `get` returns for an unknown frame.
        if merged.len() > 1 {
            let regions = merged.into_iter().map(|(region, _)| region).collect();
            self.entries.insert(0, (key, regions));
            // The latest entry comes first, so the oldest ones are cut off.
            self.entries.truncate(limits::PARTITION_CACHE_ENTRIES);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows() -> TileRows {
        TileRows { ends: vec![4, 6, 12] }
    }

    #[test]
    fn regions_are_split_between_views_then_between_rows() {
        let rows = rows();
        assert_eq!(rows.split(&rows.all(), 2), Some(vec![0..4, 4..12]));
        assert_eq!(rows.split(&rows.all(), 100), Some(vec![0..4, 4..6, 6..12]));
        assert_eq!(rows.split(&(6..12), 4), Some(vec![6..7, 7..9, 9..10, 10..12]));
        assert_eq!(rows.split(&(2..5), 9), Some(vec![2..4, 4..5]));
        assert_eq!(rows.split(&(7..8), 2), None);
    }

    #[test]
    fn a_region_has_views_and_rows_of_each() {
        let rows = rows();
        assert_eq!(rows.views(&(0..12)), 0..3);
        assert_eq!(rows.views(&(5..6)), 1..2);
        let of = |region: Region| [0, 1, 2].map(|view| rows.for_view(view, &region));
        assert_eq!(of(0..12), [0..4, 0..2, 0..6]);
        assert_eq!(of(3..8), [3..4, 0..2, 0..2]);
    }

    #[test]
    fn regions_that_fit_together_are_merged_in_the_next_frame() {
        let mut cache = PartitionCache::default();
        let rows = rows();
        let key = PartitionKey { gaussians: 1, sizes_px: vec![[16, 64]] };
        let limit = Capacity { splats: 800, touches: 4000, instances: 8000 };
        let needs = |splats, instances| Capacity { splats, touches: instances / 2, instances };
        assert_eq!(cache.get(&key, &rows), [rows.all()]);
        let drawn = vec![(0..4, needs(500, 1)), (4..6, needs(200, 1)), (6..12, needs(1, 6999))];
        cache.insert(key.clone(), drawn, limit);
        assert_eq!(cache.get(&key, &rows), [0..6, 6..12]);
        let other = PartitionKey { gaussians: 2, ..key.clone() };
        assert_eq!(cache.get(&other, &rows), [rows.all()]);
        cache.insert(key.clone(), vec![(0..6, needs(1, 1)), (6..12, needs(1, 1))], limit);
        assert_eq!(cache.get(&key, &rows), [rows.all()]);
        assert!(cache.entries.is_empty());
    }
}
