//! What of its image a lens sees, and how far off the axis that is.

use glam::{DVec2, DVec3};

use super::{Camera, Lens, WIDEST_RAD};

/// The columns of each row that a lens sees, where it does not see all of its image.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldMask {
    /// First column and the one after the last, row by row; equal where nothing is seen.
    pub columns: Vec<[u32; 2]>,
}

impl FieldMask {
    /// `None` where the whole image is seen, as almost always; telling that costs some microseconds.
    ///
    /// A field has no holes, and neither has a row of it: every model's is a disc, slightly bent.
    pub fn of(camera: &Camera) -> Option<Self> {
        let sees = |column: u32, row: u32| {
            let at_px = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
            camera.unproject(at_px).is_some()
        };
        if camera.lens == Lens::Pinhole || border(camera).all(|[column, row]| sees(column, row)) {
            return None;
        }
        let middle = camera.pinhole.cx.clamp(0.0, f64::from(camera.width_px - 1)) as u32;
        let columns = (0..camera.height_px).map(|row| {
            // Some column of the row that is seen: the one at the axis, or the first of 64.
            let few = (0..64).map(|k| (u64::from(camera.width_px) * k / 64) as u32);
            let Some(seen) = [middle].into_iter().chain(few).find(|&column| sees(column, row))
            else {
                return [0, 0];
            };
            let first = edge(0, seen, |column| sees(column, row));
            let last = edge(camera.width_px - 1, seen, |column| sees(column, row));
            [first, last + 1]
        });
        Some(Self { columns: columns.collect() })
    }

    /// The share of the image that is seen.
    pub fn visible_share(&self, camera: &Camera) -> f64 {
        let seen: u64 = self.columns.iter().map(|[first, end]| u64::from(end - first)).sum();
        seen as f64 / camera.pixels() as f64
    }

    /// Zeroes what is not seen, of an image with so many values a pixel.
    pub fn clear_outside<T: Default + Clone>(
        &self,
        camera: &Camera,
        values: usize,
        image: &mut [T],
    ) {
        let rows = image.chunks_mut(values * camera.width_px as usize);
        for (row, [first, end]) in rows.zip(&self.columns) {
            let (first, end) = (values * *first as usize, values * *end as usize);
            row[..first].fill(T::default());
            row[end..].fill(T::default());
        }
    }
}

/// Places along the border of an image, 33 a side.
fn border(camera: &Camera) -> impl Iterator<Item = [u32; 2]> {
    let (right, bottom) = (camera.width_px - 1, camera.height_px - 1);
    let along = |most: u32, k: u32| (u64::from(most) * u64::from(k) / 32) as u32;
    (0..=32).flat_map(move |k| {
        let (x, y) = (along(right, k), along(bottom, k));
        [[x, 0], [x, bottom], [0, y], [right, y]]
    })
}

/// The column nearest to `end` that is seen, between it and one that is.
fn edge(end: u32, seen: u32, sees: impl Fn(u32) -> bool) -> u32 {
    if sees(end) {
        return end;
    }
    let (mut out, mut within) = (end, seen);
    while out.abs_diff(within) > 1 {
        let middle = out.midpoint(within);
        if sees(middle) {
            within = middle;
        } else {
            out = middle;
        }
    }
    within
}

/// What of a lens decides whether something may be seen: a cone around its axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldCone {
    /// All pixels' rays are within this angle of the axis, in radians.
    pub image_rad: f64,
    /// Beyond, the distance from the axis' pixel grows by at least so many pixels a radian.
    pub least_px_per_rad: f64,
    /// Nowhere within [`WIDEST_RAD`] do two rays land farther apart than so many pixels a radian.
    pub most_px_per_rad: f64,
}

impl FieldCone {
    /// Steps of the angle off the axis, and of the azimuth, at which a lens is looked at.
    const STEPS: u32 = 64;
    const AZIMUTHS: u32 = 16;

    /// Of a lens, from a thousand of its rays. What lies between two of them is granted a fifth.
    pub fn of(camera: &Camera) -> Self {
        let axis_px = DVec2::new(camera.pinhole.cx, camera.pinhole.cy);
        let corner_px = axis_px.abs().max((camera.size_px() - axis_px).abs()).length();
        let step_rad = WIDEST_RAD / f64::from(Self::STEPS);
        let turn_rad = std::f64::consts::TAU / f64::from(Self::AZIMUTHS);
        let ring = |step: u32| {
            let (sin, cos) = (f64::from(step) * step_rad).sin_cos();
            (0..Self::AZIMUTHS).map(move |k| {
                let (y, x) = (f64::from(k) * turn_rad).sin_cos();
                camera.project_extrapolated(DVec3::new(x * sin, y * sin, cos)) - axis_px
            })
        };
        let mut cone =
            Self { image_rad: WIDEST_RAD, least_px_per_rad: f64::INFINITY, most_px_per_rad: 0.0 };
        let mut before: Vec<DVec2> = ring(0).collect();
        let mut covered = false;
        for step in 1..=Self::STEPS {
            let here: Vec<DVec2> = ring(step).collect();
            let across_rad = turn_rad * (f64::from(step) * step_rad).sin();
            for (k, (at, inner)) in here.iter().zip(&before).enumerate() {
                let beside = here[(k + 1) % here.len()];
                let across = at.distance(beside) / across_rad;
                cone.most_px_per_rad =
                    cone.most_px_per_rad.max(at.distance(*inner) / step_rad).max(across);
                if covered {
                    let outwards = (at.length() - inner.length()) / step_rad;
                    cone.least_px_per_rad = cone.least_px_per_rad.min(outwards);
                }
            }
            if !covered && here.iter().all(|at| at.length() >= corner_px) {
                covered = true;
                cone.image_rad = f64::from(step) * step_rad;
            }
            before = here;
        }
        cone.most_px_per_rad *= 1.2;
        cone.least_px_per_rad = if cone.least_px_per_rad.is_finite() {
            (0.8 * cone.least_px_per_rad).max(0.0)
        } else {
            0.0
        };
        cone
    }
}
