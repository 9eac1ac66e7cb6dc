//! The warp of references into a view.

use std::sync::Arc;

use fearless_simd::{Level, dispatch};
use glam::{DMat3, DVec2};

use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::geometry::{Camera, Pose};

use super::lanes::LANES;
use super::projection::{Points, Projection};
use super::rays::Rays;
use crate::image::Image;

/// A reference fits where its depth differs from the point's by at most this, in metres, plus
/// [`DEPTH_SHARE`].
const DEPTH_M: f32 = 0.2;

/// See [`DEPTH_M`], as a share of the point's depth.
const DEPTH_SHARE: f32 = 0.05;

/// Distance between the pixels of the view that [`overlaps`] tests.
const OVERLAP_STRIDE: usize = 16;

/// A recorded image, or a rendered image that replaces it.
#[derive(Debug)]
pub struct Reference {
    pub image: Image,
    /// The depth of the scene at its pose, by [`super::opaque_depth`]: metres, 0 where there is
    /// none.
    pub depth_m: Vec<f32>,
    pub projection: Arc<Projection>,
    /// The pose at which it was recorded.
    pub world_from_camera: Pose,
}

impl Reference {
    /// Memory that it takes, in bytes, without the table of its lens.
    pub fn bytes(&self) -> u64 {
        (self.image.rgb8.len() + 4 * self.depth_m.len()) as u64
    }
}

/// The view into which references are warped.
#[derive(Clone, Copy, Debug)]
pub struct WarpTarget<'a> {
    pub camera: &'a Camera,
    /// The rays of that camera.
    pub rays: &'a Rays,
    /// Its pose at the end of the exposure.
    pub world_from_camera: Pose,
    /// The pose at the start of the exposure, and the order in which rows or columns are exposed,
    /// if the camera moves meanwhile.
    pub shutter: Option<(ShutterDirection, Pose)>,
    /// Its rendered depth, by [`super::opaque_depth`].
    pub depth_m: &'a [f32],
}

/// References that are warped into a view.
#[derive(Clone, Debug, PartialEq)]
pub struct Warped {
    /// Black where nothing is valid.
    pub image: Image,
    /// 1 where a reference fits, else 0.
    pub valid: Vec<f32>,
    /// Number of pixels from each reference.
    pub pixels: Vec<usize>,
}

/// A reference, and the transforms from the view to it: per group of pixels of one pose, rows of a
/// rotation and a translation in metres.
struct Prepared<'a> {
    /// Index in the caller's list.
    index: usize,
    reference: &'a Reference,
    from_target: Vec<[f32; 12]>,
}

/// The groups of pixels that have their own pose.
#[derive(Clone, Copy)]
enum Groups {
    All,
    Rows,
    /// [`LANES`] pixels of a row. During their exposure, a camera at 30 m/s moves by 2 mm.
    Columns,
}

/// The references in a view. Among those that fit equally well, the nearest counts, then the first
/// in the list.
///
/// `depth_m` and the images must have the sizes of their cameras; missing values count as no depth.
pub fn warp(target: &WarpTarget<'_>, references: &[Arc<Reference>]) -> Warped {
    let width = target.camera.width_px as usize;
    let height = target.camera.height_px as usize;
    let mut warped = Warped {
        image: Image { width, height, rgb8: vec![0; 3 * width * height] },
        valid: vec![0.0; width * height],
        pixels: vec![0; references.len()],
    };
    let (groups, poses) = poses(target);
    // A wrong length would be read out of bounds, or as another pixel.
    let usable = |reference: &&Arc<Reference>| {
        let pixels = reference.projection.width * reference.projection.height;
        reference.depth_m.len() == pixels && reference.image.rgb8.len() == 3 * pixels
    };
    if target.depth_m.len() != width * height || !references.iter().all(|one| usable(&one)) {
        return warped;
    }
    // Per reference and pose once, in f64; the rows below then use f32.
    let prepare = |reference: &'_ Arc<Reference>| -> Vec<[f32; 12]> {
        poses.iter().map(|pose| relative(&reference.world_from_camera, pose)).collect()
    };
    let mut prepared: Vec<Prepared<'_>> = references
        .iter()
        .enumerate()
        .map(|(index, reference)| Prepared { index, reference, from_target: prepare(reference) })
        .collect();
    // Test far references first. Most are behind the view, and the farther away they are, the
    // smaller is the angle. So most pixels soon have their best reference, and later references are
    // rejected without reading their depth. Of equal angles the last reference counts, which is the
    // nearest.
    let distance_m = |one: &Prepared<'_>| {
        one.reference.world_from_camera.position_m.distance(target.world_from_camera.position_m)
    };
    prepared.sort_by(|a, b| distance_m(a).total_cmp(&distance_m(b)));
    prepared.reverse();
    dispatch!(Level::new(), _ => rows(target, groups, &prepared, &mut warped));
    warped
}

