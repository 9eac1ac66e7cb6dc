//! What is behind the Gaussians: a sky, or one colour. The first part of stage resolve, for twins that
//! have either; others skip it.

use std::sync::Arc;

use fearless_simd::{f32x16, i32x16, prelude::*, u32x16};
use glam::{DMat3, DVec3};

use super::lanes::Vec3x16;
use super::resolve::TileSums;
use crate::render::constants::BLOCK_PX;
use crate::render::{Frame, RenderError, View};
use crate::scene::chunk::LANES;
use crate::scene::sky::{CubeMap, Drawn, SKY_CUT, Scratch};

/// Blocks of a tile.
const BLOCKS: usize = 16;

/// What is behind the Gaussians of one view.
#[derive(Debug)]
pub(super) enum Behind {
    /// Black: nothing is added.
    Nothing,
    /// One colour, linear.
    Background([f32; 3]),
    /// A sky, and what takes `(x, y, 1)` in pixels to a direction in its axes, of any length: rows.
    Sky(Drawn, [[f32; 3]; 3]),
}

impl Behind {
    /// What is behind each view of a frame.
    ///
    /// # Errors
    /// The sky cannot be drawn as the profile asks.
    pub(super) fn of(frame: &Frame<'_>) -> Result<Vec<Self>, RenderError> {
        let of_view: Box<dyn Fn(&View) -> Self> = match &frame.scene.sky {
            Some(sky) => {
                let (drawn, axes) = (sky.drawn(frame.profile.sky_error)?, sky.sky_from_world());
                Box::new(move |view| Self::Sky(drawn.clone(), sky_from_pixel(axes, view)))
            }
            None if frame.profile.background == [0.0; 3] => Box::new(|_| Self::Nothing),
            None => {
                let rgb = frame.profile.background.map(|c| c as f32);
                Box::new(move |_| Self::Background(rgb))
            }
        };
        Ok(frame.views.iter().map(of_view).collect())
    }

    /// What evaluating a network needs, where one is evaluated.
    pub(super) fn scratch(&self) -> Option<Scratch> {
        match self {
            Self::Sky(Drawn::Exact(network), _) => Some(network.scratch()),
            _ => None,
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
        match self {
            Self::Nothing => {}
            Self::Background(rgb) => {
                for block in 0..BLOCKS {
                    let shows = f32x16::load_array_ref(simd, &sums.transmittance[block]);
                    add(simd, shows, rgb.map(|c| f32x16::splat(simd, c)), block, sums);
                }
            }
            Self::Sky(drawn, sky_from_pixel) => {
                for block in 0..BLOCKS {
                    add_sky(simd, (drawn, sky_from_pixel), at_px, block, scratch, sums);
                }
            }
        }
    }
}

/// Takes `(x, y, 1)` of a pinhole's image to a direction in the sky's axes. As directions matter only up
/// to their length, f32 is right to 1e-7 rad.
fn sky_from_pixel(sky_from_world: DMat3, view: &View) -> [[f32; 3]; 3] {
    let p = &view.camera.pinhole;
    let camera_from_pixel = DMat3::from_cols(
        DVec3::new(1.0 / p.fx, 0.0, 0.0),
        DVec3::new(0.0, 1.0 / p.fy, 0.0),
        DVec3::new(-p.cx / p.fx, -p.cy / p.fy, 1.0),
    );
    let world_from_camera = view.world_from_camera.rotation_matrix();
    let rows = (sky_from_world * world_from_camera * camera_from_pixel).transpose();
    rows.to_cols_array_2d().map(|row| row.map(|value| value as f32))
}

#[inline(always)]
fn add_sky<S: Simd>(
    simd: S,
    (drawn, sky_from_pixel): (&Drawn, &[[f32; 3]; 3]),
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
    let row = |[a, b, c]: [f32; 3]| x.mul_add(splat(a), y.mul_add(splat(b), splat(c)));
    let [first, second, third] = *sky_from_pixel;
    let away = Vec3x16 { x: row(first), y: row(second), z: row(third) };
    let rgb = match (drawn, scratch) {
        (Drawn::Map(map), _) => look_up(simd, map, away),
        (Drawn::Exact(network), Some(scratch)) => {
            let unit = away.scale(splat(1.0) / away.dot(away).sqrt());
            let rgb = network.rgb(simd, [unit.x, unit.y, unit.z], scratch);
            [0, 1, 2].map(|c: usize| f32x16::load_array_ref(simd, &rgb[c]))
        }
        // `scratch` is made for every network.
        (Drawn::Exact(_), None) => return,
    };
    add(simd, shows.select(transmittance, splat(0.0)), rgb, block, sums);
}

/// `sums += weight * rgb`.
#[inline(always)]
fn add<S: Simd>(
    simd: S,
    weight: f32x16<S>,
    rgb: [f32x16<S>; 3],
    block: usize,
    sums: &mut TileSums,
) {
    for (sum, colour) in sums.rgb.iter_mut().zip(rgb) {
        let sum = &mut sum[block];
        weight.mul_add(colour, f32x16::load_array_ref(simd, sum)).store_array(sum);
    }
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

    let [scale, offset] = map.look_up();
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
