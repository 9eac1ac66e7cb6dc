//! What is behind the Gaussians: the first part of stage resolve, for frames that have something there.

use std::sync::Arc;

use fearless_simd::{f32x16, i32x16, prelude::*, u32x16};
use glam::{DMat3, DVec2};

use super::lanes::Vec3x16;
use super::optics;
use super::resolve::TileSums;
use crate::constants::BLOCK_PX;
use crate::{Frame, RenderError, View};
use wildcity_scene::chunk::LANES;
use wildcity_scene::sky::{CubeMap, DrawableSky, SKY_CUT, Scratch};

/// Blocks of a tile.
const BLOCKS: usize = 16;

/// What is behind the Gaussians of one view.
#[derive(Debug)]
pub(super) struct Behind {
    drawn: DrawableSky,
    looks: Looks,
}

/// Where the pixels of a view look, in the sky's axes.
#[derive(Debug)]
enum Looks {
    /// Rows that take `(x, y, 1)` in pixels to a direction of any length.
    Ideal([[f32; 3]; 3]),
    /// Of a pinhole that moves or is behind a windshield, or of a round lens.
    Described(optics::Looks),
    /// Pixel by pixel, as the lens and the shutter have it; the matrix is `sky_from_world`.
    Bent(Box<(View, DMat3)>),
}

impl Behind {
    /// What is behind each view of a frame; empty if nothing is.
    ///
    /// # Errors
    /// The sky cannot be drawn as the profile asks.
    pub(super) fn of(frame: &Frame<'_>) -> Result<Vec<Self>, RenderError> {
        let Some((drawn, axes)) = frame.background()? else { return Ok(Vec::new()) };
        let of_view = |view: &View| {
            let looks = if view.is_static_pinhole() {
                Looks::Ideal(view.sky_from_pixel(axes))
            } else if let Some(looks) = optics::Looks::of(view, axes) {
                Looks::Described(looks)
            } else {
                Looks::Bent(Box::new((*view, axes)))
            };
            Self { drawn: drawn.clone(), looks }
        };
        Ok(frame.views.iter().map(of_view).collect())
    }

    /// What evaluating a network needs, where one is evaluated.
    pub(super) fn scratch(&self) -> Option<Scratch> {
        match &self.drawn {
            DrawableSky::Network(network) => Some(network.scratch()),
            DrawableSky::CubeMap(_) => None,
        }
    }

    /// Adds what shows through a tile whose corner is `at_px`.
    #[inline(always)]
    pub(super) fn add<S: Simd>(
        &self,
        simd: S,
        at_px: [u32; 2],
        scratch: &mut Option<Scratch>,
        sums: &mut TileSums,
    ) {
        for block in 0..BLOCKS {
            add_sky(simd, self, at_px, block, scratch, sums);
        }
    }
}

#[inline(always)]
fn add_sky<S: Simd>(
    simd: S,
    behind: &Behind,
    at_px: [u32; 2],
    block: usize,
    scratch: &mut Option<Scratch>,
    sums: &mut TileSums,
) {
    let splat = |value: f32| f32x16::splat(simd, value);
    let transmittance = f32x16::load_array_ref(simd, &sums.transmittance[block]);
    let shows = transmittance.simd_ge(splat(SKY_CUT as f32));
    if shows.all_false() {
        return;
    }
    let edge = BLOCK_PX;
    let (left, top) = (block as u32 % edge * edge, block as u32 / edge * edge);
    let x = f32x16::from_fn(simd, |lane| (at_px[0] + left + lane as u32 % edge) as f32 + 0.5);
    let y = f32x16::from_fn(simd, |lane| (at_px[1] + top + lane as u32 / edge) as f32 + 0.5);
    let away = match &behind.looks {
        Looks::Ideal([first, second, third]) => {
            let row = |[a, b, c]: [f32; 3]| x.mul_add(splat(a), y.mul_add(splat(b), splat(c)));
            Vec3x16 { x: row(*first), y: row(*second), z: row(*third) }
        }
        Looks::Described(looks) => looks.toward(simd, x, y),
        Looks::Bent(bent) => {
            let (view, sky_from_world) = &**bent;
            let [x, y, z] = directions(view, *sky_from_world, &x.to_array(), &y.to_array());
            let load = |values| f32x16::load_array_ref(simd, values);
            Vec3x16 { x: load(&x), y: load(&y), z: load(&z) }
        }
    };
    let rgb = match (&behind.drawn, scratch) {
        (DrawableSky::CubeMap(map), _) => look_up(simd, map, away),
        (DrawableSky::Network(network), Some(scratch)) => {
            let unit = away.scale(splat(1.0) / away.dot(away).sqrt());
            let rgb = network.rgb(simd, [unit.x, unit.y, unit.z], scratch);
            [0, 1, 2].map(|c: usize| f32x16::load_array_ref(simd, &rgb[c]))
        }
        // `scratch` is made for every network.
        (DrawableSky::Network(_), None) => return,
    };
    let weight = shows.select(transmittance, splat(0.0));
    for (sum, colour) in sums.rgb.iter_mut().zip(rgb) {
        let sum = &mut sum[block];
        weight.mul_add(colour, f32x16::load_array_ref(simd, sum)).store_array(sum);
    }
}