/// Whether a reference can show a part of a view: whether a point of a coarse grid of the view's
/// pixels is within the image of a camera at a pose. Only such references are rendered.
pub fn overlaps(target: &WarpTarget<'_>, camera: &Camera, world_from_camera: &Pose) -> bool {
    let width = target.camera.width_px as usize;
    let height = target.camera.height_px as usize;
    if target.depth_m.len() != width * height {
        return false;
    }
    let camera_from_world = world_from_camera.inverse();
    // The middle of the first square, or of a smaller image.
    let first = |side: usize| OVERLAP_STRIDE.min(side) / 2;
    (first(height)..height).step_by(OVERLAP_STRIDE).any(|row| {
        (first(width)..width).step_by(OVERLAP_STRIDE).any(|column| {
            let depth_m = f64::from(target.depth_m[row * width + column]);
            let at_px = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            // A depth of 0 is the sky, which no reference shows at a known place.
            let Some(ray) = target.camera.unproject(at_px).filter(|_| depth_m > 0.0) else {
                return false;
            };
            let point_m = ray * (depth_m / target.camera.depth_m(ray));
            // With the pose at the end of the exposure: a test of overlap needs no shutter.
            let point_m = target.world_from_camera.transform_point(point_m);
            let at = camera.project(camera_from_world.transform_point(point_m));
            at.is_some_and(|at| at.cmpge(DVec2::ZERO).all() && at.cmplt(camera.size_px()).all())
        })
    })
}

/// The poses of a view: one for all pixels, or one per group.
fn poses(target: &WarpTarget<'_>) -> (Groups, Vec<Pose>) {
    let last = target.world_from_camera;
    let Some((direction, first)) = target.shutter else { return (Groups::All, vec![last]) };
    let size_px = target.camera.size_px();
    let at = |at_px: DVec2| first.interpolate(&last, direction.fraction(at_px, target.camera));
    match direction {
        ShutterDirection::TopToBottom | ShutterDirection::BottomToTop => {
            // The moment depends on the row only: any column will do.
            let row = |row: u32| at(DVec2::new(0.5 * size_px.x, f64::from(row) + 0.5));
            (Groups::Rows, (0..target.camera.height_px).map(row).collect())
        }
        ShutterDirection::LeftToRight | ShutterDirection::RightToLeft => {
            let count = (target.camera.width_px as usize).div_ceil(LANES);
            let middle =
                |group: usize| ((group * LANES) as f64 + 0.5 * LANES as f64).min(size_px.x);
            let group = |group: usize| at(DVec2::new(middle(group), 0.5 * size_px.y));
            (Groups::Columns, (0..count).map(group).collect())
        }
    }
}

/// Rows of the rotation from the axes of a view to those of a reference, and the view's place
/// there, in metres.
fn relative(reference: &Pose, target: &Pose) -> [f32; 12] {
    let back = reference.rotation.inverse();
    // The columns of the transpose are the rows of the matrix.
    let rows = DMat3::from_quat(back * target.rotation).transpose().to_cols_array();
    // The difference first, in f64: positions are large, and their difference is some metres.
    let offset = back * (target.position_m - reference.position_m);
    let mut values = [0.0; 12];
    for (value, exact) in values.iter_mut().zip(rows.into_iter().chain(offset.to_array())) {
        *value = exact as f32;
    }
    values
}

/// The best reference of each lane until now.
struct Best {
    /// Cosine of the angle between the rays, times the distance from the view's camera.
    similarity: [f32; LANES],
    reference: [usize; LANES],
    u: [f32; LANES],
    v: [f32; LANES],
}

const NONE: usize = usize::MAX;

#[inline(always)]
fn rows(target: &WarpTarget<'_>, groups: Groups, references: &[Prepared<'_>], warped: &mut Warped) {
    let width = warped.image.width;
    for row in 0..warped.image.height {
        for group in 0..width.div_ceil(LANES) {
            let left = group * LANES;
            let count = LANES.min(width - left);
            let first = row * width + left;
            let mut depth_m = [0.0; LANES];
            depth_m[..count].copy_from_slice(&target.depth_m[first..first + count]);
            // Sky, in many groups of a street.
            if !depth_m.iter().any(|depth_m| *depth_m > 0.0) {
                continue;
            }
            let pose = match groups {
                Groups::All => 0,
                Groups::Rows => row,
                Groups::Columns => group,
            };
            let best = best(target, references, [row, left, pose], &depth_m);
            for lane in 0..count {
                // `NONE` is no index of the list.
                let Some(Prepared { index, reference, .. }) = references.get(best.reference[lane])
                else {
                    continue;
                };
                let rgb = bilinear(&reference.image, best.u[lane], best.v[lane]);
                warped.image.rgb8[3 * (first + lane)..][..3].copy_from_slice(&rgb);
                warped.valid[first + lane] = 1.0;
                warped.pixels[*index] += 1;
            }
        }
    }
}

