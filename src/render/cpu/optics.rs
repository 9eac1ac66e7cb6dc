//! Lenses, 16 points at a time in f32, within their field.
//!
//! What is round about its axis needs neither an arc tangent nor Newton's method here: with
//! `t = tan(θ/2) = |(x, y)|/(|p| + z)`, a radius `r(θ)` divided by t is a smooth function of t, for which a few
//! Chebyshev terms stand. How many is decided when a lens is prepared: until what they leave is less than
//! [`LEFT_PX`]. Whatever lies beyond the field, and every lens that this does not describe, is projected one by
//! one in f64 ([`super::bent`]).

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat2, DMat3, DVec2, DVec3};

use super::lanes::Vec3x16;
use crate::geometry::Camera;
use crate::geometry::camera::{Bivariate, Lens, Windshield, WindshieldReference};
use crate::render::View;

/// What is left out of a series, in pixels: a tenth of what f32 tells apart beside the middle of an image.
const LEFT_PX: f64 = 1e-5;

/// The same of the tangent of half an angle: f32 tells no more apart.
const LEFT: f64 = 5e-8;

/// Nodes at which a function is sampled, and most terms of its series: real lenses need 8 to 14,
/// and a fisheye whose image ends at 100° off the axis 18 to 22.
const NODES: usize = 32;
const TERMS: usize = 24;

/// A lens, ready for many points.
#[derive(Clone, Debug)]
pub(super) struct Optics {
    glass: Option<Glass>,
    center_px: [f32; 2],
    kind: Kind,
}

/// A windshield that turns rays as they come, at angles where it does so in full.
#[derive(Clone, Debug)]
struct Glass {
    horizontal: Sheet,
    vertical: Sheet,
}

/// A polynomial of two angles: for each power of the second, coefficients of the first's, highest first.
#[derive(Clone, Debug)]
struct Sheet(Vec<Vec<f32>>);

#[derive(Clone, Debug)]
enum Kind {
    /// `center + px_from_round (x, y)/(|p| + z) r(t)/t`, up to a t.
    Round { px_from_round: [[f32; 2]; 2], series: Series, limit: f32 },
    /// OpenCV's polynomials of the slopes, up to a square of their length.
    Slopes { focal_px: [f32; 2], k: [f32; 6], p: [f32; 2], s: [f32; 4], limit: f32 },
}

/// Where points land.
#[derive(Clone, Copy)]
pub(super) struct Landed<S: Simd> {
    pub(super) x_px: f32x16<S>,
    pub(super) y_px: f32x16<S>,
    /// How far they are within the field: not below 0.
    pub(super) within: f32x16<S>,
}

impl Optics {
    /// `None` for rolling shutters, windshields whose polynomials lead from inside to outside, and fields
    /// that a short series does not describe.
    pub(super) fn of(view: &View) -> Option<Self> {
        let Camera { pinhole, lens, windshield, .. } = &view.camera;
        if view.rolling.is_some() {
            return None;
        }
        let glass = match windshield {
            None => None,
            Some(windshield) => Some(Glass::of(windshield)?),
        };
        let focal_px = [pinhole.fx as f32, pinhole.fy as f32];
        // Most of what reaches into an image has all its points around it.
        let about_rad = view.camera.limit_rad().min(1.25 * seen_rad(&view.camera) + 0.1);
        let kind = match lens {
            // As it is behind a windshield: slopes without a distortion.
            Lens::Pinhole => {
                let limit = view.camera.straight_slope().powi(2) as f32 * INSIDE;
                Kind::Slopes { focal_px, k: [0.0; 6], p: [0.0; 2], s: [0.0; 4], limit }
            }
            Lens::OpenCv(lens) => {
                let end = view.camera.straight_slope().min(lens.limit_slope());
                let limit = (end * end) as f32;
                Kind::Slopes {
                    focal_px,
                    k: lens.k().map(|k| k as f32),
                    p: lens.p().map(|p| p as f32),
                    s: lens.s().map(|s| s as f32),
                    limit: limit * INSIDE,
                }
            }
            Lens::Fisheye(lens) => {
                let px_from_round = [[pinhole.fx as f32, 0.0], [0.0, pinhole.fy as f32]];
                let left = LEFT_PX / pinhole.fx.max(pinhole.fy);
                round(about_rad, px_from_round, left, &|angle| lens.radius().at(angle))?
            }
            Lens::FTheta(lens) => {
                let [c, d, e] = lens.linear_cde().map(|value| value as f32);
                let px_from_round = [[c, d], [e, 1.0]];
                round(about_rad, px_from_round, LEFT_PX, &|angle| lens.radius_px(angle))?
            }
        };
        Some(Self { glass, center_px: [pinhole.cx as f32, pinhole.cy as f32], kind })
    }

