//! Lenses and rolling shutters, 16 points at a time in f32, within the lens' field.
//!
//! What is round about its axis needs neither an arc tangent nor Newton's method here: with
//! `t = tan(θ/2) = |(x, y)|/(|p| + z)`, a radius `r(θ)` divided by t is a smooth function of t, for which a few
//! Chebyshev terms stand. How many is decided when a lens is prepared: until what they leave is less than
//! [`LEFT_PX`]. Whatever lies beyond the field, does not find its row, or is before a camera that this does not
//! describe, is projected one by one in f64 ([`super::bent`]).

mod glass;
mod looks;
mod series;
mod shutter;
mod sines;

use fearless_simd::{f32x16, prelude::*};

use super::lanes::Vec3x16;
use crate::View;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::Lens;

use glass::Glass;
pub(super) use looks::Looks;
use series::Series;
use shutter::Shutter;

/// What is left out of a series, in pixels: a tenth of what f32 tells apart beside the middle of an image.
const LEFT_PX: f64 = 1e-5;

/// A lens, ready for many points.
#[derive(Clone, Debug)]
pub(super) struct Optics {
    shutter: Option<Shutter>,
    glass: Option<Glass>,
    center_px: [f32; 2],
    kind: Kind,
}

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

/// Where points land while the shutter rolls, if it does.
#[derive(Clone, Copy)]
pub(super) struct Exposed<S: Simd> {
    pub(super) landed: Landed<S>,
    /// Which share of the exposure is still to come then: 0 if nothing rolls.
    pub(super) share: f32x16<S>,
}

impl Optics {
    /// `None` for windshields whose polynomials lead from inside to outside, fields that a short series does
    /// not describe, and cameras that turn as good as around in one exposure.
    pub(super) fn of(view: &View) -> Option<Self> {
        let Camera { pinhole, lens, windshield, .. } = &view.camera;
        let shutter = match view.shutter_motion() {
            None => None,
            Some(still) => Some(Shutter::of(&still)?),
        };
        let glass = match windshield {
            None => None,
            Some(windshield) => Some(Glass::of(windshield)?),
        };
        let focal_px = [pinhole.fx as f32, pinhole.fy as f32];
        // Most of what reaches into an image has all its points around it.
        let about_rad = || view.camera.limit_rad().min(1.25 * seen_rad(&view.camera) + 0.1);
        let kind = match lens {
            // As it is behind a windshield or when it moves: slopes without a distortion.
            Lens::Pinhole => {
                let limit = view.camera.extrapolation_slope().powi(2) as f32 * INSIDE;
                Kind::Slopes { focal_px, k: [0.0; 6], p: [0.0; 2], s: [0.0; 4], limit }
            }
            Lens::OpenCv(lens) => {
                let end = view.camera.extrapolation_slope().min(lens.limit_slope());
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
                round(about_rad(), px_from_round, left, &|angle| lens.radius().at(angle))?
            }
            Lens::FTheta(lens) => {
                let [c, d, e] = lens.linear_cde().map(|value| value as f32);
                let px_from_round = [[c, d], [e, 1.0]];
                round(about_rad(), px_from_round, LEFT_PX, &|angle| lens.radius_px(angle))?
            }
        };
        Some(Self { shutter, glass, center_px: [pinhole.cx as f32, pinhole.cy as f32], kind })
    }