/// The best reference of the pixels of a row from a column on, at depths in metres.
#[inline(always)]
fn best(
    target: &WarpTarget<'_>,
    references: &[Prepared<'_>],
    [row, left, pose]: [usize; 3],
    depth_m: &[f32; LANES],
) -> Best {
    let from = target.rays.points(target.camera.width_px as usize, row, left, depth_m);
    let mut best = Best {
        similarity: [f32::NEG_INFINITY; LANES],
        reference: [NONE; LANES],
        u: [0.0; LANES],
        v: [0.0; LANES],
    };
    for (place, Prepared { reference, from_target, .. }) in references.iter().enumerate() {
        let m = &from_target[pose];
        let zero = [0.0; LANES];
        let mut points = Points { x: zero, y: zero, z: zero, distance: zero };
        let mut similarity = zero;
        for (lane, similarity) in similarity.iter_mut().enumerate() {
            let x = from.x[lane];
            let y = from.y[lane];
            let z = from.z[lane];
            // The ray from the view's camera in the reference's axes, and the point there.
            let ray_x = m[0] * x + m[1] * y + m[2] * z;
            let ray_y = m[3] * x + m[4] * y + m[5] * z;
            let ray_z = m[6] * x + m[7] * y + m[8] * z;
            let point_x = ray_x + m[9];
            let point_y = ray_y + m[10];
            let point_z = ray_z + m[11];
            let squared = point_x * point_x + point_y * point_y + point_z * point_z;
            let distance = squared.sqrt();
            // Both rays in the reference's axes: |ray| |point| cos. |ray| is the same for
            // all references.
            let dot = ray_x * point_x + ray_y * point_y + ray_z * point_z;
            points.x[lane] = point_x;
            points.y[lane] = point_y;
            points.z[lane] = point_z;
            points.distance[lane] = distance;
            *similarity = dot / distance;
        }
        let mut is_candidate = [false; LANES];
        // Without a branch per lane, so that it becomes a vector comparison.
        for (lane, is_candidate) in is_candidate.iter_mut().enumerate() {
            // Comparisons with NaN are false.
            // `>=`, so that of equal references the later one, which is nearer, counts.
            *is_candidate = (similarity[lane] >= best.similarity[lane]) & (depth_m[lane] > 0.0);
        }
        if !is_candidate.contains(&true) {
            continue;
        }
        let projection = &*reference.projection;
        // Only candidates: a table is read for each of them.
        let at = projection.project(&points, &is_candidate);
        let size = [projection.width as f32, projection.height as f32];
        for (lane, is_candidate) in is_candidate.iter_mut().enumerate() {
            *is_candidate &= (at.u[lane] >= 0.0)
                & (at.u[lane] < size[0])
                & (at.v[lane] >= 0.0)
                & (at.v[lane] < size[1]);
        }
        if !is_candidate.contains(&true) {
            continue;
        }
        for lane in (0..LANES).filter(|lane| is_candidate[*lane]) {
            // Within the image, as was just checked; the cast truncates to the pixel.
            let there = at.v[lane] as usize * projection.width + at.u[lane] as usize;
            let there_m = reference.depth_m[there];
            let here_m =
                if projection.depth_is_distance { points.distance[lane] } else { points.z[lane] };
            // Behind another surface the reference shows that surface, with another depth.
            let fits = (there_m - here_m).abs() <= DEPTH_M + DEPTH_SHARE * here_m;
            if fits && there_m > 0.0 {
                best.similarity[lane] = similarity[lane];
                best.reference[lane] = place;
                best.u[lane] = at.u[lane];
                best.v[lane] = at.v[lane];
            }
        }
    }
    best
}

/// The colour at a place of an image, in pixels, between its four nearest pixels.
#[inline(always)]
fn bilinear(image: &Image, u: f32, v: f32) -> [u8; 3] {
    // The first of two neighbours, and how near the second is.
    let along = |at: f32, side: usize| {
        // From pixels to centres of pixels; beyond the outermost centres the edge's colour goes on.
        let at = (at - 0.5).clamp(0.0, (side - 1) as f32);
        let low = (at as usize).min(side.saturating_sub(2));
        (low, at - low as f32)
    };
    let (left, x) = along(u, image.width);
    let (top, y) = along(v, image.height);
    let first = 3 * (top * image.width + left);
    // An image of one row or column has no second.
    let right = if image.width > 1 { 3 } else { 0 };
    let below = if image.height > 1 { 3 * image.width } else { 0 };
    let upper = &image.rgb8[first..first + right + 3];
    let lower = &image.rgb8[first + below..first + below + right + 3];
    [0, 1, 2].map(|channel| {
        let mix = |row: &[u8]| {
            let from = f32::from(row[channel]);
            from + x * (f32::from(row[right + channel]) - from)
        };
        let above = mix(upper);
        // Values are at least 0, so that adding 1/2 and truncating rounds.
        (above + y * (mix(lower) - above) + 0.5) as u8
    })
}
