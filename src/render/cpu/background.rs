//! The background of a frame (sky or one colour), added where it is visible through the Gaussians:
//! the first part of stage resolve, for frames that have one.
//!
//! **Every backend omits the background where less than 1/255 of it is visible.** It would add at
//! most one step of 8 bits, and most pixels of a street are of this kind. Alpha remains that of the
//! Gaussians. A background of one colour is treated as a sky of one colour.

use std::sync::Arc;

use fearless_simd::{f32x16, i32x16, prelude::*, u32x16};
use glam::{DMat3, DVec2};

use super::lanes::Vec3x16;
use super::lens::LensRays;
use super::resolve::{TilePixels, TileSums, block_corner};
use crate::constants::BLOCK_PX;
use crate::{Frame, RenderError, View};
use wildcity_scene::chunk::LANES;
use wildcity_scene::sky::{CubeMap, DrawableSky, SKY_CUT, Scratch};

/// The background of one view.
#[derive(Debug)]
pub(super) struct Background {
    sky: DrawableSky,
    rays: PixelRays,
}

/// Viewing directions of a view's pixels, in the sky's axes.
#[derive(Debug)]
enum PixelRays {
    /// Static pinhole: rows that take `(x, y, 1)` in pixels to a direction of any length.
    Pinhole([[f32; 3]; 3]),
    /// A pinhole in motion or behind a windshield, or a lens that is round about its axis: 16 at a
    /// time.
    Lens(LensRays),
    /// Any other camera: pixel by pixel in f64.
    PerPixel(Box<PerPixelRays>),
}

#[derive(Debug)]
struct PerPixelRays {
    view: View,
    sky_from_world: DMat3,
}

impl Background {
    /// The background of each view of a frame; empty if the frame has none.
    ///
    /// # Errors
    /// The sky cannot be evaluated as the profile asks.
    pub(super) fn from_frame(frame: &Frame<'_>) -> Result<Vec<Self>, RenderError> {
        let Some((sky, sky_from_world)) = frame.background()? else { return Ok(Vec::new()) };
        let of_view = |view: &View| {
            // From the cheapest form to the most general one.
            let rays = if view.is_static_pinhole() {
                PixelRays::Pinhole(view.sky_from_pixel(sky_from_world))
            } else if let Some(rays) = LensRays::new(view, sky_from_world) {
                PixelRays::Lens(rays)
            } else {
                PixelRays::PerPixel(Box::new(PerPixelRays { view: *view, sky_from_world }))
            };
            Self { sky: sky.clone(), rays }
        };
        Ok(frame.views.iter().map(of_view).collect())
    }

    /// Scratch memory for evaluating a sky network; `None` for a cube map.
    pub(super) fn scratch(&self) -> Option<Scratch> {
        match &self.sky {
            DrawableSky::Network(network) => Some(network.scratch()),
            DrawableSky::CubeMap(_) => None,
        }
    }

    /// Adds the background that is visible through the pixels of a tile.
    #[inline(always)]
    pub(super) fn add<S: Simd>(
        &self,
        simd: S,
        pixels: &TilePixels,
        scratch: &mut Option<Scratch>,
        sums: &mut TileSums,
    ) {
        for &block in pixels.blocks {
            self.add_to_block(simd, pixels.at_px, block, scratch, sums);
        }
    }

    #[inline(always)]
    fn add_to_block<S: Simd>(
        &self,
        simd: S,
        at_px: [u32; 2],
        block: usize,
        scratch: &mut Option<Scratch>,
        sums: &mut TileSums,
    ) {
        let splat = |value: f32| f32x16::splat(simd, value);
        let transmittance = f32x16::load_array_ref(simd, &sums.transmittance[block]);
        let shows = transmittance.simd_ge(splat(SKY_CUT as f32));
        // Most blocks of a street end here, before any direction is computed.
        if shows.all_false() {
            return;
        }

        // Directions of the block's pixel centres.
        let edge = BLOCK_PX;
        let [left, top] = block_corner(block);
        let x = f32x16::from_fn(simd, |lane| (at_px[0] + left + lane as u32 % edge) as f32 + 0.5);
        let y = f32x16::from_fn(simd, |lane| (at_px[1] + top + lane as u32 / edge) as f32 + 0.5);
        let direction = match &self.rays {
            PixelRays::Pinhole([first, second, third]) => {
                let row = |[a, b, c]: [f32; 3]| x.mul_add(splat(a), y.mul_add(splat(b), splat(c)));
                Vec3x16 { x: row(*first), y: row(*second), z: row(*third) }
            }
            PixelRays::Lens(rays) => rays.directions(simd, x, y),
            PixelRays::PerPixel(rays) => {
                let [x, y, z] = rays.directions(&x.to_array(), &y.to_array());
                let load = |values| f32x16::load_array_ref(simd, values);
                Vec3x16 { x: load(&x), y: load(&y), z: load(&z) }
            }
        };

        // Colours of the sky in these directions, weighted by the remaining transmittance.
        let rgb = match (&self.sky, scratch) {
            (DrawableSky::CubeMap(map), _) => sample_cube_map(simd, map, direction),
            (DrawableSky::Network(network), Some(scratch)) => {
                let unit = direction.scale(splat(1.0) / direction.dot(direction).sqrt());
                let rgb = network.rgb(simd, [unit.x, unit.y, unit.z], scratch);
                let Vec3x16 { x, y, z } = Vec3x16::from_arrays(simd, &rgb);
                [x, y, z]
            }
            // `scratch` is made for every network.
            (DrawableSky::Network(_), None) => return,
        };
        // Pixels of the block below the cut get nothing, as if their block had been skipped.
        let weight = shows.select(transmittance, splat(0.0));
        for (sum, color) in sums.rgb.iter_mut().zip(rgb) {
            let sum = &mut sum[block];
            weight.mul_add(color, f32x16::load_array_ref(simd, sum)).store_array(sum);
        }
    }
}