    /// Where points of the camera's frame land. What is not within the field lands anywhere.
    #[inline(always)]
    pub(super) fn land<S: Simd>(&self, simd: S, point_m: Vec3x16<S>) -> Landed<S> {
        let Some(glass) = &self.glass else { return self.land_inside(simd, point_m) };
        let (inside, in_full) = glass.inside(simd, point_m);
        let landed = self.land_inside(simd, inside);
        Landed { within: landed.within.min(in_full), ..landed }
    }

    /// The same behind the windshield.
    #[inline(always)]
    fn land_inside<S: Simd>(&self, simd: S, point_m: Vec3x16<S>) -> Landed<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let Vec3x16 { x, y, z } = point_m;
        let [cx, cy] = self.center_px.map(splat);
        match &self.kind {
            Kind::Round { px_from_round, series, limit } => {
                let off_axis2 = x.mul_add(x, y * y);
                let inverse = splat(1.0) / (z.mul_add(z, off_axis2).sqrt() + z);
                let t = off_axis2.sqrt() * inverse;
                let radius = series.at(simd, t) * inverse;
                let [[c, d], [e, f]] = px_from_round.map(|row| row.map(splat));
                Landed {
                    x_px: c.mul_add(x, d * y).mul_add(radius, cx),
                    y_px: e.mul_add(x, f * y).mul_add(radius, cy),
                    // Not a number is not within.
                    within: t.simd_le(splat(*limit)).select(splat(*limit) - t, splat(-1.0)),
                }
            }
            Kind::Slopes { focal_px, k, p, s, limit } => {
                let inverse = splat(1.0) / z;
                let (x, y) = (x * inverse, y * inverse);
                let (xx, yy, xy2) = (x * x, y * y, (x + x) * y);
                let r2 = xx + yy;
                let [k1, k2, k3, k4, k5, k6] = k.map(splat);
                let [p1, p2] = p.map(splat);
                let [s1, s2, s3, s4] = s.map(splat);
                let one = splat(1.0);
                let above = k3.mul_add(r2, k2).mul_add(r2, k1).mul_add(r2, one);
                let below = k6.mul_add(r2, k5).mul_add(r2, k4).mul_add(r2, one);
                let factor = above / below;
                let tangent_x = p1.mul_add(xy2, p2 * (r2 + xx + xx));
                let tangent_y = p2.mul_add(xy2, p1 * (r2 + yy + yy));
                let prism_x = s2.mul_add(r2, s1) * r2;
                let prism_y = s4.mul_add(r2, s3) * r2;
                let [fx, fy] = focal_px.map(splat);
                Landed {
                    x_px: (x.mul_add(factor, tangent_x) + prism_x).mul_add(fx, cx),
                    y_px: (y.mul_add(factor, tangent_y) + prism_y).mul_add(fy, cy),
                    // What is behind is beyond everything, and what is beside is not a number.
                    within: z.simd_gt(splat(0.0)).select(splat(*limit) - r2, splat(-1.0)),
                }
            }
        }
    }
}

impl Glass {
    fn of(windshield: &Windshield) -> Option<Self> {
        let [horizontal, vertical] =
            [windshield.horizontal(), windshield.vertical()].map(Sheet::of);
        let forward = windshield.reference() == WindshieldReference::Forward;
        forward.then_some(Self { horizontal, vertical })
    }

