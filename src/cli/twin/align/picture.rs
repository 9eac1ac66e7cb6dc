//! A twin before and after an alignment: a slice from the side, and all of it from above, each with
//! a caption.

use std::io::Cursor;

use glam::{DVec2, DVec3};
use image::{ImageFormat, Rgb, RgbImage};

use wildcity_render::View;
use wildcity_render::compare::images::{render_images, view_along};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::align::Alignment;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::cli::caption;

/// Size of one of the four pictures, in pixels.
const SIZE_PX: [u32; 2] = [720, 440];
const GAP_PX: u32 = 6;
/// Share of Gaussians on each side of each axis that are left out: the sky and floaters.
const LEFT_OUT: f64 = 0.02;
/// Share of the scene's depth that the side view shows.
const SLICE: f64 = 0.25;
/// Distance of the camera, as a multiple of the scene's half size: nearly parallel rays.
const AWAY: f64 = 12.0;
/// Largest number of Gaussians of a picture; if there are more, every n-th is drawn.
const MOST: usize = 2_000_000;
/// Colour of the ground's grid.
const GRID: Rgb<u8> = Rgb([255, 96, 32]);
/// Largest number of lines of the grid in each direction.
const LINES: f64 = 24.0;
/// What the pictures show, row by row. Before the alignment the axes are those of the capture.
const CAPTIONS: [[&str; 2]; 2] = [
    ["before: along y, z upwards", "before: against z, y upwards"],
    ["after: from the south, up is up", "after: from above, north is up"],
];

/// Middle and half size of most of a scene.
#[derive(Clone, Copy, Debug)]
struct Extent {
    middle: DVec3,
    half: DVec3,
}

/// Draws the twin before and after, as a PNG. Also returns the distance of the grid's lines, in
/// metres.
pub(super) fn before_and_after(
    gaussians: Gaussians,
    alignment: &Alignment,
    profile: RenderProfile,
) -> anyhow::Result<(Vec<u8>, f64)> {
    // Every n-th and not the first ones: cells are stored one after the other.
    let stride = gaussians.len().div_ceil(MOST).max(1);
    let before = match stride {
        1 => gaussians,
        _ => gaussians.select((0..gaussians.len()).step_by(stride)),
    };
    let mut after = before.clone();
    alignment.apply(&mut after);
    let aligned = Extent::from_gaussians(&after);
    let step_m = grid_step(&aligned);
    let grid = grid(&aligned, step_m);
    let old = |at_m: DVec3| {
        let new_from_old = alignment.new_from_old;
        // An alignment moves first and scales then: it is undone in the other order.
        new_from_old.inverse().transform_point(at_m / alignment.metres_per_unit)
    };
    let old_grid: Vec<[DVec3; 2]> = grid.iter().map(|line| line.map(old)).collect();

    // From far away: with a reach, nothing would be drawn.
    let profile = RenderProfile { background: [0.05, 0.06, 0.07], reach_m: None, ..profile };
    let [width, height] = SIZE_PX;
    let mut all = RgbImage::new(2 * width + GAP_PX, 2 * height + GAP_PX);
    let rows = [(&before, Extent::from_gaussians(&before), &old_grid), (&after, aligned, &grid)];
    for (row, (shown, extent, grid)) in rows.into_iter().enumerate() {
        for (column, is_side) in [true, false].into_iter().enumerate() {
            let picture = draw(shown, &extent, is_side, &profile, grid)?;
            let x = column as u32 * (width + GAP_PX);
            let y = row as u32 * (height + GAP_PX);
            image::imageops::replace(&mut all, &picture, x.into(), y.into());
            caption::draw(&mut all, CAPTIONS[row][column], [x, y]);
        }
    }
    let mut png = Cursor::new(Vec::new());
    all.write_to(&mut png, ImageFormat::Png)?;
    Ok((png.into_inner(), step_m))
}

impl Extent {
    /// The extent of all Gaussians but the outermost.
    fn from_gaussians(gaussians: &Gaussians) -> Self {
        let ends = [0, 1, 2].map(|axis| {
            let mut values: Vec<f64> = gaussians.means_m.iter().map(|mean| mean[axis]).collect();
            let last = values.len().saturating_sub(1);
            let skipped = (last as f64 * LEFT_OUT) as usize;
            // Only two of the values are needed: selecting is linear, and sorting is not.
            let mut end = |at: usize| *values.select_nth_unstable_by(at, f64::total_cmp).1;
            [end(skipped), end(last - skipped)]
        });
        let low = DVec3::from_array(ends.map(|[low, _]| low));
        let high = DVec3::from_array(ends.map(|[_, high]| high));
        // A flat twin has a height of 0, by which `view` would divide.
        let least = 1e-3 * (high - low).max_element().max(1e-6);
        Self { middle: 0.5 * (low + high), half: (0.55 * (high - low)).max(DVec3::splat(least)) }
    }

