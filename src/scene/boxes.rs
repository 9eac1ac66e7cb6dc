//! A tree of boxes over a list of things, in their order: finds those near a place without a test
//! of each.
//!
//! The things stay in their order, and a search visits them in it. So "the first of the nearest" is
//! the same thing that a test of each would find.

use std::ops::Range;

use glam::DVec3;

/// Things, or boxes of a lower level, that a box holds.
const WIDTH: usize = 8;

/// Added to the bound before a box is left out, in metres: above the rounding of a distance between
/// places in a city, which is about 1e-9 m.
const SLACK_M: f64 = 1e-6;

/// The bounds of some things, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    pub low_m: DVec3,
    pub high_m: DVec3,
}

/// The boxes of a list of things.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BoxTree {
    /// From the boxes of single things up to a level of at most [`WIDTH`].
    levels: Vec<Vec<Extent>>,
}

impl Extent {
    /// The extent of a line between two points.
    pub fn from_line(from_m: DVec3, to_m: DVec3) -> Self {
        Self { low_m: from_m.min(to_m), high_m: from_m.max(to_m) }
    }

    /// The extent of both.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self { low_m: self.low_m.min(other.low_m), high_m: self.high_m.max(other.high_m) }
    }

    /// The way from a point to it along each axis, in metres.
    pub fn away_m(&self, point_m: DVec3) -> DVec3 {
        (self.low_m - point_m).max(point_m - self.high_m).max(DVec3::ZERO)
    }
}

impl BoxTree {
    /// The tree of things with these extents.
    pub fn new(extents: impl IntoIterator<Item = Extent>) -> Self {
        let mut levels: Vec<Vec<Extent>> = vec![extents.into_iter().collect()];
        while let Some(lower) = levels.last().filter(|lower| lower.len() > WIDTH) {
            let upper = lower.chunks(WIDTH).filter_map(|part| {
                let (first, rest) = part.split_first()?;
                Some(rest.iter().fold(*first, |extent, other| extent.with(*other)))
            });
            levels.push(upper.collect());
        }
        Self { levels }
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> usize {
        self.levels.iter().map(|level| level.len() * size_of::<Extent>()).sum()
    }

    /// The extent of some things; `None` of none.
    pub fn extent(&self, things: Range<usize>) -> Option<Extent> {
        let mut found: Option<Extent> = None;
        let mut add = |extent: Extent| found = Some(found.map_or(extent, |all| all.with(extent)));
        let mut at = things.start;
        // A range may reach beyond the list.
        let end = things.end.min(self.levels.first().map_or(0, Vec::len));
        while at < end {
            // The largest box that begins here and does not reach beyond the end.
            let mut level = 0;
            let mut width = 1;
            while level + 1 < self.levels.len()
                && at.is_multiple_of(width * WIDTH)
                && at + width * WIDTH <= end
            {
                width *= WIDTH;
                level += 1;
            }
            add(self.levels[level][at / width]);
            at += width;
        }
        found
    }

    /// Calls `visit` in order with each of some things whose extent is no farther than a bound, by
    /// `distance_m`. `visit` returns the bound from then on, in metres: it may only fall.
    pub fn visit(
        &self,
        things: Range<usize>,
        bound_m: f64,
        distance_m: &dyn Fn(&Extent) -> f64,
        visit: &mut dyn FnMut(usize) -> f64,
    ) {
        let count = self.levels.first().map_or(0, Vec::len);
        let things = things.start..things.end.min(count);
        if things.is_empty() {
            return;
        }
        let mut bound_m = self.bound_m(&things, bound_m, distance_m);
        let top = self.levels.len() - 1;
        let mut search = Search { things, bound_m: &mut bound_m, distance_m, visit };
        for index in 0..self.levels[top].len() {
            self.descend(top, index, &mut search);
        }
    }

    /// A bound that is no lower than the distance of the nearest thing, from a way down the tree
    /// to a near one: the farthest corner of its own box.
    fn bound_m(
        &self,
        things: &Range<usize>,
        bound_m: f64,
        distance_m: &dyn Fn(&Extent) -> f64,
    ) -> f64 {
        let mut children = 0..self.levels[self.levels.len() - 1].len();
        for level in (0..self.levels.len()).rev() {
            let width = WIDTH.pow(level as u32);
            let inside = children
                .filter(|index| index * width < things.end && (index + 1) * width > things.start);
            let near = inside
                .map(|index| (distance_m(&self.levels[level][index]), index))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, index)) = near else { return bound_m };
            if level == 0 {
                let Extent { low_m, high_m } = self.levels[0][index];
                // The nearest corner is no nearer than the box, and no farther than the box and
                // its diagonal.
                let most_m = distance_m(&self.levels[0][index]) + low_m.distance(high_m);
                return bound_m.min(most_m);
            }
            children = index * WIDTH..((index + 1) * WIDTH).min(self.levels[level - 1].len());
        }
        bound_m
    }

    fn descend(&self, level: usize, index: usize, search: &mut Search<'_>) {
        let width = WIDTH.pow(level as u32);
        let is_outside =
            index * width >= search.things.end || (index + 1) * width <= search.things.start;
        if is_outside || (search.distance_m)(&self.levels[level][index]) > *search.bound_m + SLACK_M
        {
            return;
        }
        if level == 0 {
            let bound_m = (search.visit)(index);
            *search.bound_m = search.bound_m.min(bound_m);
            return;
        }
        let end = ((index + 1) * WIDTH).min(self.levels[level - 1].len());
        for child in index * WIDTH..end {
            self.descend(level - 1, child, search);
        }
    }
}