    /// Unit directions inside, and how far z as a share of the length is above what is turned in full.
    #[inline(always)]
    fn inside<S: Simd>(&self, simd: S, point_m: Vec3x16<S>) -> (Vec3x16<S>, f32x16<S>) {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = point_m.scale(splat(1.0) / point_m.dot(point_m).sqrt());
        let (phi, theta) = (asin(simd, unit.x), asin(simd, unit.y));
        let x = sin(simd, self.horizontal.at(simd, phi, theta));
        let y = sin(simd, self.vertical.at(simd, phi, theta));
        let z = (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt();
        let [_, in_full] = Windshield::FADES_Z;
        let in_full = splat(in_full as f32);
        (Vec3x16 { x, y, z }, unit.z.simd_ge(in_full).select(unit.z - in_full, splat(-1.0)))
    }
}

impl Glass {
    /// Unit directions outside, of directions of any length inside.
    #[inline(always)]
    fn outside<S: Simd>(&self, simd: S, inside: Vec3x16<S>) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = inside.scale(splat(1.0) / inside.dot(inside).sqrt());
        let (from_phi, from_theta) = (asin(simd, unit.x), asin(simd, unit.y));
        let (mut phi, mut theta) = (from_phi, from_theta);
        for _ in 0..Looks::ROUNDS {
            let off_phi = self.horizontal.at(simd, phi, theta) - from_phi;
            let off_theta = self.vertical.at(simd, phi, theta) - from_theta;
            (phi, theta) = (phi - off_phi, theta - off_theta);
        }
        let (x, y) = (sin(simd, phi), sin(simd, theta));
        Vec3x16 { x, y, z: (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt() }
    }
}

impl Sheet {
    fn of(polynomial: &Bivariate) -> Self {
        let mut left = polynomial.coefficients();
        let order = polynomial.order();
        let rows = (0..=order).map(|j| {
            let (row, rest) = left.split_at(order - j + 1);
            left = rest;
            row.iter().rev().map(|&c| c as f32).collect()
        });
        Self(rows.collect())
    }

    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, phi: f32x16<S>, theta: f32x16<S>) -> f32x16<S> {
        let mut sum = f32x16::splat(simd, 0.0);
        for row in self.0.iter().rev() {
            let mut of_phi = f32x16::splat(simd, 0.0);
            for &coefficient in row {
                of_phi = of_phi.mul_add(phi, f32x16::splat(simd, coefficient));
            }
            sum = sum.mul_add(theta, of_phi);
        }
        sum
    }
}

/// The arc sine within 2e-7, by the coefficients of Cephes' `asinf` up to a half, and of
/// `π/2 - 2 asin √((1 - x)/2)` beyond.
#[inline(always)]
fn asin<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let size = x.abs();
    let steep = size.simd_gt(splat(0.5));
    let z = steep.select(splat(0.5) * (splat(1.0) - size).max(splat(0.0)), size * size);
    let root = steep.select(z.sqrt(), size);
    let series = splat(4.216_32e-2)
        .mul_add(z, splat(2.418_131e-2))
        .mul_add(z, splat(4.547_002_6e-2))
        .mul_add(z, splat(7.495_300_3e-2))
        .mul_add(z, splat(1.666_675_2e-1));
    let small = (series * z).mul_add(root, root);
    let angle = steep.select(splat(std::f32::consts::FRAC_PI_2) - (small + small), small);
    angle.copysign(x)
}

/// The sine within 2e-7 up to a quarter turn: Taylor's terms up to the 13th power leave 7e-10.
#[inline(always)]
fn sin<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let xx = x * x;
    let series = splat(1.0 / 6_227_020_800.0)
        .mul_add(xx, splat(-1.0 / 39_916_800.0))
        .mul_add(xx, splat(1.0 / 362_880.0))
        .mul_add(xx, splat(-1.0 / 5_040.0))
        .mul_add(xx, splat(1.0 / 120.0))
        .mul_add(xx, splat(-1.0 / 6.0));
    (series * xx).mul_add(x, x)
}

/// The share of a field, in the measure of its limit, that surely is within it.
const INSIDE: f32 = 1.0 - 1e-5;

