//! Rays of pixels: the inverse of [`super::LensProjection`], 16 pixels at a time.

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat2, DMat3, DVec2};

use super::chebyshev::ChebyshevSeries;
use super::max_seen_rad;
use super::shutter::SimdShutter;
use super::windshield::{SimdWindshield, fades_within_image};
use crate::View;
use crate::cpu::lanes::Vec3x16;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::Lens;

/// Largest error of the series of `tan(θ/2)`: the resolution of f32.
const MAX_TANGENT_ERROR: f64 = 5e-8;

/// Viewing directions of the pixels of a pinhole or of a lens that is round about its axis.
#[derive(Clone, Debug)]
pub(in crate::cpu) struct LensRays {
    shutter: Option<SimdShutter>,
    windshield: Option<SimdWindshield>,
    /// Rows that take `(x, y, 1)` in pixels to round coordinates, which are slopes for a pinhole,
    /// and otherwise pixels or focal lengths from the axis.
    round_from_px: [[f32; 3]; 2],
    /// `None` for a pinhole.
    round: Option<RoundLens>,
    /// Rows that take directions in the camera's frame at the end of the exposure to the requested
    /// axes.
    axes_from_camera: [[f32; 3]; 3],
}

/// The angle of a round lens by the distance from its axis.
#[derive(Clone, Debug)]
struct RoundLens {
    /// `tan(θ/2)/ρ` by the distance ρ in round coordinates.
    series: ChebyshevSeries,
    max_radius: f32,
}

impl LensRays {
    /// `None` for OpenCV's polynomials of slopes, for cameras that [`super::LensProjection`] does
    /// not describe, and for a windshield with a refraction that fades within the image.
    pub(in crate::cpu) fn new(view: &View, axes_from_world: DMat3) -> Option<Self> {
        let Camera { pinhole, lens, windshield, .. } = &view.camera;
        // What the projection cannot describe, its inverse cannot either: the same conditions.
        let shutter = match view.shutter_motion() {
            None => None,
            Some(motion) => Some(SimdShutter::new(&motion)?),
        };
        let windshield = match windshield {
            None => None,
            Some(windshield) => {
                let in_full = |_: &SimdWindshield| !fades_within_image(&view.camera);
                Some(SimdWindshield::new(windshield).filter(in_full)?)
            }
        };
        let focal_px = DMat2::from_diagonal(DVec2::new(pinhole.fx, pinhole.fy));
        let (px_from_round, round) = match lens {
            Lens::OpenCv(_) => return None,
            Lens::Pinhole => (focal_px, None),
            Lens::Fisheye(lens) => {
                let max_radius = lens.radius().at(max_seen_rad(&view.camera));
                let round = RoundLens::new(max_radius, &|radius| lens.radius().invert(radius))?;
                (focal_px, Some(round))
            }
            Lens::FTheta(lens) => {
                let max_radius_px = lens.radius_px(max_seen_rad(&view.camera));
                let round = RoundLens::new(max_radius_px, &|radius_px| lens.angle_rad(radius_px))?;
                (lens.linear(), Some(round))
            }
        };
        let inverse = px_from_round.inverse();
        let center = inverse * DVec2::new(pinhole.cx, pinhole.cy);
        let row = |axis: usize| {
            let row = inverse.row(axis);
            // round = inverse (px - center), as one affine row.
            [row.x, row.y, -center[axis]].map(|value| value as f32)
        };
        Some(Self {
            shutter,
            windshield,
            round_from_px: [row(0), row(1)],
            round,
            axes_from_camera: view.sky_from_camera(axes_from_world),
        })
    }

    /// Viewing directions, of any length, of places of the image in pixels. Beyond the lens' field
    /// they are arbitrary.
    #[inline(always)]
    pub(in crate::cpu) fn directions<S: Simd>(
        &self,
        simd: S,
        x_px: f32x16<S>,
        y_px: f32x16<S>,
    ) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);

        // From pixels to a direction behind the windshield.
        let [[a, b, c], [d, e, f]] = self.round_from_px;
        let x_round = x_px.mul_add(splat(a), y_px.mul_add(splat(b), splat(c)));
        let y_round = x_px.mul_add(splat(d), y_px.mul_add(splat(e), splat(f)));
        let inside = match &self.round {
            None => Vec3x16 { x: x_round, y: y_round, z: splat(1.0) },
            Some(RoundLens { series, max_radius }) => {
                let square = x_round.mul_add(x_round, y_round * y_round);
                // The clamp keeps the series within its range at pixels that the mask
                // removes later.
                let radius = square.sqrt().min(splat(*max_radius));
                // With t = tan(θ/2), (sin θ, cos θ) is proportional to (2 t, 1 - t²).
                let t_per_radius = series.at(simd, radius);
                let t = t_per_radius * radius;
                let twice = t_per_radius + t_per_radius;
                // 2 t (x, y)/radius without the division, which fails on the axis.
                Vec3x16 { x: twice * x_round, y: twice * y_round, z: splat(1.0) - t * t }
            }
        };

        // Through the windshield, and from the moment of exposure to the end of it.
        let at_exposure = match &self.windshield {
            None => inside,
            Some(windshield) => windshield.outside(simd, inside),
        };
        let at_end = match &self.shutter {
            None => at_exposure,
            Some(shutter) => {
                let remaining = shutter.remaining_at(simd, x_px, y_px);
                shutter.direction_to_end_frame(simd, at_exposure, remaining)
            }
        };

        let [first, second, third] = self.axes_from_camera;
        Vec3x16 {
            x: Vec3x16::splat(simd, first).dot(at_end),
            y: Vec3x16::splat(simd, second).dot(at_end),
            z: Vec3x16::splat(simd, third).dot(at_end),
        }
    }
}

impl RoundLens {
    /// `None` if no short series describes the angle.
    fn new(max_radius: f64, angle_rad: &dyn Fn(f64) -> f64) -> Option<Self> {
        let half_tangent = |radius: f64| (0.5 * angle_rad(radius)).tan();
        let series = ChebyshevSeries::fit(max_radius, MAX_TANGENT_ERROR, &half_tangent)?;
        Some(Self { series, max_radius: max_radius as f32 })
    }
}
