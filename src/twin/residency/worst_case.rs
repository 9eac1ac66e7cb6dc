//! The most memory that one frame of a twin can need, wherever its cameras are.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use crate::limits;
use wildcity_scene::geometry::Bounds;
use wildcity_scene::{Chunk, Manifest, RenderProfile};

use super::BlockIndex;
use super::demand::coarsest_level;

/// The part of a rig's cameras that decides how much detail a frame needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigExtent {
    /// The longest focal length of a camera, in pixels.
    pub focal_px: f64,
    /// The distance of the farthest camera from the rig's origin, in metres.
    pub radius_m: f64,
}

/// An upper bound, in bytes, of the sections that a frame of a rig anywhere needs at once.
///
/// No point in a square is nearer to a block than the square itself is. So the levels that are
/// chosen by the distance of the square add up to bytes that no frame in the square exceeds. The
/// square with the highest bound is halved repeatedly until it is as small as a cell; then no point
/// anywhere needs more than its bound. A point outside of the bounding box needs no more than the
/// nearest point in the box, which is nearer to everything.
pub(super) fn worst_case_bytes(
    index: &BlockIndex,
    manifest: &Manifest,
    extent: RigExtent,
    profile: &RenderProfile,
) -> u64 {
    let whole = index.bounds();
    if whole.is_empty() {
        return 0;
    }
    let bound = |area: Bounds| {
        let mut bytes = 0;
        // A camera may be `radius_m` nearer than the rig's origin, and the triangle inequality
        // allows no more.
        let distance_m = |bounds: &Bounds| (gap_m(&area, bounds) - extent.radius_m).max(0.0);
        index.visit(profile.reach_m, distance_m, |block, distance_m| {
            let levels = block.levels(manifest);
            // Bytes rise as the level falls, and the level falls with the distance, so that a lower
            // bound of the distance is an upper bound of the bytes.
            let level = coarsest_level(levels, extent.focal_px, distance_m, profile.tau_px);
            bytes += Chunk::needed_bytes(manifest.sh_degree, levels[level].count.into());
        });
        Square { bytes, area }
    };
    // Invariant: the squares in the heap cover the whole map, so that the highest bound is one for
    // every point.
    let mut squares = BinaryHeap::from([bound(whole)]);
    for _ in 0..limits::WORST_CASE_SQUARES {
        let Some(worst) = squares.pop() else { break };
        // The largest bound is at its finest: halving further would gain little. Height does not
        // count, because only x and y are halved.
        if worst.area.size_m().truncate().max_element() <= wildcity_scene::chunk::CELL_M {
            squares.push(worst);
            break;
        }
        let [low, high] = halves(&worst.area);
        squares.extend([bound(low), bound(high)]);
    }
    // A search that ends early leaves a bound that is valid but less tight.
    squares.peek().map_or(0, |worst| worst.bytes)
}

/// An area and the most bytes that a frame in it can need, ordered by bytes.
#[derive(Debug, PartialEq)]
struct Square {
    bytes: u64,
    area: Bounds,
}

impl Eq for Square {}

impl PartialOrd for Square {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Square {
    fn cmp(&self, other: &Self) -> Ordering {
        self.bytes.cmp(&other.bytes)
    }
}

/// The distance between two boxes, in metres; 0 where they touch or overlap.
fn gap_m(a: &Bounds, b: &Bounds) -> f64 {
    // Per axis at most one difference is positive. Both are negative where the boxes overlap.
    (a.min_m - b.max_m).max(b.min_m - a.max_m).max(glam::DVec3::ZERO).length()
}

/// The two halves of a box, cut across the longer of its sides along x and y.
fn halves(area: &Bounds) -> [Bounds; 2] {
    let size_m = area.size_m();
    let middle_m = area.center_m();
    let axis = usize::from(size_m.y > size_m.x);
    let mut low = *area;
    let mut high = *area;
    low.max_m[axis] = middle_m[axis];
    high.min_m[axis] = middle_m[axis];
    [low, high]
}
