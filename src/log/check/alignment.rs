//! LiDAR against the images of a camera: which points an image shows, at which difference of the
//! two clocks edges fit best, and whether the fit moves along the log.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use image::RgbImage;
use image::imageops::{self, FilterType};
use serde::Serialize;

use wildcity_scene::rig::RigCamera;

use super::OnProgress;
use super::edges::EdgeMap;
use super::projection::{Projection, RigPoint, rig_points};
use super::samples::{Sample, SampledImage, Samples, read_image};
use crate::error::LogError;
use crate::log::Log;
use crate::poses::Poses;

/// Images are compared at this width at most, in pixels.
const WIDTH_PX: u32 = 480;

/// Differences of the two clocks that are tried: every 5 ms up to 100 ms to both sides.
const STEP_US: i64 = 5_000;
const STEPS: i64 = 20;

/// Shifts of the points that are tried, in pixels of the shrunk image, to the left and right. Leaps
/// of the distance from one point of a laser to the next are edges from above to below, which tell
/// nothing of shifts up and down.
const SHIFT_PX: i32 = 8;

/// Edge points of an image that are compared.
const MOST_EDGES: usize = 4_000;

/// Points that a picture shows.
const MOST_POINTS: usize = 20_000;

/// The fit of the best difference must exceed that of all that are farther from it than [`SAME_MS`]
/// by this share, or nothing is known.
const LEAST_PEAK: f64 = 0.02;

/// The two halves of the images must give the same difference of the clocks to this, in
/// milliseconds, or it is chance.
const SAME_MS: f64 = 15.0;

/// With fewer images or points at edges, nothing is known.
const LEAST_IMAGES: usize = 6;
const LEAST_EDGES: usize = 1_000;

/// The fit of each part of a log must fall by this share at the best shift of the other part, or
/// nothing moved.
const LEAST_DRIFT: f64 = 0.1;

/// LiDAR against the images of a camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Alignment {
    pub camera: String,
    /// Images that were compared.
    pub images: usize,
    /// Points of the sweeps around them, within 80 m.
    pub points: usize,
    /// Share of these that an image shows.
    pub shown: f64,
    /// Points at edges, of those that an image shows.
    pub edges: usize,
    /// How late the times of the LiDAR are against the camera's, in milliseconds, if edges tell.
    pub lidar_late_ms: Option<f64>,
    /// How far the images move to the right against the points from the first to the last third of
    /// the log, in pixels of the camera's image, if edges tell that they do.
    pub drift_px: Option<f64>,
    /// The fit at each difference of the clocks: milliseconds, and edges at the points against the
    /// mean of the image.
    pub curve: Vec<[f64; 2]>,
}

/// The measures of all cameras.
pub(super) struct Compared {
    pub(super) alignment: Vec<Alignment>,
    pub(super) samples: Vec<SampledImage>,
}

/// Sums over the images of a camera.
#[derive(Default)]
struct Sums {
    images: usize,
    points: usize,
    shown: usize,
    edges: usize,
    /// Sum and number of the values at each difference of the clocks.
    /// They are those of every second image and of the others.
    late: [BTreeMap<i64, (f64, usize)>; 2],
    /// The same for each third of the log and each shift of the points.
    shifts: [BTreeMap<i32, (f64, usize)>; 3],
    /// Pixels of the camera's image for one of the shrunk one.
    scale: f64,
}

/// Compares the chosen images.
pub(super) fn compare(
    log: &Log,
    poses: &Poses,
    Samples { samples }: Samples,
    on_progress: OnProgress<'_>,
) -> Result<Compared, LogError> {
    let mut sums: BTreeMap<String, Sums> = BTreeMap::new();
    let mut pictures: BTreeMap<String, SampledImage> = BTreeMap::new();
    let all = samples.len();
    for (done, sample) in samples.iter().enumerate() {
        on_progress(done as u64, all as u64);
        let camera = &sample.image.camera;
        // `done` is less than `all`, so that this is 0, 1 or 2.
        let third = 3 * done / all;
        let mounted = &log.rig.cameras[log.camera_index(camera)?];
        let sums = sums.entry(camera.clone()).or_default();
        let picture = compare_image(log, poses, sample, mounted, third, sums)?;
        // The picture of a camera is that with the most points.
        let is_better = |other: &SampledImage| picture.points.len() > other.points.len();
        if pictures.get(camera).is_none_or(is_better) {
            pictures.insert(camera.clone(), picture);
        }
    }
    on_progress(all as u64, all as u64);
    let alignment = sums.into_iter().map(|(camera, sums)| sums.finish(camera)).collect();
    Ok(Compared { alignment, samples: pictures.into_values().collect() })
}

