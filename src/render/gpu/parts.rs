//! A frame that a device cannot hold at once is drawn part by part.
//!
//! The rows of tiles of all views, one view after the other, are one line, and a part is a piece of
//! it: some views, or a band of one. Nothing about a pixel depends on the part that it is drawn in:
//! its splats stay those of the whole image, in the same order.

use std::ops::Range;

use crate::Frame;
use crate::constants::TILE_PX;
use crate::limits;

/// Rows of tiles, counted through all views of a frame.
pub(super) type Part = Range<u32>;

/// What a part takes of a device, or what a device has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Needs {
    pub(super) splats: u64,
    pub(super) touches: u64,
    pub(super) instances: u64,
    /// Touches of the macro tile that has most.
    pub(super) crowd: u64,
}

impl Needs {
    /// In how many parts, at least, what takes this much must be drawn.
    pub(super) fn pieces(self, limit: Self) -> u64 {
        let Self { splats, touches, instances, crowd } = self.with(limit, u64::div_ceil);
        splats.max(touches).max(instances).max(crowd)
    }

    /// Enough for either.
    pub(super) fn max(self, other: Self) -> Self {
        self.with(other, u64::max)
    }

    fn plus(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }

    fn times(self, numerator: u64, denominator: u64) -> Self {
        self.with(self, |n, _| n * numerator / denominator)
    }

    fn with(self, other: Self, combine: impl Fn(u64, u64) -> u64) -> Self {
        Self {
            splats: combine(self.splats, other.splats),
            touches: combine(self.touches, other.touches),
            instances: combine(self.instances, other.instances),
            crowd: combine(self.crowd, other.crowd),
        }
    }
}

/// Where each view ends on the line of rows.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rows {
    ends: Vec<u32>,
}

impl Rows {
    /// The rows of a frame.
    pub(super) fn of(frame: &Frame<'_>) -> Self {
        let mut end = 0;
        let view_end = |view: &crate::View| {
            end += view.camera.height_px.div_ceil(TILE_PX);
            end
        };
        Self { ends: frame.views.iter().map(view_end).collect() }
    }

    /// The whole frame.
    pub(super) fn all(&self) -> Part {
        0..self.ends.last().copied().unwrap_or(0)
    }

    /// The views that a part has rows of.
    pub(super) fn views(&self, part: &Part) -> Range<usize> {
        let holder = |row: u32| self.ends.partition_point(|&end| end <= row);
        holder(part.start)..holder(part.end - 1) + 1
    }

    /// A part's rows of a view, from the view's own first; none if it has none.
    pub(super) fn of_view(&self, view: usize, part: &Part) -> Range<u32> {
        let start = if view == 0 { 0 } else { self.ends[view - 1] };
        let within = |row: u32| row.clamp(start, self.ends[view]) - start;
        within(part.start)..within(part.end)
    }

    /// Cuts a part into about so many pieces: between views, or into bands if it is of one view.
    /// `None` for a single row.
    pub(super) fn cut(&self, part: &Part, pieces: u64) -> Option<Vec<Part>> {
        let views = self.views(part);
        let bounds: Vec<u32> = if views.len() > 1 {
            let ends = views.map(|view| self.ends[view].min(part.end));
            std::iter::once(part.start).chain(ends).collect()
        } else {
            (part.start..=part.end).collect()
        };
        let units = bounds.len() as u64 - 1;
        if units < 2 {
            return None;
        }
        let pieces = pieces.clamp(2, units);
        let cut = |piece: u64| bounds[(piece * units / pieces) as usize];
        Some((0..pieces).map(|piece| cut(piece)..cut(piece + 1)).collect())
    }
}

/// How frames were cut that did not fit, so that the next one is cut before it is tried.
#[derive(Debug, Default)]
pub(super) struct Cuts {
    /// From the one that was drawn last.
    known: Vec<(Subject, Vec<Part>)>,
}

/// What makes frames alike: what they draw, and the images that they draw it on.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Subject {
    gaussians: usize,
    sizes_px: Vec<[u32; 2]>,
}

