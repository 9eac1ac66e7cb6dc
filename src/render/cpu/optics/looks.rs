//! Where the pixels of a lens look.

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat2, DMat3, DVec2};

use super::glass::{Glass, fades};
use super::seen_rad;
use super::series::Series;
use crate::geometry::Camera;
use crate::geometry::camera::Lens;
use crate::render::View;
use crate::render::cpu::lanes::Vec3x16;

/// What is left out of the tangent of half an angle: f32 tells no more apart.
const LEFT: f64 = 5e-8;

/// Where the pixels of a round lens look, 16 at a time: what [`super::Optics`] does, the other way.
#[derive(Clone, Debug)]
pub(in crate::render::cpu) struct Looks {
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
    /// `None` for what is not round, rolls, or is turned by a windshield as far as that fades.
    pub(in crate::render::cpu) fn of(view: &View, axes_from_world: DMat3) -> Option<Self> {
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
        Some(Self {
            glass,
            round_from_px: [row(0), row(1)],
            series,
            limit: limit as f32,
            axes_from_camera: view.sky_from_camera(axes_from_world),
        })
    }

    /// Directions, of any length, of places of the image in pixels. Beyond the field they are some direction.
    #[inline(always)]
    pub(in crate::render::cpu) fn toward<S: Simd>(
        &self,
        simd: S,
        x: f32x16<S>,
        y: f32x16<S>,
    ) -> Vec3x16<S> {
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
