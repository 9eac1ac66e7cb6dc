//! Tiles: 16 rows of 16 beams.

use fearless_simd::{f32x16, prelude::*};

use super::beam::{Beam, Hit};
use super::candidates::{Candidate, Candidates};
use super::sector::{BodySector, Sector};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::math::exp2;
use crate::lidar::{LidarView, Sweep};
use wildcity_scene::RenderProfile;
use wildcity_scene::chunk::LANES;

/// Candidates between two looks for the farthest beam that has not returned nearer.
const LOOKS: usize = 16;

/// A tile that is being cast.
pub(super) struct Tile<'a> {
    place: Option<Place<'a>>,
    /// Of a row after the other. Lanes beyond the last column or row have a range of 0.
    beams: Vec<Beam>,
    /// How far each beam is followed: to its return, or the LiDAR's range, in metres.
    ends_m: [[f32; LANES]; LANES],
    /// The largest of each row of `ends_m`.
    row_ends_m: [f32; LANES],
    /// The beams as each body that was met sees them.
    rays: Vec<(u32, Rays)>,
}

/// Where a tile is.
#[derive(Clone, Copy)]
struct Place<'a> {
    sector: &'a Sector,
    view: &'a LidarView,
    first_row: usize,
    first_column: usize,
}

/// The beams of a tile in the axes of a body.
struct Rays {
    /// The LiDAR's position when each column is fired, relative to that of the sector's middle, in
    /// metres.
    origin_m: [[f32; LANES]; 3],
    /// Unit directions, by row.
    directions: [[[f32; LANES]; 3]; LANES],
}

impl Default for Tile<'_> {
    fn default() -> Self {
        Self {
            place: None,
            beams: vec![Beam::default(); LANES * LANES],
            ends_m: [[0.0; LANES]; LANES],
            row_ends_m: [0.0; LANES],
            rays: Vec::new(),
        }
    }
}

impl Place<'_> {
    fn columns(&self) -> usize {
        LANES.min(self.sector.columns.end - self.first_column)
    }

    fn rows(&self) -> usize {
        LANES.min(self.view.lidar.rows() - self.first_row)
    }

    fn rays(&self, seen: &BodySector<'_>) -> Rays {
        let mut rays = Rays { origin_m: [[0.0; LANES]; 3], directions: [[[0.0; LANES]; 3]; LANES] };
        for lane in 0..LANES {
            // Lanes beyond the last column repeat it: they are not followed.
            let column = self.first_column + lane.min(self.columns() - 1);
            let pose = &seen.poses[column - self.sector.columns.start];
            let origin_m = seen.from_middle(pose.position_m).to_array();
            let axes = pose.rotation_matrix();
            for (axis, value) in origin_m.into_iter().enumerate() {
                rays.origin_m[axis][lane] = value as f32;
            }
            for row in 0..self.rows() {
                let direction = axes * self.sector.direction(self.first_row + row, column);
                for (axis, value) in direction.to_array().into_iter().enumerate() {
                    rays.directions[row][axis][lane] = value as f32;
                }
            }
        }
        rays
    }
}

impl<'a> Tile<'a> {
    /// Begins the tile of a place.
    pub(super) fn begin(
        &mut self,
        sector: &'a Sector,
        view: &'a LidarView,
        first_row: usize,
        first_column: usize,
    ) {
        let place = Place { sector, view, first_row, first_column };
        self.place = Some(place);
        self.beams.iter_mut().for_each(Beam::clear);
        self.rays.clear();
        let max_range_m = view.lidar.max_range_m() as f32;
        self.ends_m = [[0.0; LANES]; LANES];
        for ends_m in &mut self.ends_m[..place.rows()] {
            ends_m[..place.columns()].fill(max_range_m);
        }
        self.row_ends_m = [0.0; LANES];
        self.row_ends_m[..place.rows()].fill(max_range_m);
    }

