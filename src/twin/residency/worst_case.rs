//! The most that one frame of a twin can need, wherever its cameras stand.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use crate::limits;
use wildcity_scene::geometry::Bounds;
use wildcity_scene::{Chunk, Manifest, RenderProfile};

use super::BlockIndex;
use super::demand::coarsest_level;

/// As far as it decides how much detail a frame needs: the cameras of a rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigExtent {
    /// The longest focal length, in pixels.
    pub focal_px: f64,
    /// How far the farthest camera is from the rig's origin, in metres.
    pub radius_m: f64,
}

/// An upper bound, in bytes, of what a frame of a rig anywhere needs at once.
///
/// Of all places in a square, none is nearer to a block than the square is, so that the levels chosen
/// by the distance of the square are bytes that no frame in it exceeds. The square of the highest
/// bound is divided again and again until it is as small as a cell: then no place anywhere needs more
/// than that. Outside of the box of everything, each place needs no more than the nearest one of the
/// box does, which is nearer to everything.
pub(super) fn worst_case_bytes(
    index: &BlockIndex,
    manifest: &Manifest,
    lens: RigExtent,
    profile: &RenderProfile,
) -> u64 {
    let whole = index.bounds();
    if whole.is_empty() {
        return 0;
    }
    let bound = |place: Bounds| {
        let mut bytes = 0;
        let distance_m = |bounds: &Bounds| (gap_m(&place, bounds) - lens.radius_m).max(0.0);
        index.visit(profile.reach_m, &distance_m, &mut |block, distance_m| {
            let levels = block.levels(manifest);
            let section =
                &levels[coarsest_level(levels, lens.focal_px, distance_m, profile.tau_px)];
            bytes += Chunk::bytes_of(manifest.sh_degree, section.count.into());
        });
        Square { bytes, place }
    };
    let mut squares = BinaryHeap::from([bound(whole)]);
    for _ in 0..limits::WORST_PLACES {
        let Some(worst) = squares.pop() else { break };
        let [low, high] = halves(&worst.place);
        if worst.place.size_m().truncate().max_element() <= wildcity_scene::chunk::CELL_M {
            squares.push(worst);
            break;
        }
        squares.extend([bound(low), bound(high)]);
    }
    // Where the search ends early, the bound is only less tight.
    squares.peek().map_or(0, |worst| worst.bytes)
}

#[derive(Debug, PartialEq)]
struct Square {
    bytes: u64,
    place: Bounds,
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

/// The distance of two boxes, in metres; 0 where they touch.
fn gap_m(a: &Bounds, b: &Bounds) -> f64 {
    (a.min_m - b.max_m).max(b.min_m - a.max_m).max(glam::DVec3::ZERO).length()
}

/// Both halves of a box, cut across its longer side in x or y.
fn halves(place: &Bounds) -> [Bounds; 2] {
    let (size_m, middle_m) = (place.size_m(), place.center_m());
    let axis = usize::from(size_m.y > size_m.x);
    let (mut low, mut high) = (*place, *place);
    low.max_m[axis] = middle_m[axis];
    high.min_m[axis] = middle_m[axis];
    [low, high]
}
