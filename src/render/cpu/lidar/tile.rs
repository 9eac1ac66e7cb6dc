//! Tiles: 16 rows of 16 beams.

use fearless_simd::{f32x16, prelude::*};

use super::beam::{BeamRow, Crossing, LOOKS};
use super::candidates::{Candidate, Candidates};
use super::sector::{BodySector, Sector};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::math::exp2;
use crate::lidar::{Keys, LidarView, Sweep};
use wildcity_scene::RenderProfile;
use wildcity_scene::chunk::LANES;

/// The beams of a tile.
pub(super) struct Tile {
    first_row: usize,
    first_column: usize,
    /// Rows and columns that the LiDAR has here: 16, but for the last ones.
    size: [usize; 2],
    /// A row after the other.
    beams: [BeamRow; LANES],
    /// How far the farthest beam of each row is followed, in metres.
    row_ends_m: [f32; LANES],
    /// The beams as the body sees them that they are compared with, once they are.
    rays: Option<Box<Rays>>,
}

/// The beams of a tile in the axes of a body.
#[repr(align(64))]
struct Rays {
    /// The LiDAR's position when each column is fired, relative to that of the sector's middle, in
    /// metres.
    origin_m: [[f32; LANES]; 3],
    /// Unit directions, by row.
    directions: [[[f32; LANES]; 3]; LANES],
}

impl Default for Tile {
    fn default() -> Self {
        Self {
            first_row: 0,
            first_column: 0,
            size: [0; 2],
            beams: Default::default(),
            row_ends_m: [0.0; LANES],
            rays: None,
        }
    }
}

impl Tile {
    /// Begins the tile at a place of the sweep.
    pub(super) fn begin(
        &mut self,
        sector: &Sector,
        view: &LidarView,
        first_row: usize,
        first_column: usize,
    ) {
        let rows = LANES.min(view.lidar.rows() - first_row);
        let columns = LANES.min(sector.columns.end - first_column);
        self.first_row = first_row;
        self.first_column = first_column;
        self.size = [rows, columns];
        // Lanes beyond the last column or row are not followed.
        let mut ends_m = [0.0; LANES];
        ends_m[..columns].fill(sector.max_range_m);
        self.beams.iter_mut().for_each(|beams| beams.begin([0.0; LANES]));
        self.beams[..rows].iter_mut().for_each(|beams| beams.begin(ends_m));
        self.row_ends_m = [0.0; LANES];
        self.row_ends_m[..rows].fill(sector.max_range_m);
    }

    /// The beams are compared with another body next.
    pub(super) fn leave_body(&mut self) {
        self.rays = None;
    }

    /// How far its beams are followed, in metres.
    pub(super) fn end_m(&self) -> f32 {
        self.row_ends_m.iter().copied().fold(0.0, f32::max)
    }

    fn rays(&self, seen: &BodySector<'_>) -> Rays {
        let [rows, columns] = self.size;
        let mut rays = Rays { origin_m: [[0.0; LANES]; 3], directions: [[[0.0; LANES]; 3]; LANES] };
        for lane in 0..LANES {
            // Lanes beyond the last column repeat it: they are not followed.
            let column = self.first_column + lane.min(columns - 1);
            let pose = &seen.poses[column - seen.sector.columns.start];
            let origin_m = seen.relative_to_middle(pose.position_m).to_array();
            let axes = pose.rotation_matrix();
            for (axis, value) in origin_m.into_iter().enumerate() {
                rays.origin_m[axis][lane] = value as f32;
            }
            for row in 0..rows {
                let direction = axes * seen.sector.direction(self.first_row + row, column);
                for (axis, value) in direction.to_array().into_iter().enumerate() {
                    rays.directions[row][axis][lane] = value as f32;
                }
            }
        }
        rays
    }

    /// Compares its beams with the candidates of a tile of a body.
    #[inline(always)]
    pub(super) fn cast<S: Simd>(
        &mut self,
        simd: S,
        candidates: &Candidates,
        tile: usize,
        seen: &BodySector<'_>,
        profile: &RenderProfile,
    ) {
        let list = &candidates.lists[tile];
        let rays = match self.rays.take() {
            Some(rays) => rays,
            // Rays take longer to make than a comparison, so that tiles that see nothing of a body
            // make none.
            None if list.is_empty() => return,
            None => Box::new(self.rays(seen)),
        };
        let origin = Vec3x16::from_arrays(simd, &rays.origin_m);
        let least_m = f32x16::splat(simd, seen.sector.min_range_m);
        let cap = f32x16::splat(simd, profile.alpha_cap as f32);
        let last_row = self.first_row + self.size[0];
        for listed in list.chunks(LOOKS) {
            self.beams.iter_mut().for_each(BeamRow::reserve);
            let mut changed_rows = 0_u32;
            for at in listed {
                let reach = &candidates.reaches[*at as usize];
                let aim = Aim::new(simd, &candidates.list[*at as usize], origin);
                let [first, end] = reach.rows.map(usize::from);
                for row in first.max(self.first_row)..end.min(last_row) {
                    let row = row - self.first_row;
                    // All beams of the row have returned before the candidate.
                    if reach.nearest_m > self.row_ends_m[row] {
                        continue;
                    }
                    let direction = Vec3x16::from_arrays(simd, &rays.directions[row]);
                    let beams = &mut self.beams[row];
                    let met = aim.meet(direction, least_m, &beams.ends_m, cap);
                    let Some(crossing) = met else { continue };
                    if beams.add(simd, &crossing) {
                        changed_rows |= 1 << row;
                    }
                }
            }
            // Once per piece of the list: the farthest end of a row takes a pass over its beams.
            while changed_rows != 0 {
                let row = changed_rows.trailing_zeros() as usize % LANES;
                changed_rows &= changed_rows - 1;
                self.row_ends_m[row] = self.beams[row].ends_m.iter().copied().fold(0.0, f32::max);
            }
        }
        self.rays = Some(rays);
    }

