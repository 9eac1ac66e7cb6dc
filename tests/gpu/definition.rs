//! The definition of each stage in f64, as simple as possible: every tile and every pixel is tested
//! against every splat.

use glam::DVec2;
use wildcity_render::constants::{DEPTH_BITS, EXTENT_SLACK_PX, TILE_PX};
use wildcity_render::reference;
use wildcity_render::stage::StageOutputs;
use wildcity_render::{Frame, layout};
use wildcity_scene::geometry::Camera;

use crate::images::Image;

/// A splat of one view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Splat {
    pub(crate) view: usize,
    pub(crate) mean_px: [f64; 2],
    /// Half-size of the box in which alpha reaches alpha_cut, without slack, in pixels.
    pub(crate) reach_px: [f64; 2],
    pub(crate) factor: [f64; 3],
    pub(crate) log2_opacity: f64,
    pub(crate) rgb: [f64; 3],
    pub(crate) depth_m: f64,
}

impl Splat {
    fn from_backend(key: u32, splat: &layout::Splat) -> Self {
        let slack = f64::from(EXTENT_SLACK_PX);
        Self {
            view: (key >> DEPTH_BITS) as usize,
            mean_px: splat.mean_px.map(f64::from),
            reach_px: splat.extent_px.map(|extent| f64::from(extent) - slack),
            factor: splat.factor.map(f64::from),
            log2_opacity: splat.log2_opacity.into(),
            rgb: splat.rgb.map(f64::from),
            depth_m: splat.depth_m.into(),
        }
    }

    /// The Cholesky factor of `½ log2(e)` times the conic: `(l0 dx + l1 dy)² + (l2 dy)²`.
    fn from_reference(view: usize, splat: &reference::Splat) -> Self {
        let [xx, xy, yy] = (0.5 * std::f64::consts::LOG2_E * splat.conic).to_array();
        let l0 = xx.sqrt();
        Self {
            view,
            mean_px: splat.mean_px.to_array(),
            reach_px: splat.reach_px.to_array(),
            factor: [l0, xy / l0, ((xx * yy - xy * xy) / xx).sqrt()],
            log2_opacity: splat.opacity.log2(),
            rgb: splat.rgb.to_array(),
            depth_m: splat.depth_m,
        }
    }

    /// How far its box reaches inside the image beyond the pixel centres at the nearest edge, in
    /// pixels. Below 0 the splat is culled.
    pub(crate) fn inside_px(&self, camera: &Camera) -> f64 {
        let [width, height] = [camera.width_px, camera.height_px].map(f64::from);
        let axis = |k: usize, size: f64| {
            let low = self.mean_px[k] + self.reach_px[k] - 0.5;
            low.min(size - 0.5 - (self.mean_px[k] - self.reach_px[k]))
        };
        axis(0, width).min(axis(1, height))
    }

    /// Base-2 logarithm of alpha at a pixel's centre, before the cap.
    fn log2_alpha(&self, column: u32, row: u32) -> f64 {
        let [l0, l1, l2] = self.factor;
        let dx = f64::from(column) + 0.5 - self.mean_px[0];
        let dy = f64::from(row) + 0.5 - self.mean_px[1];
        self.log2_opacity - (l0 * dx + l1 * dy).powi(2) - (l2 * dy).powi(2)
    }
}

/// The splats that a backend's stage project wrote.
pub(crate) fn splats(between: &StageOutputs) -> Vec<Splat> {
    let pairs = between.keys.iter().zip(&between.splats);
    pairs.map(|(&key, splat)| Splat::from_backend(key, splat)).collect()
}

/// Stage project by numerical differentiation: all splats in order of (view, global id), including
/// those outside of the image.
pub(crate) fn project(frame: &Frame<'_>) -> Vec<Splat> {
    let mut all = Vec::new();
    for (index, view) in frame.views.iter().enumerate() {
        let splats = reference::project(frame.scene, frame.profile, view);
        all.extend(splats.iter().map(|splat| Splat::from_reference(index, splat)));
    }
    all
}