impl PerPixelRays {
    /// Directions of 16 pixels. A pixel outside of the lens' field gets +z; it is masked when the
    /// image is complete.
    fn directions(&self, x_px: &[f32; LANES], y_px: &[f32; LANES]) -> [[f32; LANES]; 3] {
        let mut directions = [0.0, 0.0, 1.0].map(|axis| [axis; LANES]);
        for lane in 0..LANES {
            let at_px = DVec2::new(f64::from(x_px[lane]), f64::from(y_px[lane]));
            if let Some(ray) = self.view.ray_world(at_px) {
                // In f64 up to here, since only the direction itself fits f32 without a loss.
                for (axis, value) in (self.sky_from_world * ray).to_array().into_iter().enumerate()
                {
                    directions[axis][lane] = value as f32;
                }
            }
        }
        directions
    }
}

/// The colours of a cube map in directions of any length, by bilinear interpolation: as
/// [`CubeMap::rgb`].
#[inline(always)]
fn sample_cube_map<S: Simd>(simd: S, map: &Arc<CubeMap>, direction: Vec3x16<S>) -> [f32x16<S>; 3] {
    let splat = |value: f32| f32x16::splat(simd, value);

    // The face: the axis with the largest magnitude, and its sign. With each face number, the
    // coordinates right and down in it, and the magnitude ahead.
    let Vec3x16 { x, y, z } = direction;
    let ax = x.abs();
    let ay = y.abs();
    let az = z.abs();
    // Ties go to x, then to y: every direction has exactly one face. `is_y` counts only where
    // `is_x` is false.
    let is_x = ax.simd_ge(ay) & ax.simd_ge(az);
    let is_y = ay.simd_ge(az);
    let zero = splat(0.0);
    let positive_x = x.simd_ge(zero);
    let positive_y = y.simd_ge(zero);
    let positive_z = z.simd_ge(zero);
    let of_x = [positive_x.select(zero, splat(1.0)), positive_x.select(-z, z), -y, ax];
    let of_y = [positive_y.select(splat(2.0), splat(3.0)), x, positive_y.select(z, -z), ay];
    let of_z = [positive_z.select(splat(4.0), splat(5.0)), positive_z.select(x, -x), -y, az];
    let choose = |k: usize| is_x.select(of_x[k], is_y.select(of_y[k], of_z[k]));
    let face = choose(0);
    let right = choose(1);
    let down = choose(2);
    let ahead = choose(3);

    // The cell of texels, and the place within it.
    let [scale, offset] = map.lookup_scale_offset();
    let half = splat(0.5 * scale as f32);
    let middle = splat((0.5 * scale + offset) as f32);
    let u = (right / ahead).mul_add(half, middle);
    let v = (down / ahead).mul_add(half, middle);
    // A cell needs the texel to the right and the one below, so the last cell begins one before the
    // last texel. The clamp also bounds the indices of the gather below.
    let last = splat(map.edge() as f32 - 2.0);
    let column = u.floor().max(zero).min(last);
    let row = v.floor().max(zero).min(last);
    let fu = u - column;
    let fv = v - row;
    let edge = map.edge();
    let face: i32x16<S> = face.to_int();
    let row: i32x16<S> = row.to_int();
    let column: i32x16<S> = column.to_int();
    let place = ((face * edge as i32 + row) * edge as i32 + column).to_array();

    // Gather the four texels: red and green in one word of 16 bits each, blue in another.
    let mut red_green = [[0; LANES]; 4];
    let mut blue = [[0; LANES]; 4];
    let texels = map.texels();
    for lane in 0..LANES {
        let at = place[lane] as usize;
        for (corner, step) in [0, 1, edge, edge + 1].into_iter().enumerate() {
            [red_green[corner][lane], blue[corner][lane]] = texels[at + step];
        }
    }

    // Interpolate each channel.
    let mut rgb = [zero; 3];
    for (c, rgb) in rgb.iter_mut().enumerate() {
        let mut corners = [zero; 4];
        for k in 0..4 {
            // Red is the lower half of the first word, green its upper half, blue the lower
            // half of the second.
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
