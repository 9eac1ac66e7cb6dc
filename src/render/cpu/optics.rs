//! Lenses, 16 points at a time in f32, within their field.
//!
//! What is round about its axis needs neither an arc tangent nor Newton's method here: with
//! `t = tan(θ/2) = |(x, y)|/(|p| + z)`, a radius `r(θ)` divided by t is a smooth function of t, for which a few
//! Chebyshev terms stand. How many is decided when a lens is prepared: until what they leave is less than
//! [`LEFT_PX`]. Whatever lies beyond the field, and every lens that this does not describe, is projected one by
//! one in f64 ([`super::bent`]).

use fearless_simd::{f32x16, prelude::*};

use super::lanes::Vec3x16;
use crate::geometry::Camera;
use crate::geometry::camera::{Bivariate, Lens, Windshield, WindshieldReference};
use crate::render::View;

/// What is left out of a series, in pixels: a tenth of what f32 tells apart beside the middle of an image.
const LEFT_PX: f64 = 1e-5;

/// Nodes at which a radius is sampled, and most terms of its series: at 2.2 rad off the axis 17 are enough.
const NODES: usize = 64;
const TERMS: usize = 32;

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
    /// `center + px_from_round (x, y)/(|p| + z) Σ terms`, up to a t.
    Round {
        px_from_round: [[f32; 2]; 2],
        /// Of Chebyshev polynomials of `t per_limit - 1`, which runs from -1 to 1.
        terms: Vec<f32>,
        per_limit: f32,
        limit: f32,
    },
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
                let largest_px = pinhole.fx.max(pinhole.fy);
                round(lens.limit_rad(), px_from_round, largest_px, &|angle| {
                    lens.radius().at(angle)
                })?
            }
            Lens::FTheta(lens) => {
                let [c, d, e] = lens.linear_cde().map(|value| value as f32);
                let px_from_round = [[c, d], [e, 1.0]];
                round(lens.limit_rad(), px_from_round, 1.0, &|angle| lens.radius_px(angle))?
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
            Kind::Round { px_from_round, terms, per_limit, limit } => {
                let off_axis2 = x.mul_add(x, y * y);
                let inverse = splat(1.0) / (z.mul_add(z, off_axis2).sqrt() + z);
                let t = off_axis2.sqrt() * inverse;
                // Clenshaw's recurrence.
                let v = t.mul_add(splat(*per_limit), splat(-1.0));
                let twice = v + v;
                let (mut last, mut before) = (splat(0.0), splat(0.0));
                for term in terms[1..].iter().rev() {
                    let next = twice.mul_add(last, splat(*term)) - before;
                    (before, last) = (last, next);
                }
                let radius = (v.mul_add(last, splat(terms[0])) - before) * inverse;
                let [[c, d], [e, f]] = px_from_round.map(|row| row.map(splat));
                Landed {
                    x_px: c.mul_add(x, d * y).mul_add(radius, cx),
                    y_px: e.mul_add(x, f * y).mul_add(radius, cy),
                    within: splat(*limit) - t,
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
                    // What is behind is beyond everything.
                    within: (splat(*limit) - r2).min(z),
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
        (Vec3x16 { x, y, z }, unit.z - splat(in_full as f32))
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

/// The series of `r(2 atan t)/t`, of which `radius` gives r in units of `unit_px`.
fn round(
    limit_rad: f64,
    px_from_round: [[f32; 2]; 2],
    unit_px: f64,
    radius: &dyn Fn(f64) -> f64,
) -> Option<Kind> {
    let limit = (0.5 * limit_rad).tan();
    let node = |j: usize| std::f64::consts::PI * (j as f64 + 0.5) / NODES as f64;
    let samples: Vec<f64> = (0..NODES)
        .map(|j| {
            let t = 0.5 * (node(j).cos() + 1.0) * limit;
            radius(2.0 * t.atan()) / t
        })
        .collect();
    let term = |k: usize| {
        let sum: f64 =
            samples.iter().enumerate().map(|(j, g)| g * (k as f64 * node(j)).cos()).sum();
        sum * if k == 0 { 1.0 } else { 2.0 } / NODES as f64
    };
    let mut terms: Vec<f64> = (0..NODES).map(term).collect();
    let mut left_px = 0.0;
    while let Some(last) = terms.last() {
        left_px += last.abs() * limit * unit_px;
        if left_px > LEFT_PX {
            break;
        }
        terms.pop();
    }
    let usable = (1..=TERMS).contains(&terms.len()) && left_px.is_finite();
    usable.then(|| Kind::Round {
        px_from_round,
        terms: terms.iter().map(|&term| term as f32).collect(),
        per_limit: (2.0 / limit) as f32,
        limit: limit as f32 * INSIDE,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::scene::Rig;
    use fearless_simd::{Level, dispatch};
    use glam::DVec3;

    /// Points on spirals from the axis to where a camera of a rig ends, and a little beyond.
    #[test]
    fn points_land_where_the_lens_says() {
        let mut most_px: f64 = 0.0;
        for rig in ["alpamayo1", "alpamayo2"] {
            for mounted in Rig::preset(rig).unwrap().cameras {
                let camera = mounted.camera;
                let optics = Optics::of(&View::new(camera, Pose::IDENTITY)).expect(&mounted.name);
                let (mut inside, mut outside) = (0, 0);
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
                        Some(_) => assert!(angle_rad > 0.98 * camera.limit_rad(), "{angle_rad}"),
                        None => {
                            assert!(within < 0.0, "{angle_rad} rad is beyond");
                            outside += 1;
                        }
                    }
                }
                assert!(inside > 3_800 && outside > 20, "{inside} {outside}");
            }
        }
        eprintln!("off by {most_px:.1e} px at most");
        assert!(most_px < 1.5e-3, "{most_px:e} px");
    }
}