/// Stage sort: indices by (view, depth).
pub(crate) fn sort(splats: &[Splat]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..splats.len() as u32).collect();
    // Stable.
    order.sort_by(|&a, &b| {
        let (a, b) = (&splats[a as usize], &splats[b as usize]);
        a.view.cmp(&b.view).then(a.depth_m.total_cmp(&b.depth_m))
    });
    order
}

/// Stage bin: for every tile of all views, the splats that reach alpha_cut at a pixel's centre.
pub(crate) fn bin(splats: &[Splat], order: &[u32], frame: &Frame<'_>) -> Vec<Vec<u32>> {
    let cut = frame.profile.alpha_cut.log2();
    let mut tiles = Vec::new();
    for (index, view) in frame.views.iter().enumerate() {
        let Camera { width_px, height_px, .. } = view.camera;
        for top in (0..height_px).step_by(TILE_PX as usize) {
            for left in (0..width_px).step_by(TILE_PX as usize) {
                let rows = top..height_px.min(top + TILE_PX);
                let columns = left..width_px.min(left + TILE_PX);
                let touches = |splat_index: &&u32| {
                    let splat = &splats[**splat_index as usize];
                    let reaches =
                        |row| columns.clone().any(|column| splat.log2_alpha(column, row) >= cut);
                    splat.view == index && rows.clone().any(reaches)
                };
                tiles.push(order.iter().filter(touches).copied().collect());
            }
        }
    }
    tiles
}

/// Stages rasterize and resolve: every pixel against all splats of its view.
pub(crate) fn rasterize(splats: &[Splat], order: &[u32], frame: &Frame<'_>) -> Vec<Image> {
    let images = frame.views.iter().enumerate().map(|(index, view)| {
        let here: Vec<Splat> = order.iter().map(|&index| splats[index as usize]).collect();
        let here: Vec<Splat> = here.into_iter().filter(|splat| splat.view == index).collect();
        let mut image =
            Image { rgba: Vec::new(), rgb8: Vec::new(), depth_m: Vec::new(), opacity: Vec::new() };
        for row in 0..view.camera.height_px {
            for column in 0..view.camera.width_px {
                pixel(&here, &view.camera, [column, row], frame, &mut image);
            }
        }
        image
    });
    images.collect()
}

fn pixel(
    splats: &[Splat],
    camera: &Camera,
    [column, row]: [u32; 2],
    frame: &Frame<'_>,
    image: &mut Image,
) {
    let log2_cut = frame.profile.alpha_cut.log2();
    let at_px = DVec2::new(f64::from(column), f64::from(row)) + 0.5;
    // A pixel that the lens does not see is empty.
    let splats = camera.unproject(at_px).map_or(&[][..], |_| splats);
    let mut rgb = [0.0; 3];
    let mut depth_m = 0.0;
    let mut transmittance = 1.0;
    for splat in splats {
        let log2_alpha = splat.log2_alpha(column, row);
        if log2_alpha < log2_cut {
            continue;
        }
        let alpha = log2_alpha.exp2().min(frame.profile.alpha_cap);
        let after = transmittance * (1.0 - alpha);
        if after <= frame.profile.stop {
            break;
        }
        let weight = transmittance * alpha;
        for (sum, value) in rgb.iter_mut().zip(splat.rgb) {
            *sum += weight * value;
        }
        depth_m += weight * splat.depth_m;
        transmittance = after;
    }
    let opacity: f64 = 1.0 - transmittance;
    image.rgba.extend([rgb[0], rgb[1], rgb[2], opacity].map(|value| value as f32));
    image.rgb8.extend(rgb.map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8));
    image.depth_m.push(if opacity > 0.0 { (depth_m / opacity) as f32 } else { 0.0 });
    image.opacity.push(opacity as f32);
}
