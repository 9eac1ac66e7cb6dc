//! From splats back to Gaussians: the derivatives of stage project, 16 Gaussians at a time.
//!
//! Nothing is kept from the way there: a block is projected again, which is a twentieth of a frame.
//! Twins: `gradient/shape.rs` in f64, and the formulas in [`crate::gradient`].

mod color;
mod lens;
mod pinhole;

use fearless_simd::{Level, dispatch, f32x16, prelude::*};

use super::jobs::ChunkProjection;
use super::light::Light;
use super::splat_block::SplatBlock;
use super::{CLUSTER, Job, pinhole as pinhole_projection, unscented};
use crate::cpu::lanes::Vec3x16;
use crate::gradient::{Partial, Twist, partial};
use crate::layout::Cutoffs;
use wildcity_scene::chunk::{LANES, Lanes, column, columns};

/// The derivatives by the Gaussians of one unit.
pub(in crate::cpu) struct UnitGradients<'a> {
    /// The columns of its lane groups.
    pub(in crate::cpu) lanes: &'a mut [Lanes],
    /// A bit for each visible Gaussian of each lane group.
    pub(in crate::cpu) visible: &'a mut [u16],
}

/// The derivatives by 16 splats of a block, by the places of a [`Partial`]; 0 for Gaussians without
/// a splat.
struct SplatDerivatives([[f32; LANES]; partial::COUNT]);

/// What the projection of a block has beside its Gaussians.
#[derive(Clone, Copy)]
struct Block<'a> {
    columns: &'a [Lanes],
    sh_degree: u8,
    splats: &'a SplatBlock,
    by: &'a SplatDerivatives,
    /// Factor of the colours.
    tint: [f32; 3],
    cutoffs: &'a Cutoffs,
}

impl SplatDerivatives {
    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, place: usize) -> f32x16<S> {
        f32x16::load_array_ref(simd, &self.0[place])
    }

    #[inline(always)]
    fn rgb<S: Simd>(&self, simd: S) -> Vec3x16<S> {
        Vec3x16 {
            x: self.load(simd, partial::RGB),
            y: self.load(simd, partial::RGB + 1),
            z: self.load(simd, partial::RGB + 2),
        }
    }
}

/// Takes the derivatives by the splats of a job back to its Gaussians, and adds them to those of
/// other views. Returns those by the view's twist.
///
/// `by_splats` are in the order in which the job's splats were projected.
pub(in crate::cpu) fn back_project(
    level: Level,
    job: &Job<'_>,
    cutoffs: &Cutoffs,
    by_splats: &[Partial],
    gradients: &mut UnitGradients<'_>,
) -> Twist {
    dispatch!(level, simd => back_project_unit(simd, job, cutoffs, by_splats, gradients))
}

#[inline(always)]
fn back_project_unit<S: Simd>(
    simd: S,
    job: &Job<'_>,
    cutoffs: &Cutoffs,
    by_splats: &[Partial],
    gradients: &mut UnitGradients<'_>,
) -> Twist {
    let sh_degree = job.chunk.sh_degree();
    let width = columns(sh_degree);
    let blocks = job.chunk.len().div_ceil(LANES);
    let first_block = job.clusters.start * CLUSTER / LANES;
    let tint = match job.light {
        Light::Tinted(tint) => tint,
        // Shadows have been refused.
        Light::AsStored | Light::Shadowed { .. } => [1.0; 3],
    };
    let mut twist = [0.0_f64; 6];
    let mut next = by_splats.iter();
    for (k, cluster) in (job.clusters.clone()).zip(&job.chunk.clusters()[job.clusters.clone()]) {
        // The test that the forward pass makes: the splats must be the same ones.
        if !job.projection.may_see(job.chunk, cluster) {
            continue;
        }
        let first = k * CLUSTER / LANES;
        for block in first..(first + CLUSTER / LANES).min(blocks) {
            let columns = job.chunk.lane_group(block);
            let projected = match &job.projection {
                ChunkProjection::Pinhole { chunk_view, .. } => {
                    pinhole_projection::project_block(simd, columns, sh_degree, chunk_view, cutoffs)
                }
                ChunkProjection::Unscented(view) => {
                    unscented::project_block(simd, columns, sh_degree, view, cutoffs)
                }
            };
            let Some(splats) = projected else { continue };

            // The visible lanes in order, as they were appended.
            let mut by = SplatDerivatives([[0.0; LANES]; partial::COUNT]);
            let mut visible = splats.visible;
            while visible != 0 {
                let lane = visible.trailing_zeros() as usize % LANES;
                visible &= visible - 1;
                if let Some(values) = next.next() {
                    for (column, &value) in by.0.iter_mut().zip(values) {
                        column[lane] = value;
                    }
                }
            }

            let local = block - first_block;
            let to = &mut gradients.lanes[local * width..(local + 1) * width];
            if gradients.visible[local] == 0 {
                // No other view has shown the group, and its columns hold any value.
                to.fill(Lanes([0.0; LANES]));
            }
            gradients.visible[local] |= splats.visible as u16;
            let block = Block { columns, sh_degree, splats: &splats, by: &by, tint, cutoffs };
            match &job.projection {
                ChunkProjection::Pinhole { chunk_view, .. } => {
                    pinhole::back_project(simd, block, chunk_view, to, &mut twist);
                }
                ChunkProjection::Unscented(view) => {
                    lens::back_project(simd, block, view, to, &mut twist);
                }
            }
        }
    }
    Twist::from_array(twist)
}

/// Adds values of the visible lanes to three consecutive columns.
#[inline(always)]
fn add3<S: Simd>(simd: S, to: &mut [Lanes], first: usize, value: Vec3x16<S>, visible: f32x16<S>) {
    add(simd, to, first, value.x, visible);
    add(simd, to, first + 1, value.y, visible);
    add(simd, to, first + 2, value.z, visible);
}

/// Adds values of the visible lanes to a column. `visible` is 1 in these lanes and 0 in the others,
/// whose values may be anything.
#[inline(always)]
fn add<S: Simd>(simd: S, to: &mut [Lanes], column: usize, value: f32x16<S>, visible: f32x16<S>) {
    let zero = f32x16::splat(simd, 0.0);
    let to = &mut to[column].0;
    let value = visible.simd_gt(zero).select(value, zero);
    (f32x16::load_array_ref(simd, to) + value).store_array(to);
}

/// 1 in the visible lanes, and 0 in the others.
#[inline(always)]
fn visible_lanes<S: Simd>(simd: S, visible: u64) -> f32x16<S> {
    let mut lanes = [0.0; LANES];
    for (lane, value) in lanes.iter_mut().enumerate() {
        *value = (visible >> lane & 1) as f32;
    }
    f32x16::load_array_ref(simd, &lanes)
}

/// `2 (0, t) q` of the unit quaternions of a block: the derivatives by these of the torques t.
#[inline(always)]
fn by_quaternion<S: Simd>(simd: S, columns: &[Lanes], torque: Vec3x16<S>) -> [f32x16<S>; 4] {
    let w = f32x16::load_array_ref(simd, &columns[column::QUAT].0);
    let v = Vec3x16::load(simd, columns, column::QUAT + 1);
    let twice = torque.plus(torque);
    let Vec3x16 { x, y, z } = twice.mul_add(w, twice.cross(v));
    [-twice.dot(v), x, y, z]
}