/// How far off the axis what an image shows is behind its windshield, in radians: a field may be far wider, and
/// the wider, the more terms.
fn seen_rad(camera: &Camera) -> f64 {
    let bare = Camera { windshield: None, ..*camera };
    let DVec2 { x: right, y: bottom } = camera.size_px();
    let limit_rad = camera.limit_rad();
    let corners = [[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]];
    let angle_rad = |corner| match bare.unproject(DVec2::from_array(corner)) {
        Some(ray) => ray.truncate().length().atan2(ray.z),
        None => limit_rad,
    };
    corners.map(angle_rad).into_iter().fold(0.0, f64::max).min(limit_rad)
}

/// Whether a windshield turns less than in full what a lens sees at the end of its field.
fn fades(camera: &Camera) -> bool {
    let bare = Camera { windshield: None, ..*camera };
    let (sin, cos) = (seen_rad(camera) * (1.0 - 1e-9)).sin_cos();
    let [_, in_full] = Windshield::FADES_Z;
    (0..32).any(|k| {
        let (y, x) = (f64::from(k) * std::f64::consts::TAU / 32.0).sin_cos();
        let at_px = bare.project(DVec3::new(x * sin, y * sin, cos));
        let in_full = at_px.is_some_and(|at_px| {
            camera.unproject(at_px).is_some_and(|outside| {
                let found = camera.project_beyond(outside).distance(at_px) < 1e-6;
                // Between two of the 32 it is nearly the same.
                found && outside.z >= in_full + 0.02
            })
        });
        !in_full
    })
}

/// The series of `r(2 atan t)/t`, which leaves less than `left`.
fn round(
    limit_rad: f64,
    px_from_round: [[f32; 2]; 2],
    left: f64,
    radius: &dyn Fn(f64) -> f64,
) -> Option<Kind> {
    let limit = (0.5 * limit_rad).tan();
    let series = Series::fit(limit, left, &|t| radius(2.0 * t.atan()))?;
    Some(Kind::Round { px_from_round, series, limit: limit as f32 * INSIDE })
}

/// `f(x)/x` from 0 to a limit.
#[derive(Clone, Debug)]
struct Series {
    /// Of Chebyshev polynomials of `x per_limit - 1`, which runs from -1 to 1.
    terms: Vec<f32>,
    per_limit: f32,
}

impl Series {
    /// As many terms as leave less than `left` of f; `None` if those are too many.
    fn fit(limit: f64, left: f64, f: &dyn Fn(f64) -> f64) -> Option<Self> {
        let node = |j: usize| std::f64::consts::PI * (j as f64 + 0.5) / NODES as f64;
        let sample = |j: usize| {
            let x = 0.5 * (node(j).cos() + 1.0) * limit;
            f(x) / x
        };
        let samples: Vec<f64> = (0..NODES).map(sample).collect();
        let term = |k: usize| {
            let term = |(j, g): (usize, &f64)| g * (k as f64 * node(j)).cos();
            let sum: f64 = samples.iter().enumerate().map(term).sum();
            sum * if k == 0 { 1.0 } else { 2.0 } / NODES as f64
        };
        let mut terms: Vec<f64> = (0..NODES).map(term).collect();
        let mut cut = 0.0;
        while let Some(last) = terms.last() {
            cut += last.abs() * limit;
            let needed = cut > left || cut.is_nan();
            if needed {
                break;
            }
            terms.pop();
        }
        let usable = (1..=TERMS).contains(&terms.len()) && cut.is_finite();
        let terms = terms.iter().map(|&term| term as f32).collect();
        usable.then_some(Self { terms, per_limit: (2.0 / limit) as f32 })
    }

    /// By Clenshaw's recurrence.
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, x: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let v = x.mul_add(splat(self.per_limit), splat(-1.0));
        let twice = v + v;
        let (mut last, mut before) = (splat(0.0), splat(0.0));
        for term in self.terms[1..].iter().rev() {
            let next = twice.mul_add(last, splat(*term)) - before;
            (before, last) = (last, next);
        }
        v.mul_add(last, splat(self.terms[0])) - before
    }
}

/// Where the pixels of a round lens look, 16 at a time: what [`Optics`] does, the other way.
#[derive(Clone, Debug)]
pub(super) struct Looks {
    glass: Option<Glass>,
    /// Rows that take (x, y, 1) in pixels to what is round, in pixels or focal lengths.
    round_from_px: [[f32; 3]; 2],
    /// `tan(θ/2)/ρ` by the distance ρ from the axis, up to a limit.
    series: Series,
    limit: f32,
    /// Rows that take directions in the camera's frame to other axes.
    axes_from_camera: [[f32; 3]; 3],
}