fn compare_image(
    log: &Log,
    poses: &Poses,
    sample: &Sample,
    mounted: &RigCamera,
    third: usize,
    sums: &mut Sums,
) -> Result<SampledImage, LogError> {
    let small = shrunk(log, sample)?;
    let projection = Projection { poses, mounted, time_us: sample.image.time_us };
    let scale = f64::from(small.width()) / f64::from(mounted.camera.width_px);
    sums.scale = 1.0 / scale;
    let edges = EdgeMap::new(&imageops::grayscale(&small));
    let mut picture = SampledImage {
        image: sample.image.clone(),
        size_px: [small.width(), small.height()],
        rgb8: small.into_raw(),
        points: Vec::new(),
    };
    let mut at_edges: Vec<RigPoint> = Vec::new();
    for row in &sample.sweeps {
        let points = rig_points(log, row)?;
        sums.points += points.len();
        for point in points {
            let world_m = point.world_m(poses, 0);
            let shown = world_m.and_then(|world_m| projection.project(world_m));
            let Some((at_px, range_m)) = shown else { continue };
            sums.shown += 1;
            if point.is_edge && at_edges.len() < MOST_EDGES {
                at_edges.push(point);
            }
            if picture.points.len() < MOST_POINTS {
                let [x, y] = (scale * at_px).as_vec2().to_array();
                picture.points.push([x, y, range_m as f32]);
            }
        }
    }
    sums.images += 1;
    sums.edges += at_edges.len();
    let fit = Fit { projection, edges: &edges, scale };
    sums.add_late(&fit, &at_edges);
    sums.add_shifts(&fit, &at_edges, third);
    Ok(picture)
}

/// The fit of points to the edges of one image.
struct Fit<'a> {
    projection: Projection<'a>,
    edges: &'a EdgeMap,
    /// Pixels of the shrunk image for one of the camera's.
    scale: f64,
}

impl Fit<'_> {
    fn place(&self, world_m: Option<DVec3>) -> Option<DVec2> {
        self.projection.project(world_m?).map(|(at_px, _)| self.scale * at_px)
    }
}

impl Sums {
    fn add_late(&mut self, fit: &Fit<'_>, points: &[RigPoint]) {
        for step in -STEPS..=STEPS {
            let late_us = step * STEP_US;
            let places = points.iter().map(|point| point.world_m(fit.projection.poses, late_us));
            let values = places.filter_map(|world_m| fit.edges.at(fit.place(world_m)?));
            // `images` has counted this image already: what matters is only that neighbours
            // alternate.
            let (sum, count) = self.late[self.images % 2].entry(late_us).or_default();
            for value in values {
                *sum += value;
                *count += 1;
            }
        }
    }

    fn add_shifts(&mut self, fit: &Fit<'_>, points: &[RigPoint], third: usize) {
        let places =
            points.iter().filter_map(|point| fit.place(point.world_m(fit.projection.poses, 0)));
        let places: Vec<DVec2> = places.collect();
        for shift in -SHIFT_PX..=SHIFT_PX {
            let moved = places.iter().map(|at_px| *at_px + DVec2::new(shift.into(), 0.0));
            let (sum, count) = self.shifts[third].entry(shift).or_default();
            for value in moved.filter_map(|at_px| fit.edges.at(at_px)) {
                *sum += value;
                *count += 1;
            }
        }
    }

    fn finish(self, camera: String) -> Alignment {
        // Two measurements that share no image: what only one of them shows is chance.
        let halves = [curve([&self.late[0]]), curve([&self.late[1]])];
        let whole = curve(&self.late);
        // The peak of a few points may be chance.
        let is_enough = self.images >= LEAST_IMAGES && self.edges >= LEAST_EDGES;
        let lidar_late_ms = peak(&whole).filter(|ms| is_enough && are_near(&halves, *ms));
        let [first, _, last] = self.shifts.map(|sums| fits(&sums));
        Alignment {
            camera,
            images: self.images,
            points: self.points,
            shown: self.shown as f64 / self.points.max(1) as f64,
            edges: self.edges,
            lidar_late_ms,
            drift_px: drift(&first, &last).filter(|_| is_enough).map(|px| px * self.scale),
            curve: whole,
        }
    }
}

/// The mean fit at each difference of the clocks, in milliseconds, of all sums together.
fn curve<'a>(parts: impl IntoIterator<Item = &'a BTreeMap<i64, (f64, usize)>>) -> Vec<[f64; 2]> {
    let mut sums: BTreeMap<i64, (f64, usize)> = BTreeMap::new();
    for (late_us, (sum, count)) in parts.into_iter().flatten() {
        let both = sums.entry(*late_us).or_default();
        both.0 += sum;
        both.1 += count;
    }
    sums.iter().map(|(us, sums)| [*us as f64 / 1e3, mean(sums)]).collect()
}