/// A search under way.
struct Search<'a> {
    things: Range<usize>,
    bound_m: &'a mut f64,
    distance_m: &'a dyn Fn(&Extent) -> f64,
    visit: &'a mut dyn FnMut(usize) -> f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Points of a walk, and the nearest of some of them by a test of each.
    #[test]
    fn it_finds_what_a_test_of_each_finds() {
        let mut random = Random::new(7, "boxes", 0);
        for count in [1, 2, 7, 8, 9, 63, 64, 65, 1000] {
            let mut at_m = DVec3::ZERO;
            let points: Vec<DVec3> = (0..count)
                .map(|_| {
                    at_m += DVec3::from_array(std::array::from_fn(|_| random.range(-0.5, 0.5)));
                    // On a grid, so that several points are equally near.
                    at_m.round()
                })
                .collect();
            let tree = BoxTree::new(points.iter().map(|point| Extent::from_line(*point, *point)));
            for _ in 0..50 {
                let wanted_m: DVec3 =
                    std::array::from_fn(|_| (random.range(-10.0, 10.0)).round()).into();
                let first = random.below(count);
                let end = first + random.below(count - first + 1);
                let mut best = (f64::INFINITY, usize::MAX);
                for (index, point) in points.iter().enumerate().take(end).skip(first) {
                    if point.distance(wanted_m) < best.0 {
                        best = (point.distance(wanted_m), index);
                    }
                }
                let mut found = (f64::INFINITY, usize::MAX);
                let mut visits = 0;
                tree.visit(
                    first..end,
                    f64::INFINITY,
                    &|extent| extent.away_m(wanted_m).length(),
                    &mut |index| {
                        visits += 1;
                        let distance_m = points[index].distance(wanted_m);
                        if distance_m < found.0 {
                            found = (distance_m, index);
                        }
                        found.0
                    },
                );
                assert_eq!(found, best, "{count} points, {first}..{end}");
                assert!(visits <= 200, "{visits} of {count} points were tested");
                let all = (first..end).map(|at| Extent::from_line(points[at], points[at]));
                assert_eq!(tree.extent(first..end), all.reduce(Extent::with));
            }
        }
    }
}