impl Looks {
    /// Rounds of the search behind a windshield: each halves its error at worst, and real ones leave a
    /// fiftieth.
    const ROUNDS: u32 = 24;

    /// `None` for what is not round, rolls, or is turned by a windshield as far as that fades.
    pub(super) fn of(view: &View, axes_from_world: DMat3) -> Option<Self> {
        let Camera { pinhole, lens, windshield, .. } = &view.camera;
        if view.rolling.is_some() {
            return None;
        }
        let glass = match windshield {
            None => None,
            Some(windshield) => Some(Glass::of(windshield).filter(|_| !fades(&view.camera))?),
        };
        let limit_rad = seen_rad(&view.camera);
        let (px_from_round, limit, series) = match lens {
            Lens::Pinhole | Lens::OpenCv(_) => return None,
            Lens::Fisheye(lens) => {
                let limit = lens.radius().at(limit_rad);
                let half = |radius: f64| (0.5 * lens.radius().invert(radius)).tan();
                let px_from_round = DMat2::from_diagonal(DVec2::new(pinhole.fx, pinhole.fy));
                (px_from_round, limit, Series::fit(limit, LEFT, &half)?)
            }
            Lens::FTheta(lens) => {
                let limit = lens.radius_px(limit_rad);
                let half = |radius_px: f64| (0.5 * lens.angle_rad(radius_px)).tan();
                (lens.linear(), limit, Series::fit(limit, LEFT, &half)?)
            }
        };
        let inverse = px_from_round.inverse();
        let center = inverse * DVec2::new(pinhole.cx, pinhole.cy);
        let row = |axis: usize| {
            let row = inverse.row(axis);
            [row.x, row.y, -center[axis]].map(|value| value as f32)
        };
        let rows = (axes_from_world * view.world_from_camera.rotation_matrix()).transpose();
        Some(Self {
            glass,
            round_from_px: [row(0), row(1)],
            series,
            limit: limit as f32,
            axes_from_camera: rows.to_cols_array_2d().map(|row| row.map(|value| value as f32)),
        })
    }

    /// Directions, of any length, of places of the image in pixels. Beyond the field they are some direction.
    #[inline(always)]
    pub(super) fn toward<S: Simd>(&self, simd: S, x: f32x16<S>, y: f32x16<S>) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let [[a, b, c], [d, e, f]] = self.round_from_px;
        let x_round = x.mul_add(splat(a), y.mul_add(splat(b), splat(c)));
        let y_round = x.mul_add(splat(d), y.mul_add(splat(e), splat(f)));
        let square = x_round.mul_add(x_round, y_round * y_round);
        let radius = square.sqrt().min(splat(self.limit));
        // (sin θ, cos θ) is as (2 t, 1 - t²).
        let per_radius = self.series.at(simd, radius);
        let t = per_radius * radius;
        let twice = per_radius + per_radius;
        let z = splat(1.0) - t * t;
        let inside = Vec3x16 { x: twice * x_round, y: twice * y_round, z };
        let away = match &self.glass {
            None => inside,
            Some(glass) => glass.outside(simd, inside),
        };
        let [first, second, third] = self.axes_from_camera;
        Vec3x16 {
            x: Vec3x16::splat(simd, first).dot(away),
            y: Vec3x16::splat(simd, second).dot(away),
            z: Vec3x16::splat(simd, third).dot(away),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::geometry::camera::{Fisheye, OpenCv, Pinhole};
    use crate::scene::Rig;
    use fearless_simd::{Level, dispatch};
    use glam::DQuat;

    /// The real cameras, one of them behind its windshield, and one of each other model: with how many of
    /// 4,000 directions up to the end of its field are surely within.
    fn cameras() -> Vec<(String, Camera, usize)> {
        let rigs = ["alpamayo1", "alpamayo2"].map(|rig| Rig::preset(rig).unwrap());
        let real = rigs.into_iter().flat_map(|rig| rig.cameras);
        let mut cameras: Vec<_> =
            real.map(|mounted| (mounted.name, mounted.camera, 3_800)).collect();
        let windshield = cameras.iter().find_map(|(_, camera, _)| camera.windshield);
        let ideal = Camera::ideal(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
        let (k, p) = ([-0.12, 0.03, -0.002, 0.01, 0.002, 0.0005], [0.0015, -0.001]);
        let opencv = Lens::opencv(OpenCv::new(k, p, [0.001, -0.0005, -0.0008, 0.0004]));
        let fisheye = Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None));
        for (name, camera, least_inside) in [
            ("opencv", Camera { lens: opencv, ..ideal }, 2_000),
            ("fisheye", Camera { lens: fisheye, ..ideal }, 1_000),
            ("pinhole behind a windshield", Camera { windshield, ..ideal }, 2_000),
        ] {
            cameras.push((name.to_owned(), camera, least_inside));
        }
        cameras
    }