/// Where 16 pixels look. What the lens does not see looks ahead: it is masked when the image is done.
fn directions(
    view: &View,
    sky_from_world: DMat3,
    x_px: &[f32; LANES],
    y_px: &[f32; LANES],
) -> [[f32; LANES]; 3] {
    let mut away = [0.0, 0.0, 1.0].map(|axis| [axis; LANES]);
    for lane in 0..LANES {
        let at_px = DVec2::new(f64::from(x_px[lane]), f64::from(y_px[lane]));
        if let Some(ray) = view.ray_world(at_px) {
            for (axis, value) in (sky_from_world * ray).to_array().into_iter().enumerate() {
                away[axis][lane] = value as f32;
            }
        }
    }
    away
}

/// The colours of a cube map towards directions of any length: as [`CubeMap::rgb`].
#[inline(always)]
fn look_up<S: Simd>(simd: S, map: &Arc<CubeMap>, away: Vec3x16<S>) -> [f32x16<S>; 3] {
    let splat = |value: f32| f32x16::splat(simd, value);
    let Vec3x16 { x, y, z } = away;
    let (ax, ay, az) = (x.abs(), y.abs(), z.abs());
    let is_x = ax.simd_ge(ay) & ax.simd_ge(az);
    let is_y = ay.simd_ge(az);
    let zero = splat(0.0);
    let (east, north, up) = (x.simd_ge(zero), y.simd_ge(zero), z.simd_ge(zero));
    // Face, and what is right and down in it.
    let of_x = [east.select(zero, splat(1.0)), east.select(-z, z), -y, ax];
    let of_y = [north.select(splat(2.0), splat(3.0)), x, north.select(z, -z), ay];
    let of_z = [up.select(splat(4.0), splat(5.0)), up.select(x, -x), -y, az];
    let choose = |k: usize| is_x.select(of_x[k], is_y.select(of_y[k], of_z[k]));
    let [face, right, down, ahead] = [choose(0), choose(1), choose(2), choose(3)];

    let [scale, offset] = map.lookup_scale_offset();
    let (half, middle) = (splat(0.5 * scale as f32), splat((0.5 * scale + offset) as f32));
    let (u, v) = ((right / ahead).mul_add(half, middle), (down / ahead).mul_add(half, middle));
    let last = splat(map.edge() as f32 - 2.0);
    let (column, row) = (u.floor().max(zero).min(last), v.floor().max(zero).min(last));
    let (fu, fv) = (u - column, v - row);
    let edge = map.edge();
    let (face, row, column): (i32x16<S>, i32x16<S>, i32x16<S>) =
        (face.to_int(), row.to_int(), column.to_int());
    let place = ((face * edge as i32 + row) * edge as i32 + column).to_array();

    let (mut red_green, mut blue) = ([[0; LANES]; 4], [[0; LANES]; 4]);
    let texels = map.texels();
    for lane in 0..LANES {
        let at = place[lane] as usize;
        for (corner, beside) in [0, 1, edge, edge + 1].into_iter().enumerate() {
            [red_green[corner][lane], blue[corner][lane]] = texels[at + beside];
        }
    }
    let mut rgb = [zero; 3];
    for (c, rgb) in rgb.iter_mut().enumerate() {
        let mut corners = [zero; 4];
        for k in 0..4 {
            let bits = u32x16::load_array_ref(simd, if c < 2 { &red_green[k] } else { &blue[k] });
            let value = if c == 1 { bits >> 16 } else { bits & 0xFFFF };
            corners[k] = value.to_float();
        }
        let [a, b, c, d] = corners;
        let upper = (b - a).mul_add(fu, a);
        let lower = (d - c).mul_add(fu, c);
        *rgb = (lower - upper).mul_add(fv, upper) * splat(1.0 / 65_535.0);
    }
    rgb
}
