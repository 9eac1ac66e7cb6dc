//! The part of an image within a lens' field, and bounds of the projection over that field.

use glam::{DVec2, DVec3};

use super::{Camera, Lens, WIDEST_RAD};

/// The columns of each row that lie within a lens' field, for cameras whose field does not cover
/// the image.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldMask {
    /// First column and the column after the last, for each row; equal where no column is in the
    /// field.
    pub columns: Vec<[u32; 2]>,
}

impl FieldMask {
    /// The mask of a camera; `None` if the field covers the whole image, as for most cameras. That
    /// test takes some microseconds.
    ///
    /// The field of every model is a slightly deformed disc, so it has no holes and each row of it
    /// is one interval.
    pub fn from_camera(camera: &Camera) -> Option<Self> {
        let sees = |column: u32, row: u32| {
            let at_px = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
            camera.unproject(at_px).is_some()
        };
        // The field of a lens is convex enough that it covers the image if it covers the border:
        // 132 samples instead of all pixels.
        if camera.lens == Lens::Pinhole || border(camera).all(|[column, row]| sees(column, row)) {
            return None;
        }
        let middle = camera.pinhole.cx.clamp(0.0, f64::from(camera.width_px - 1)) as u32;
        // A row needs one column within the field as a start; from there bisection finds both edges
        // in 14 steps each, since a side has at most 2^14 pixels.
        let columns = (0..camera.height_px).map(|row| {
            // Find any column of the row in the field: the one at the axis, or one of 64 samples.
            let samples = (0..64).map(|k| (u64::from(camera.width_px) * k / 64) as u32);
            let Some(seen) = [middle].into_iter().chain(samples).find(|&column| sees(column, row))
            else {
                return [0, 0];
            };
            let first = edge(0, seen, |column| sees(column, row));
            let last = edge(camera.width_px - 1, seen, |column| sees(column, row));
            [first, last + 1]
        });
        Some(Self { columns: columns.collect() })
    }

    /// Share of the image's pixels in the field, 0 to 1.
    pub fn visible_share(&self, camera: &Camera) -> f64 {
        let seen: u64 = self.columns.iter().map(|[first, end]| u64::from(end - first)).sum();
        seen as f64 / camera.pixels() as f64
    }

    /// Sets pixels outside of the field to the default value. `image` has `values` values per
    /// pixel.
    pub fn clear_outside<T: Default + Clone>(
        &self,
        camera: &Camera,
        values: usize,
        image: &mut [T],
    ) {
        let rows = image.chunks_mut(values * camera.width_px as usize);
        for (row, [first, end]) in rows.zip(&self.columns) {
            let first = values * *first as usize;
            let end = values * *end as usize;
            row[..first].fill(T::default());
            row[end..].fill(T::default());
        }
    }
}

/// Pixels along the border of an image, 33 per side.
fn border(camera: &Camera) -> impl Iterator<Item = [u32; 2]> {
    let right = camera.width_px - 1;
    let bottom = camera.height_px - 1;
    let along = |most: u32, k: u32| (u64::from(most) * u64::from(k) / 32) as u32;
    (0..=32).flat_map(move |k| {
        let x = along(right, k);
        let y = along(bottom, k);
        [[x, 0], [x, bottom], [0, y], [right, y]]
    })
}

/// The column nearest to `end` that is in the field, by bisection between `end` and `seen`, which
/// is in it.
fn edge(end: u32, seen: u32, sees: impl Fn(u32) -> bool) -> u32 {
    if sees(end) {
        return end;
    }
    // `out` is outside of the field, `within` inside, until they are neighbours. `end` may be on
    // either side of `seen`.
    let mut out = end;
    let mut within = seen;
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

/// Bounds of a camera's projection around its axis, from which culling decides whether a Gaussian
/// may be visible.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldCone {
    /// Every pixel's ray is within this angle of the axis, in radians.
    pub image_rad: f64,
    /// Beyond [`FieldCone::image_rad`], the distance from the principal point grows by at least
    /// this many pixels per radian.
    pub least_px_per_rad: f64,
    /// Bounds of the scale within cones around the axis, from the narrowest to [`WIDEST_RAD`].
    pub scales: [ScaleWithin; FieldCone::SCALES],
}

/// A bound of a camera's scale within a cone around its axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleWithin {
    /// The cone's angle, in radians off the axis.
    pub rad: f64,
    /// Upper bound of the pixels between two projected rays of the cone per radian between them.
    pub most_px_per_rad: f64,
}

impl FieldCone {
    /// Number of angles off the axis and of azimuths at which the projection is sampled.
    const STEPS: u32 = 64;
    const AZIMUTHS: u32 = 16;

    /// Number of cones in [`FieldCone::scales`].
    pub const SCALES: usize = 5;

    /// Angles by which these cones are wider than the image, in radians, except for the last. Most
    /// Gaussians that are culled lie just outside of the image, where a pinhole of 100° has 3 times
    /// the scale that it has on its axis; at the end of its continuation it has 17 times that
    /// scale.
    const WIDER_RAD: [f64; Self::SCALES - 1] = [0.05, 0.15, 0.35, 0.7];

    /// Bounds of a camera from a thousand samples of its projection, with a margin of a fifth for
    /// what lies between samples.
    pub fn from_camera(camera: &Camera) -> Self {
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
        // If no ring covers the image, the whole continuation counts as image.
        let mut image_rad = WIDEST_RAD;
        let mut least_px_per_rad = f64::INFINITY;
        // The largest scale up to each step.
        let mut most_px_per_rad = vec![0.0];
        let mut before: Vec<DVec2> = ring(0).collect();
        let mut covered = false;
        for step in 1..=Self::STEPS {
            let here: Vec<DVec2> = ring(step).collect();
            let across_rad = turn_rad * (f64::from(step) * step_rad).sin();
            let mut most: f64 = most_px_per_rad[step as usize - 1];
            for (k, (at, inner)) in here.iter().zip(&before).enumerate() {
                let beside = here[(k + 1) % here.len()];
                // Around the axis and away from it: the larger of both is a bound of the scale, up
                // to the margin.
                let across = at.distance(beside) / across_rad;
                most = most.max(at.distance(*inner) / step_rad).max(across);
                // Only beyond the image: culling uses this bound for Gaussians outside of it.
                if covered {
                    let outwards = (at.length() - inner.length()) / step_rad;
                    least_px_per_rad = least_px_per_rad.min(outwards);
                }
            }
            most_px_per_rad.push(most);
            if !covered && here.iter().all(|at| at.length() >= corner_px) {
                covered = true;
                image_rad = f64::from(step) * step_rad;
            }
            before = here;
        }
        let scales = std::array::from_fn(|k| {
            let wanted_rad = Self::WIDER_RAD.get(k).map_or(WIDEST_RAD, |wider| image_rad + wider);
            let rad = wanted_rad.min(WIDEST_RAD);
            // Rounded up, so that the sampled cone contains the wanted one.
            let step = ((rad / step_rad).ceil() as usize).min(Self::STEPS as usize);
            ScaleWithin { rad, most_px_per_rad: 1.2 * most_px_per_rad[step] }
        });
        // With no step beyond the image there is no bound: 0 culls nothing.
        let least_px_per_rad =
            if least_px_per_rad.is_finite() { (0.8 * least_px_per_rad).max(0.0) } else { 0.0 };
        Self { image_rad, least_px_per_rad, scales }
    }
}