    #[test]
    fn pixels_look_where_the_lens_says() {
        let mut most_rad: f64 = 0.0;
        for (name, camera, _) in cameras() {
            if !matches!(camera.lens, Lens::OpenCv(_) | Lens::Pinhole) {
                let turned = Pose { rotation: DQuat::from_rotation_x(0.7), ..Pose::IDENTITY };
                let view = View::new(camera, turned);
                let axes = DMat3::from_rotation_z(1.1);
                let looks = Looks::of(&view, axes).expect(&name);
                let mut seen = 0;
                for step in 0..2_000 {
                    let (column, row) = (step * 37 % camera.width_px, step * 11 % camera.height_px);
                    let at_px = DVec2::new(f64::from(column), f64::from(row)) + 0.5;
                    let Some(ray) = view.ray_world(at_px) else { continue };
                    let away = dispatch!(Level::new(), simd => {
                        let x = f32x16::splat(simd, at_px.x as f32);
                        let y = f32x16::splat(simd, at_px.y as f32);
                        let Vec3x16 { x, y, z } = looks.toward(simd, x, y);
                        [x.to_array()[0], y.to_array()[0], z.to_array()[0]].map(f64::from)
                    });
                    let away = DVec3::from_array(away).normalize();
                    most_rad = most_rad.max((axes * ray).distance(away));
                    seen += 1;
                }
                assert!(seen > 1_500, "{name}: {seen}");
            }
        }
        eprintln!("off by {most_rad:.1e} rad at most");
        assert!(most_rad < 2e-6, "{most_rad:e} rad");
    }

    /// Points on spirals from the axis to where a camera of a rig ends, and a little beyond.
    #[test]
    fn points_land_where_the_lens_says() {
        let mut most_px: f64 = 0.0;
        for (name, camera, least_inside) in cameras() {
            let optics = Optics::of(&View::new(camera, Pose::IDENTITY)).expect(&name);
            let mut inside = 0;
            for step in 0..4_000 {
                let angle_rad = 1.02 * camera.limit_rad() * f64::from(step) / 4_000.0;
                let (sin, cos) = angle_rad.sin_cos();
                let azimuth = 0.37 * f64::from(step);
                let way = DVec3::new(sin * azimuth.cos(), sin * azimuth.sin(), cos);
                let point = (17.0 * way).as_vec3();
                let [x_px, y_px, within] = dispatch!(Level::new(), simd => {
                    let landed = optics.land(simd, Vec3x16::splat(simd, point.to_array()));
                    [landed.x_px, landed.y_px, landed.within].map(|v| f64::from(v.to_array()[0]))
                });
                let seen = camera.project(point.as_dvec3());
                match seen {
                    Some(at_px) if within >= 0.0 => {
                        let off = at_px - glam::DVec2::new(x_px, y_px);
                        most_px = most_px.max(off.length());
                        inside += 1;
                    }
                    // Left for f64.
                    Some(_) => {}
                    None => assert!(within < 0.0, "{angle_rad} rad is beyond"),
                }
            }
            assert!(inside > least_inside, "{name}: {inside}");
        }
        eprintln!("off by {most_px:.1e} px at most");
        assert!(most_px < 1.5e-3, "{most_px:e} px");
    }
}
