//! Where the pixels of a lens or of a rolling shutter look.

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat2, DMat3, DVec2};

use super::glass::{Glass, fades};
use super::seen_rad;
use super::series::Series;
use super::shutter::Shutter;
use crate::View;
use crate::cpu::lanes::Vec3x16;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::Lens;

/// What is left out of the tangent of half an angle: f32 tells no more apart.
const LEFT: f64 = 5e-8;

/// Where the pixels of a pinhole or of a round lens look, 16 at a time: what [`super::Optics`] does, the other
/// way.
#[derive(Clone, Debug)]
pub(in crate::cpu) struct Looks {
    shutter: Option<Shutter>,
    glass: Option<Glass>,
    /// Rows that take (x, y, 1) in pixels to what is round, in pixels or focal lengths, or to slopes.
    round_from_px: [[f32; 3]; 2],
    /// Of a round lens: `tan(θ/2)/ρ` by the distance ρ from the axis, up to a limit.
    round: Option<(Series, f32)>,
    /// Rows that take directions in the camera's frame to other axes.
    axes_from_camera: [[f32; 3]; 3],
}

impl Looks {
    /// `None` for OpenCV's polynomials of slopes, and for what is turned by a windshield as far as that fades.
    pub(in crate::cpu) fn of(view: &View, axes_from_world: DMat3) -> Option<Self> {
        let Camera { pinhole, lens, windshield, .. } = &view.camera;
        let shutter = match view.shutter_motion() {
            None => None,
            Some(still) => Some(Shutter::of(&still)?),
        };
        let glass = match windshield {
            None => None,
            Some(windshield) => Some(Glass::of(windshield).filter(|_| !fades(&view.camera))?),
        };
        let focal_px = DMat2::from_diagonal(DVec2::new(pinhole.fx, pinhole.fy));
        let round = |limit: f64, angle_rad: &dyn Fn(f64) -> f64| {
            let half = |radius: f64| (0.5 * angle_rad(radius)).tan();
            Some(Some((Series::fit(limit, LEFT, &half)?, limit as f32)))
        };
        let (px_from_round, round) = match lens {
            Lens::OpenCv(_) => return None,
            Lens::Pinhole => (focal_px, None),
            Lens::Fisheye(lens) => {
                let limit = lens.radius().at(seen_rad(&view.camera));
                (focal_px, round(limit, &|radius| lens.radius().invert(radius))?)
            }
            Lens::FTheta(lens) => {
                let limit = lens.radius_px(seen_rad(&view.camera));
                (lens.linear(), round(limit, &|radius_px| lens.angle_rad(radius_px))?)
            }
        };
        let inverse = px_from_round.inverse();
        let center = inverse * DVec2::new(pinhole.cx, pinhole.cy);
        let row = |axis: usize| {
            let row = inverse.row(axis);
            [row.x, row.y, -center[axis]].map(|value| value as f32)
        };
        Some(Self {
            shutter,
            glass,
            round_from_px: [row(0), row(1)],
            round,
            axes_from_camera: view.sky_from_camera(axes_from_world),
        })
    }

    /// Directions, of any length, of places of the image in pixels. Beyond the field they are some direction.
    #[inline(always)]
    pub(in crate::cpu) fn toward<S: Simd>(
        &self,
        simd: S,
        x: f32x16<S>,
        y: f32x16<S>,
    ) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let [[a, b, c], [d, e, f]] = self.round_from_px;
        let x_round = x.mul_add(splat(a), y.mul_add(splat(b), splat(c)));
        let y_round = x.mul_add(splat(d), y.mul_add(splat(e), splat(f)));
        let inside = match &self.round {
            None => Vec3x16 { x: x_round, y: y_round, z: splat(1.0) },
            Some((series, limit)) => {
                let square = x_round.mul_add(x_round, y_round * y_round);
                let radius = square.sqrt().min(splat(*limit));
                // (sin θ, cos θ) is as (2 t, 1 - t²).
                let per_radius = series.at(simd, radius);
                let t = per_radius * radius;
                let twice = per_radius + per_radius;
                Vec3x16 { x: twice * x_round, y: twice * y_round, z: splat(1.0) - t * t }
            }
        };
        let then = match &self.glass {
            None => inside,
            Some(glass) => glass.outside(simd, inside),
        };
        let away = match &self.shutter {
            None => then,
            Some(shutter) => shutter.at_end(simd, then, shutter.share(simd, x, y)),
        };
        let [first, second, third] = self.axes_from_camera;
        Vec3x16 {
            x: Vec3x16::splat(simd, first).dot(away),
            y: Vec3x16::splat(simd, second).dot(away),
            z: Vec3x16::splat(simd, third).dot(away),
        }
    }
}
