//! The most memory that one frame of a twin can need, wherever its cameras are.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::DVec3;

use crate::limits;
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::Section;
use wildcity_scene::{Manifest, RenderProfile};

use super::BlockIndex;
use super::demand::{Viewpoint, coarsest_level};

/// The part of a rig's cameras that decides how much detail a frame needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigExtent {
    /// Number of cameras.
    pub views: usize,
    /// The longest focal length of a camera, in pixels.
    pub focal_px: f64,
    /// The shortest focal length of a camera, in pixels.
    pub least_focal_px: f64,
    /// The distance of the farthest camera from the rig's origin, in metres.
    pub radius_m: f64,
}

impl RigExtent {
    /// That of cameras around a rig's origin in the world, in metres.
    pub fn new(viewpoints: &[Viewpoint], origin_m: DVec3) -> Self {
        let focal_px = viewpoints.iter().map(|viewpoint| viewpoint.focal_px);
        let from_origin_m =
            viewpoints.iter().map(|viewpoint| viewpoint.position_m.distance(origin_m));
        // Without cameras all of these are 0.
        Self {
            views: viewpoints.len(),
            focal_px: focal_px.clone().fold(0.0, f64::max),
            least_focal_px: focal_px.reduce(f64::min).unwrap_or(0.0),
            radius_m: from_origin_m.fold(0.0, f64::max),
        }
    }

    /// That of any one of the cameras: of the most demanding one, around itself.
    pub(super) fn one_view(&self) -> Self {
        // A longer focal length needs no less detail anywhere.
        Self { views: 1, least_focal_px: self.focal_px, radius_m: 0.0, ..*self }
    }

    /// An upper bound of the bytes of a block's levels that cameras need at once if the nearest is
    /// at least `nearest_m` away. `bytes` are those of each level.
    ///
    /// If the finest level that a camera needs is k, level k + 1 is too coarse for it, and so the
    /// nearest camera is nearer than that level allows for the longest focal length. The others are
    /// at most the rig's diameter farther, and none of them needs a coarser level than the shortest
    /// focal length does there.
    fn most_bytes(
        &self,
        levels: &[Section],
        nearest_m: f64,
        tau_px: f64,
        bytes: impl Fn(&Section) -> u64,
    ) -> u64 {
        let first = coarsest_level(levels, self.focal_px, nearest_m, tau_px);
        let with_finest = |finest: usize| {
            let farthest_m = levels.get(finest + 1).map_or(f64::INFINITY, |coarser| {
                self.focal_px * f64::from(coarser.error_m) / tau_px + 2.0 * self.radius_m
            });
            let coarsest = coarsest_level(levels, self.least_focal_px, farthest_m, tau_px);
            // A camera needs one level.
            let needed = levels[finest..=coarsest.max(finest)].iter().take(self.views);
            needed.map(&bytes).sum()
        };
        (first..levels.len()).map(with_finest).max().unwrap_or(0)
    }
}

/// An upper bound, in bytes, of the sections that a frame of a rig anywhere needs at once.
///
/// No point in an area is nearer to a block than the area itself is. So the levels that cameras at
/// the distance of the area or farther need add up to bytes that no frame in it exceeds. The area
/// with the highest bound is halved repeatedly until a rig in its middle needs nearly as much; then
/// no point anywhere needs more than its bound. A point outside of the bounding box needs no more
/// than the nearest point in the box, which is nearer to everything.
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
            let of_level = |level: &Section| block.needed_bytes(manifest, level);
            let levels = block.levels(manifest);
            bytes += extent.most_bytes(levels, distance_m, profile.tau_px, of_level);
        });
        BoundedArea { bytes, area }
    };
    // Invariant: the areas in the heap cover the whole map, so that the highest bound is one for
    // every point.
    let mut areas = BinaryHeap::from([bound(whole)]);
    for _ in 0..limits::WORST_CASE_AREAS {
        let Some(worst) = areas.pop() else { break };
        let middle_m = worst.area.center_m();
        let in_middle = bound(Bounds { min_m: middle_m, max_m: middle_m });
        // Halving further would gain a twentieth at most.
        if in_middle.bytes >= worst.bytes - worst.bytes / 20 {
            areas.push(worst);
            break;
        }
        let [low, high] = halves(&worst.area);
        areas.extend([bound(low), bound(high)]);
    }
    // A search that ends early leaves a bound that is valid but less tight.
    areas.peek().map_or(0, |worst| worst.bytes)
}

/// An area and the most bytes that a frame in it can need, ordered by bytes.
#[derive(Debug, PartialEq)]
struct BoundedArea {
    bytes: u64,
    area: Bounds,
}

impl Eq for BoundedArea {}

impl PartialOrd for BoundedArea {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for BoundedArea {
    fn cmp(&self, other: &Self) -> Ordering {
        self.bytes.cmp(&other.bytes)
    }
}

/// The distance between two boxes, in metres; 0 where they touch or overlap.
fn gap_m(a: &Bounds, b: &Bounds) -> f64 {
    // Per axis at most one difference is positive. Both are negative where the boxes overlap.
    (a.min_m - b.max_m).max(b.min_m - a.max_m).max(DVec3::ZERO).length()
}

/// The two halves of a box, cut across the longest of its sides.
fn halves(area: &Bounds) -> [Bounds; 2] {
    let size_m = area.size_m();
    let middle_m = area.center_m();
    let axis = size_m.max_position();
    let mut low = *area;
    let mut high = *area;
    low.max_m[axis] = middle_m[axis];
    high.min_m[axis] = middle_m[axis];
    [low, high]
}