    /// Compares its beams with candidates, the nearest first.
    #[inline(always)]
    pub(super) fn cast<S: Simd>(
        &mut self,
        simd: S,
        candidates: &Candidates,
        bodies: &[BodySector<'_>],
        list: &[u32],
        profile: &RenderProfile,
    ) {
        let Some(place) = self.place else { return };
        let least_m = place.view.lidar.min_range_m() as f32;
        let cap = profile.alpha_cap as f32;
        for listed in list.chunks(LOOKS) {
            // Behind the returns of all beams.
            let farthest_m = self.row_ends_m.iter().copied().fold(0.0, f32::max);
            if candidates.list[listed[0] as usize].nearest_m > farthest_m {
                break;
            }
            let mut changed_rows = 0_u32;
            for at in listed {
                let candidate = &candidates.list[*at as usize];
                let rays = match self.rays.iter().position(|(body, _)| *body == candidate.body) {
                    Some(known) => known,
                    None => {
                        let seen = &bodies[candidate.body as usize];
                        self.rays.push((candidate.body, place.rays(seen)));
                        self.rays.len() - 1
                    }
                };
                let rays = &self.rays[rays].1;
                let [first, end] = candidate.rows.map(usize::from);
                let first = first.max(place.first_row) - place.first_row;
                let end = end.min(place.first_row + place.rows()) - place.first_row;
                for row in first..end {
                    if candidate.nearest_m > self.row_ends_m[row] {
                        continue;
                    }
                    let ends_m = &mut self.ends_m[row];
                    let met = meet(simd, candidate, rays, row, least_m, ends_m, cap);
                    let Some(Met { mut lanes, range_m, alpha }) = met else { continue };
                    changed_rows |= 1 << row;
                    while lanes != 0 {
                        let lane = lanes.trailing_zeros() as usize % LANES;
                        lanes &= lanes - 1;
                        let hit =
                            Hit { range_m: range_m[lane], alpha: alpha[lane], candidate: *at };
                        if let Some(end_m) = self.beams[row * LANES + lane].add(hit) {
                            ends_m[lane] = end_m;
                        }
                    }
                }
            }
            while changed_rows != 0 {
                let row = changed_rows.trailing_zeros() as usize % LANES;
                changed_rows &= changed_rows - 1;
                self.row_ends_m[row] = self.ends_m[row].iter().copied().fold(0.0, f32::max);
            }
        }
    }

    /// Writes its returns into a sweep of its sector, which has `width` columns.
    pub(super) fn write(
        &self,
        candidates: &Candidates,
        bodies: &[BodySector<'_>],
        part: &mut Sweep,
        width: usize,
    ) {
        let Some(place) = self.place else { return };
        for row in 0..place.rows() {
            for lane in 0..place.columns() {
                let luminance = |at: u32| candidates.list[at as usize].luminance;
                let beam = &self.beams[row * LANES + lane];
                let Some((hit, intensity)) = beam.returned(luminance) else { continue };
                let column = place.first_column - place.sector.columns.start + lane;
                let at = (place.first_row + row) * width + column;
                let body = candidates.list[hit.candidate as usize].body;
                part.range_m[at] = hit.range_m;
                part.intensity[at] = intensity;
                part.instance[at] = bodies[body as usize].body.instance;
            }
        }
    }
}

/// Where 16 beams meet a candidate.
struct Met {
    lanes: u64,
    range_m: [f32; LANES],
    alpha: [f32; LANES],
}

/// Compares a row of beams with a candidate; `None` if no beam meets it before its end.
#[inline(always)]
fn meet<S: Simd>(
    simd: S,
    candidate: &Candidate,
    rays: &Rays,
    row: usize,
    least_m: f32,
    ends_m: &[f32; LANES],
    cap: f32,
) -> Option<Met> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let direction = Vec3x16::from_arrays(simd, &rays.directions[row]);
    let origin = Vec3x16::from_arrays(simd, &rays.origin_m);
    let to_mean = Vec3x16::splat(simd, candidate.mean_m).minus(origin);
    // From the point of the beam that is nearest to the centre: what is left is as small as the
    // Gaussian, and loses no digits to the distance.
    let along_m = to_mean.dot(direction);
    let across = to_mean.minus(direction.scale(along_m));
    let across = whitened(simd, candidate, across);
    let step = whitened(simd, candidate, direction);
    let per_step2 = splat(1.0) / step.dot(step);
    let cross = across.cross(step);
    let squared = cross.dot(cross) * per_step2;
    let range_m = (across.dot(step)).mul_add(per_step2, along_m);
    let meets = squared.simd_le(splat(candidate.reach2))
        & range_m.simd_gt(splat(least_m))
        & range_m.simd_le(f32x16::load_array_ref(simd, ends_m));
    if meets.all_false() {
        return None;
    }
    let log2_e = 0.5 * std::f32::consts::LOG2_E;
    let exponent = squared.mul_add(splat(-log2_e), splat(candidate.log2_opacity));
    // Merged Gaussians may be more opaque than 1.
    let alpha = exp2(simd, exponent.min(splat(0.0))).min(splat(cap));
    Some(Met {
        lanes: u64::from(meets.to_bitmask()),
        range_m: range_m.to_array(),
        alpha: alpha.to_array(),
    })
}

/// Vectors in metres as standard deviations of a candidate.
#[inline(always)]
fn whitened<S: Simd>(simd: S, candidate: &Candidate, v: Vec3x16<S>) -> Vec3x16<S> {
    let [x, y, z] = candidate.whiten;
    Vec3x16 {
        x: Vec3x16::splat(simd, x).dot(v),
        y: Vec3x16::splat(simd, y).dot(v),
        z: Vec3x16::splat(simd, z).dot(v),
    }
}