impl Subject {
    pub(super) fn of(frame: &Frame<'_>) -> Self {
        let size = |view: &crate::View| [view.camera.width_px, view.camera.height_px];
        Self {
            gaussians: frame.scene.gaussians(),
            sizes_px: frame.views.iter().map(size).collect(),
        }
    }
}

impl Cuts {
    /// The parts to draw such a frame in, in order.
    pub(super) fn recall(&self, subject: &Subject, rows: &Rows) -> Vec<Part> {
        let known = self.known.iter().find(|(known, _)| known == subject);
        known.map_or_else(|| vec![rows.all()], |(_, parts)| parts.clone())
    }

    /// Keeps what was learnt from a frame: neighbours that have room in one part are one the next
    /// time, with an eighth to spare so that a moving camera does not undo it in every frame.
    pub(super) fn remember(&mut self, subject: Subject, drawn: Vec<(Part, Needs)>, limit: Needs) {
        let limit = limit.times(7, 8);
        let mut merged: Vec<(Part, Needs)> = Vec::with_capacity(drawn.len());
        for (part, needs) in drawn {
            match merged.last_mut() {
                Some((before, sum)) if sum.plus(needs).pieces(limit) <= 1 => {
                    before.end = part.end;
                    *sum = sum.plus(needs);
                }
                _ => merged.push((part, needs)),
            }
        }
        self.known.retain(|(known, _)| *known != subject);
        if merged.len() > 1 {
            let parts = merged.into_iter().map(|(part, _)| part).collect();
            self.known.insert(0, (subject, parts));
            self.known.truncate(limits::REMEMBERED_CUTS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows() -> Rows {
        Rows { ends: vec![4, 6, 12] }
    }

    #[test]
    fn cuts_are_between_views_then_between_rows() {
        let rows = rows();
        assert_eq!(rows.cut(&rows.all(), 2), Some(vec![0..4, 4..12]));
        assert_eq!(rows.cut(&rows.all(), 100), Some(vec![0..4, 4..6, 6..12]));
        assert_eq!(rows.cut(&(6..12), 4), Some(vec![6..7, 7..9, 9..10, 10..12]));
        assert_eq!(rows.cut(&(2..5), 9), Some(vec![2..4, 4..5]));
        assert_eq!(rows.cut(&(7..8), 2), None);
    }

    #[test]
    fn a_part_knows_its_views_and_their_rows() {
        let rows = rows();
        assert_eq!(rows.views(&(0..12)), 0..3);
        assert_eq!(rows.views(&(5..6)), 1..2);
        let of = |part: Part| [0, 1, 2].map(|view| rows.of_view(view, &part));
        assert_eq!(of(0..12), [0..4, 0..2, 0..6]);
        assert_eq!(of(3..8), [3..4, 0..2, 0..2]);
    }

    #[test]
    fn parts_that_fit_together_are_drawn_together_again() {
        let (mut cuts, rows) = (Cuts::default(), rows());
        let subject = Subject { gaussians: 1, sizes_px: vec![[16, 64]] };
        let limit = Needs { splats: 800, touches: 4000, instances: 8000, crowd: 100 };
        let needs =
            |splats, instances| Needs { splats, touches: instances / 2, instances, crowd: 1 };
        assert_eq!(cuts.recall(&subject, &rows), [rows.all()]);
        let drawn = vec![(0..4, needs(500, 1)), (4..6, needs(200, 1)), (6..12, needs(1, 6999))];
        cuts.remember(subject.clone(), drawn, limit);
        assert_eq!(cuts.recall(&subject, &rows), [0..6, 6..12]);
        let other = Subject { gaussians: 2, ..subject.clone() };
        assert_eq!(cuts.recall(&other, &rows), [rows.all()]);
        cuts.remember(subject.clone(), vec![(0..6, needs(1, 1)), (6..12, needs(1, 1))], limit);
        assert_eq!(cuts.recall(&subject, &rows), [rows.all()]);
        assert!(cuts.known.is_empty());
    }
}