    /// Where points of the camera's frame at the exposure's end land. With a rolling shutter the row decides
    /// where the camera stands, and that decides the row: found by going back and forth, from a first guess
    /// of which share is still to come. What has not come to rest, or is not within the field, lands anywhere
    /// and is not within.
    #[inline(always)]
    pub(super) fn expose<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        guess: f32x16<S>,
    ) -> Exposed<S> {
        let Some(shutter) = &self.shutter else {
            return Exposed { landed: self.land(simd, at_end_m), share: guess };
        };
        let none = f32x16::splat(simd, 0.0);
        let mut share = guess;
        let mut round = 0;
        loop {
            let landed = self.land(simd, shutter.then(simd, at_end_m, share));
            let next = shutter.share(simd, landed.x_px, landed.y_px);
            let still = Shutter::is_still(simd, next, share);
            if round == Shutter::ROUNDS || (still | !landed.within.simd_ge(none)).all_true() {
                let within = still.select(landed.within, f32x16::splat(simd, -1.0));
                return Exposed { landed: Landed { within, ..landed }, share };
            }
            (share, round) = (next, round + 1);
        }
    }

    /// What rolls while the camera moves, if anything does.
    #[inline(always)]
    pub(super) fn shutter(&self) -> Option<&Shutter> {
        self.shutter.as_ref()
    }

    /// Where points of the camera's frame land. What is not within the field lands anywhere.
    #[inline(always)]
    fn land<S: Simd>(&self, simd: S, point_m: Vec3x16<S>) -> Landed<S> {
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

/// The share of a field, in the measure of its limit, that surely is within it.
const INSIDE: f32 = 1.0 - 1e-5;

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

/// How far off the axis what an image shows is behind its windshield, in radians: a field may be far wider, and
/// the wider, the more terms.
fn seen_rad(camera: &Camera) -> f64 {
    camera.corner_rad().min(camera.limit_rad())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RollingShutter;
    use fearless_simd::{Level, dispatch};
    use glam::{DMat3, DQuat, DVec2, DVec3};
    use wildcity_scene::Rig;
    use wildcity_scene::geometry::Pose;
    use wildcity_scene::geometry::camera::{Fisheye, OpenCv, Pinhole, ShutterDirection};

    /// The real cameras, one of them behind its windshield, and one of each other model: with how many of
    /// 4,000 directions up to the end of its field are surely within.
    fn cameras() -> Vec<(String, Camera, usize)> {
        let rigs = ["alpamayo1", "alpamayo2"].map(|rig| Rig::preset(rig).unwrap());
        let real = rigs.into_iter().flat_map(|rig| rig.cameras);
        let mut cameras: Vec<_> =
            real.map(|mounted| (mounted.name, mounted.camera, 3_800)).collect();
        let windshield = cameras.iter().find_map(|(_, camera, _)| camera.windshield);
        let ideal =
            Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
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

    /// At rest, and driven by 0.9 m and 0.01 rad during the exposure; turned in the world.
    fn views(camera: Camera) -> [View; 2] {
        let pose = Pose { rotation: DQuat::from_rotation_x(0.7), ..Pose::IDENTITY };
        let still = View::new(camera, pose);
        let world_from_camera_first = Pose {
            position_m: pose.rotation * DVec3::new(-0.05, 0.0, -0.9),
            rotation: pose.rotation * DQuat::from_rotation_y(-0.01),
        };
        let direction = ShutterDirection::BottomToTop;
        [
            still,
            View {
                rolling_shutter: Some(RollingShutter { direction, world_from_camera_first }),
                ..still
            },
        ]
    }

    #[test]
    fn pixels_look_where_the_lens_says() {
        let mut most_rad: f64 = 0.0;
        for (name, camera, _) in cameras() {
            if matches!(camera.lens, Lens::OpenCv(_)) {
                continue;
            }
            for view in views(camera) {
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
            for view in views(camera) {
                let optics = Optics::of(&view).expect(&name);
                let mut inside = 0;
                for step in 0..4_000 {
                    let angle_rad = 1.02 * camera.limit_rad() * f64::from(step) / 4_000.0;
                    let (sin, cos) = angle_rad.sin_cos();
                    let azimuth = 0.37 * f64::from(step);
                    let way = DVec3::new(sin * azimuth.cos(), sin * azimuth.sin(), cos);
                    let point = (17.0 * way).as_vec3();
                    let [x_px, y_px, within] = dispatch!(Level::new(), simd => {
                        let point = Vec3x16::splat(simd, point.to_array());
                        let Exposed { landed, .. } =
                            optics.expose(simd, point, f32x16::splat(simd, 0.0));
                        [landed.x_px, landed.y_px, landed.within]
                            .map(|value| f64::from(value.to_array()[0]))
                    });
                    let point_m = view.world_from_camera.transform_point(point.as_dvec3());
                    match view.project_world(point_m) {
                        Some(at_px) if within >= 0.0 => {
                            let off = at_px - DVec2::new(x_px, y_px);
                            most_px = most_px.max(off.length());
                            inside += 1;
                        }
                        // Left for f64.
                        Some(_) => {}
                        None => assert!(within < 0.0, "{name}: {angle_rad} rad is beyond"),
                    }
                }
                assert!(inside > least_inside, "{name}: {inside}");
            }
        }
        eprintln!("off by {most_px:.1e} px at most");
        assert!(most_px < 1.5e-3, "{most_px:e} px");
    }
}