    fn has(&self, at: DVec3) -> bool {
        (at - self.middle).abs().cmple(self.half).all()
    }
}

/// Distance of the grid's lines: 1, 2 or 5 times a power of ten.
fn grid_step(extent: &Extent) -> f64 {
    let size = 2.0 * extent.half.x.max(extent.half.y);
    let decade = 10.0_f64.powf((size / LINES).log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade).into_iter().find(|s| size / s <= LINES);
    step.unwrap_or(10.0 * decade)
}

/// Lines of the ground in the new axes, at whole steps.
fn grid(extent: &Extent, step: f64) -> Vec<[DVec3; 2]> {
    let low = extent.middle - extent.half;
    let high = extent.middle + extent.half;
    let whole = |from: f64, to: f64| {
        let first = (from / step).ceil() as i64;
        let last = (to / step).floor() as i64;
        (first..=last).map(move |n| n as f64 * step)
    };
    let along_y =
        whole(low.x, high.x).map(|x| [DVec3::new(x, low.y, 0.0), DVec3::new(x, high.y, 0.0)]);
    let along_x =
        whole(low.y, high.y).map(|y| [DVec3::new(low.x, y, 0.0), DVec3::new(high.x, y, 0.0)]);
    along_y.chain(along_x).collect()
}

fn draw(
    gaussians: &Gaussians,
    extent: &Extent,
    is_side: bool,
    profile: &RenderProfile,
    grid: &[[DVec3; 2]],
) -> anyhow::Result<RgbImage> {
    let mut shown = *extent;
    if is_side {
        // From the side, what stands in front would hide the middle: only a slice is drawn.
        shown.half.y *= SLICE;
    }
    let is_shown = |&i: &usize| shown.has(DVec3::from_array(gaussians.means_m[i]));
    let scene = Scene::from_gaussians(&gaussians.select((0..gaussians.len()).filter(is_shown)));
    let view = view(extent, is_side);
    let rendered = render_images(&Cpu::new(0, Simd::Best)?, &scene, profile, &[view])?.remove(0);
    let [width, height] = SIZE_PX;
    let mut picture = RgbImage::from_raw(width, height, rendered.rgb8)
        .ok_or_else(|| anyhow::anyhow!("an image has another size"))?;
    for [from, to] in grid {
        line(&mut picture, &view, *from, *to);
    }
    Ok(picture)
}

/// The view from the south, or from above with north at the top.
fn view(extent: &Extent, is_side: bool) -> View {
    let Extent { middle, half } = *extent;
    let [width, height] = SIZE_PX.map(f64::from);
    let [forward, down] =
        if is_side { [DVec3::Y, DVec3::NEG_Z] } else { [DVec3::NEG_Z, DVec3::NEG_Y] };
    let across = half.x;
    let upwards = if is_side { half.z } else { half.y };
    // Far compared with the size, so that perspective hardly bends parallel lines.
    let away = AWAY * half.max_element();
    // A half of the scene then takes 0.47 of the picture, which leaves a margin of 3 % at each
    // side.
    let focal_px = 0.47 * away * (width / across).min(height / upwards);
    view_along(SIZE_PX, focal_px, middle - away * forward, forward, down)
}

/// Draws a line of the ground over the picture, half transparent.
fn line(picture: &mut RgbImage, view: &View, from: DVec3, to: DVec3) {
    let ends_px = view.project_world(from).zip(view.project_world(to));
    let Some((from, to)) = ends_px else { return };
    // One step a pixel; the bound is for lines of which an end projects far outside.
    let steps = (to - from).abs().max_element().ceil().clamp(1.0, 4_000.0);
    for step in 0..=steps as u32 {
        let at: DVec2 = from.lerp(to, f64::from(step) / steps);
        let is_inside = at.cmpge(DVec2::ZERO).all()
            && at.x < f64::from(picture.width())
            && at.y < f64::from(picture.height());
        if is_inside {
            let pixel = picture.get_pixel_mut(at.x as u32, at.y as u32);
            for (channel, grid) in pixel.0.iter_mut().zip(GRID.0) {
                // Half transparent; in u16, because the sum of two u8 can overflow.
                *channel = ((u16::from(*channel) + u16::from(grid)) / 2) as u8;
            }
        }
    }
}
