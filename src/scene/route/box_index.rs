//! A spatial index of items along a drive: a list of bounding boxes of consecutive items.

use glam::DVec3;

use crate::geometry::Bounds;

/// Items in the order of a drive, grouped into boxes of `BOX_ITEMS` consecutive items.
///
/// A search tests every box but opens few: for 84 km of keyframes at 0.5 m, 2,600 boxes and some
/// hundred of the 168,000 keyframes.
#[derive(Clone, Debug)]
pub struct BoxIndex {
    bounds: Vec<Bounds>,
    items: usize,
}

/// Number of items per box. The square root of 168,000, 410, would balance the numbers of boxes and
/// items. It is smaller because testing an item takes longer than testing a box.
const BOX_ITEMS: usize = 64;

impl BoxIndex {
    /// An index of items with these bounds, in order.
    pub fn new(items: &[Bounds]) -> Self {
        let union = |chunk: &[Bounds]| chunk.iter().fold(Bounds::EMPTY, |all, one| all.union(one));
        Self { bounds: items.chunks(BOX_ITEMS).map(union).collect(), items: items.len() }
    }

    /// The index of the item with the smallest cost, and that cost; the first of several equal
    /// ones. A cost is in metres and must not be less than the distance from the point to the
    /// item's bounds; the closer to that distance, the faster the search.
    pub fn min_cost(&self, point_m: DVec3, cost_m: impl Fn(usize) -> f64) -> Option<(usize, f64)> {
        let distances_m = self.bounds.iter().map(|bounds| bounds.distance_m(point_m));
        let (nearest, _) =
            distances_m.enumerate().min_by(|(_, a_m), (_, b_m)| a_m.total_cmp(b_m))?;
        let mut best: Option<(usize, f64)> = None;
        let search_box = |place: usize, best: &mut Option<(usize, f64)>| {
            let first = place * BOX_ITEMS;
            for item in first..(first + BOX_ITEMS).min(self.items) {
                let cost = cost_m(item);
                // Compared with the index as the second part, so that of equal costs the first item
                // counts, in whichever order boxes are opened.
                let less = |(known, least): (usize, f64)| (cost, item) < (least, known);
                if best.is_none_or(less) {
                    *best = Some((item, cost));
                }
            }
        };
        // Start with the nearest box: it usually contains the result, and then most others are
        // skipped.
        search_box(nearest, &mut best);
        for (place, bounds) in self.bounds.iter().enumerate() {
            // Not strictly less: an equal cost may belong to an item with a smaller index.
            let may_be_less = |(_, least)| bounds.distance_m(point_m) <= least;
            if place != nearest && best.is_none_or(may_be_less) {
                search_box(place, &mut best);
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

    /// Twice around a block of 100 m x 60 m, one pose per metre.
    fn drive() -> Vec<DVec3> {
        // The block's outline is 2 (100 + 60) = 320 m long; the second round repeats every pose, so
        // that ties occur.
        let at = |way_m: f64| match way_m % 320.0 {
            m if m < 100.0 => DVec3::new(m, 0.0, 0.0),
            m if m < 160.0 => DVec3::new(100.0, m - 100.0, 0.0),
            m if m < 260.0 => DVec3::new(260.0 - m, 60.0, 0.0),
            m => DVec3::new(0.0, 320.0 - m, 0.0),
        };
        (0..640).map(|i| at(f64::from(i))).collect()
    }

    #[test]
    fn the_result_is_that_of_a_linear_search() {
        let drive = drive();
        let point = |at_m: &DVec3| Bounds { min_m: *at_m, max_m: *at_m };
        let boxes = BoxIndex::new(&drive.iter().map(point).collect::<Vec<_>>());
        let looked_at = Cell::new(0);
        for i in 0..400 {
            let x_m = f64::from(i % 20) * 7.0 - 20.0;
            let y_m = f64::from(i / 20) * 5.0 - 20.0;
            let place_m = DVec3::new(x_m, y_m, 1.0);
            let cost_m = |item: usize| {
                looked_at.set(looked_at.get() + 1);
                drive[item].distance(place_m)
            };
            let distances = drive.iter().map(|at_m| at_m.distance(place_m)).enumerate();
            let slow = distances.min_by(|(_, a), (_, b)| a.total_cmp(b));
            assert_eq!(boxes.min_cost(place_m, cost_m), slow, "{place_m}");
        }
        // Fewer than half of all items are looked at, where a linear search looks at all.
        assert!(looked_at.get() < 400 * 640 / 2, "{} of {}", looked_at.get(), 400 * 640);
        assert_eq!(BoxIndex::new(&[]).min_cost(DVec3::ZERO, |_| 0.0), None);
    }
}