    /// Writes its returns into a sweep of its sector, which has `width` columns.
    #[inline(always)]
    pub(super) fn write<S: Simd>(
        &self,
        simd: S,
        sector: &Sector,
        keys: &Keys,
        part: &mut Sweep,
        width: usize,
    ) {
        let [rows, columns] = self.size;
        for row in 0..rows {
            let returns = self.beams[row].returns(simd);
            let first = (self.first_row + row) * width + self.first_column - sector.columns.start;
            let to = first..first + columns;
            part.range_m[to.clone()].copy_from_slice(&returns.range_m[..columns]);
            part.intensity[to.clone()].copy_from_slice(&returns.luminance[..columns]);
            part.gaussian[to.clone()].copy_from_slice(&returns.key[..columns]);
            let found = returns.range_m.iter().zip(&returns.key);
            for (instance, (range_m, key)) in part.instance[to].iter_mut().zip(found) {
                // A beam without a return has range 0 and no Gaussian.
                if *range_m > 0.0 {
                    *instance = keys.instance(*key);
                }
            }
        }
    }
}

/// A candidate as the columns of a tile see it.
struct Aim<S: Simd> {
    simd: S,
    /// From where each column is fired to the centre, in standard deviations.
    to_mean: Vec3x16<S>,
    /// Rows of the matrix that takes vectors in metres to standard deviations.
    whiten: [Vec3x16<S>; 3],
    reach2: f32x16<S>,
    log2_opacity: f32x16<S>,
    luminance: f32,
    key: u32,
}

impl<S: Simd> Aim<S> {
    #[inline(always)]
    fn new(simd: S, candidate: &Candidate, origin_m: Vec3x16<S>) -> Self {
        let [xx, xy, xz, yx, yy, yz, zx, zy, zz] = candidate.whiten;
        let whiten = [
            Vec3x16::splat(simd, [xx, xy, xz]),
            Vec3x16::splat(simd, [yx, yy, yz]),
            Vec3x16::splat(simd, [zx, zy, zz]),
        ];
        let to_mean_m = Vec3x16::splat(simd, candidate.mean_m).minus(origin_m);
        Self {
            simd,
            to_mean: whitened(whiten, to_mean_m),
            whiten,
            reach2: f32x16::splat(simd, candidate.reach2),
            log2_opacity: f32x16::splat(simd, candidate.log2_opacity),
            luminance: candidate.luminance,
            key: candidate.key,
        }
    }

    /// Compares a row of beams with the candidate; `None` if no beam meets it before its end.
    #[inline(always)]
    fn meet(
        &self,
        direction: Vec3x16<S>,
        least_m: f32x16<S>,
        ends_m: &[f32; LANES],
        cap: f32x16<S>,
    ) -> Option<Crossing<S>> {
        let simd = self.simd;
        let step = whitened(self.whiten, direction);
        // `step` is one metre along the beam, in standard deviations.
        let step2 = step.dot(step);
        // The distance of the beam from the centre, as that of a line from a point. It loses no
        // digits to a Gaussian that is flat, unlike a difference of two long vectors.
        let aside = self.to_mean.cross(step);
        let aside2 = aside.dot(aside);
        let is_near = aside2.simd_le(self.reach2 * step2);
        if is_near.all_false() {
            return None;
        }
        let per_step2 = f32x16::splat(simd, 1.0) / step2;
        let squared = aside2 * per_step2;
        let range_m = self.to_mean.dot(step) * per_step2;
        let meets = is_near
            & range_m.simd_gt(least_m)
            & range_m.simd_le(f32x16::load_array_ref(simd, ends_m));
        if meets.all_false() {
            return None;
        }
        let log2_e = f32x16::splat(simd, -0.5 * std::f32::consts::LOG2_E);
        let exponent = squared.mul_add(log2_e, self.log2_opacity);
        // Merged Gaussians may be more opaque than 1.
        let alpha = exp2(simd, exponent.min(f32x16::splat(simd, 0.0))).min(cap);
        Some(Crossing {
            meets,
            range_m,
            alpha: meets.select(alpha, f32x16::splat(simd, 0.0)),
            luminance: self.luminance,
            key: self.key,
        })
    }
}

/// Vectors in metres as standard deviations.
#[inline(always)]
fn whitened<S: Simd>([x, y, z]: [Vec3x16<S>; 3], v: Vec3x16<S>) -> Vec3x16<S> {
    Vec3x16 { x: x.dot(v), y: y.dot(v), z: z.dot(v) }
}