/// Whether the best differences of both halves are near one.
fn are_near(halves: &[Vec<[f64; 2]>; 2], late_ms: f64) -> bool {
    halves.iter().all(|curve| {
        let best = curve.iter().max_by(|a, b| a[1].total_cmp(&b[1]));
        best.is_some_and(|[ms, _]| (ms - late_ms).abs() <= SAME_MS)
    })
}

/// The place of the largest value of a curve, between its points; `None` if it is no clear peak or
/// at an end.
fn peak(curve: &[[f64; 2]]) -> Option<f64> {
    let best = (0..curve.len()).max_by(|a, b| curve[*a][1].total_cmp(&curve[*b][1]))?;
    // At an end of the curve the true peak may be beyond what was tried.
    let before = curve.get(best.checked_sub(1)?)?;
    let after = curve.get(best + 1)?;
    let [at, fit] = curve[best];
    // A fit that rises, falls or hardly changes has no peak, as that of a camera along the drive:
    // a difference of the clocks moves points far less in its images than in those of one to the
    // side.
    let is_clear = curve
        .iter()
        .all(|[ms, other]| (ms - at).abs() <= SAME_MS || fit > (1.0 + LEAST_PEAK) * other);
    let bend = before[1] + after[1] - 2.0 * fit;
    // The vertex of the parabola through the three points.
    let vertex = if bend < 0.0 { 0.5 * (before[1] - after[1]) / bend } else { 0.0 };
    is_clear.then_some(at + vertex * (after[0] - at))
}

/// The fit at each shift.
type Fits = BTreeMap<i32, f64>;

fn fits(sums: &BTreeMap<i32, (f64, usize)>) -> Fits {
    sums.iter().map(|(shift, sums)| (*shift, mean(sums))).collect()
}

fn mean((sum, count): &(f64, usize)) -> f64 {
    sum / (*count).max(1) as f64
}

/// The difference of the best shifts of two parts of a log; `None` if the best shift of one of them
/// fits the other nearly as well: then edges do not tell.
fn drift(first: &Fits, last: &Fits) -> Option<f64> {
    let best = |fits: &Fits| fits.iter().max_by(|a, b| a.1.total_cmp(b.1)).map(|(at, _)| *at);
    let from = best(first)?;
    let to = best(last)?;
    // At the border the best shift may be beyond it, and of few edges it often is.
    let is_known = from.abs().max(to.abs()) < SHIFT_PX;
    let is_clear = |fits: &Fits, own: i32, other: i32| {
        let least = fits.get(&other).map(|fit| (1.0 + LEAST_DRIFT) * fit);
        fits.get(&own) > least.as_ref()
    };
    let moved = is_known && is_clear(first, from, to) && is_clear(last, to, from);
    moved.then(|| f64::from(to - from))
}

/// The image of a sample, shrunk.
fn shrunk(log: &Log, sample: &Sample) -> Result<RgbImage, LogError> {
    let image = read_image(log, sample)?;
    let width = image.width().min(WIDTH_PX);
    // Rounded up, so that a very wide image keeps a row.
    let height = (u64::from(image.height()) * u64::from(width)).div_ceil(image.width().into());
    Ok(image.resize_exact(width, height as u32, FilterType::Triangle).into_rgb8())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_drift_if_each_part_fits_best_at_its_own_shift() {
        let fits = |at: i32, height: f64| -> Fits {
            let fit = |shift: i32| 1.0 + height / f64::from(1 + (shift - at).abs());
            (-SHIFT_PX..=SHIFT_PX).map(|shift| (shift, fit(shift))).collect()
        };
        assert_eq!(drift(&fits(0, 1.0), &fits(-4, 1.0)), Some(-4.0));
        assert_eq!(drift(&fits(0, 1.0), &fits(4, 0.05)), None, "flat");
        assert_eq!(drift(&fits(2, 1.0), &fits(2, 1.0)), None);
        assert_eq!(drift(&fits(0, 1.0), &fits(SHIFT_PX, 1.0)), None, "at the border");
        assert_eq!(drift(&Fits::new(), &fits(2, 1.0)), None);
    }

    #[test]
    fn a_peak_is_found_between_points_or_not_at_all() {
        let curve = |late_ms: f64, height: f64| -> Vec<[f64; 2]> {
            let at = |step: i32| 5.0 * f64::from(step);
            let fit = |ms: f64| 1.0 + height * (1.0 - ((ms - late_ms) / 50.0).powi(2));
            (-20..=20).map(|step| [at(step), fit(at(step))]).collect()
        };
        let found = peak(&curve(42.0, 0.5)).unwrap();
        assert!((found - 42.0).abs() < 1e-9, "{found}");
        assert_eq!(peak(&curve(200.0, 0.5)), None, "at an end");
        assert_eq!(peak(&curve(0.0, 1e-6)), None, "flat");
        assert_eq!(peak(&curve(-16.0, 0.03)), None, "0 fits as well to 0.3 %");
        assert_eq!(peak(&[]), None);
    }
}
