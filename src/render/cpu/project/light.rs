//! Changes of the colours of splats that do not depend on the viewing direction: an actor's tint,
//! and the contact shadows of actors on the twin.

use fearless_simd::{f32x16, prelude::*};

use super::splat_block::SplatBlock;
use crate::cpu::lanes::Vec3x16;
use crate::layout::ChunkShadow;
use wildcity_scene::actor::ContactShadow;
use wildcity_scene::chunk::{Cluster, Lanes, column};

/// The light on the Gaussians of one chunk.
#[derive(Clone, Copy, Debug)]
pub(super) enum Light<'a> {
    /// The colours are those of the Gaussians.
    AsStored,
    /// An actor: a factor on red, green and blue.
    Tinted([f32; 3]),
    /// A chunk of the twin with actors above it, some of them in this view.
    Shadowed { shadows: &'a [ChunkShadow], view: usize },
}

impl Light<'_> {
    /// The part of the light that reaches a cluster.
    #[inline(always)]
    pub(super) fn on(self, cluster: &Cluster) -> Self {
        match self {
            Self::Shadowed { shadows, view }
                // Nearly all clusters are far from every actor, and are drawn without any loop.
                if !shadows.iter().any(|shadow| shadow.falls_on(cluster, view)) =>
            {
                Self::AsStored
            }
            light => light,
        }
    }

    /// Changes the colours of a block of 16 Gaussians.
    #[inline(always)]
    pub(super) fn apply<S: Simd>(self, simd: S, columns: &[Lanes], splats: &mut SplatBlock) {
        match self {
            Self::AsStored => {}
            Self::Tinted(tint) => {
                let tint = Vec3x16::splat(simd, tint);
                splats.set_colors(splats.colors(simd).times(tint));
            }
            Self::Shadowed { shadows, view } => {
                let mean = Vec3x16::load(simd, columns, column::MEAN);
                // Shadows of several actors multiply, as in the reference backend.
                let mut factor = f32x16::splat(simd, 1.0);
                for shadow in shadows.iter().filter(|shadow| shadow.views.contains(view)) {
                    factor *= shadow_factor(simd, mean, shadow);
                }
                splats.set_colors(splats.colors(simd).scale(factor));
            }
        }
    }
}

/// [`ContactShadow::factor`] of 16 centres relative to their chunk, in metres.
#[inline(always)]
fn shadow_factor<S: Simd>(simd: S, mean: Vec3x16<S>, shadow: &ChunkShadow) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let [mut x, mut y, mut z] = [splat(0.0); 3];
    for (place, row) in [&mut x, &mut y, &mut z].into_iter().zip(shadow.actor_from_chunk) {
        let [x, y, z, translation_m] = row;
        *place = Vec3x16::splat(simd, [x, y, z]).dot(mean) + splat(translation_m);
    }
    let [half_length_m, half_width_m] = shadow.half_m;
    let fade_m = ContactShadow::FADE_M;
    // The shadow fades around the edge of the box: half inside of it, half outside.
    let along = falling(simd, half_length_m - fade_m, half_length_m + fade_m, x.abs());
    let across = falling(simd, half_width_m - fade_m, half_width_m + fade_m, y.abs());
    let above = falling(simd, ContactShadow::GROUND_M, ContactShadow::TOP_M, z.abs());
    splat(1.0) - splat(ContactShadow::DEPTH) * along * across * above
}

/// 1 up to `from`, 0 from `to` on, and `1 - t² (3 - 2 t)` between them, where t runs from 0 to 1.
#[inline(always)]
fn falling<S: Simd>(simd: S, from: f32, to: f32, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let share = (x - splat(from)) * splat(1.0 / (to - from));
    let t = share.max(splat(0.0)).min(splat(1.0));
    splat(1.0) - t * t * (splat(3.0) - t - t)
}
