//! What a device is told of lenses and rolling shutters: with the first frame that has either.
//!
//! WGSL: `shaders/lens.wgsl`. The models are in `geometry/camera`, the search for rows in `render/view.rs`.

use bytemuck::Zeroable;
use glam::{DMat2, DVec2};
use wgpu::{BindingResource, BufferUsages};

use super::device::Device;
use super::growing::Growing;
use super::layout::Lens;
use crate::unscented::max_center_angle_rad;
use crate::view::ShutterMotion;
use crate::{Frame, MAX_VIEWS, View};
use wildcity_scene::geometry::camera::{
    self, FTheta, FThetaReference, Fisheye, MonotonePolynomial, OpenCv, Windshield,
    WindshieldReference,
};

/// The views' lenses on the device.
#[derive(Debug, Default)]
pub(super) struct Lenses {
    buffer: Option<Growing>,
}

impl Lenses {
    /// Sends what a frame's views have; nothing, where all are pinholes at rest.
    pub(super) fn hold(&mut self, device: &Device, frame: &Frame<'_>) {
        if frame.views.iter().all(View::is_static_pinhole) {
            return;
        }
        let mut lenses = [Lens::zeroed(); MAX_VIEWS];
        for (lens, view) in
            lenses.iter_mut().zip(frame.views).filter(|(_, v)| !v.is_static_pinhole())
        {
            *lens = Lens::of(view);
        }
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = self.buffer.get_or_insert_with(|| Growing::new(device, "lenses", usage));
        buffer.fill(device, bytemuck::cast_slice(&lenses));
    }

    /// Where shaders find them; `None` until there were any.
    pub(super) fn bind(&self) -> Option<(u32, BindingResource<'_>)> {
        self.buffer.as_ref().map(|buffer| (12, buffer.bind()))
    }
}

impl Lens {
    fn of(view: &View) -> Self {
        let camera = &view.camera;
        let pinhole = &camera.pinhole;
        let mut lens = Self {
            center_px: [pinhole.cx as f32, pinhole.cy as f32],
            linear: columns(DMat2::from_diagonal(DVec2::new(pinhole.fx, pinhole.fy))),
            widest_rad: max_center_angle_rad(camera) as f32,
            by_distance: camera.depth_is_distance().into(),
            bent: 1,
            ..Self::zeroed()
        };
        match &camera.lens {
            camera::Lens::Pinhole => lens.set_end(camera.extrapolation_slope()),
            camera::Lens::OpenCv(of) => {
                lens.set_opencv(of);
                lens.set_end(camera.extrapolation_slope().min(of.limit_slope()));
            }
            camera::Lens::Fisheye(of) => lens.set_fisheye(of),
            camera::Lens::FTheta(of) => lens.set_ftheta(of),
        }
        if let Some(windshield) = &camera.windshield {
            lens.set_windshield(windshield);
        }
        if let Some(still) = view.shutter_motion() {
            lens.set_rolling(&still);
        }
        lens
    }

    fn set_end(&mut self, slope: f64) {
        (self.end, self.end_rad) = (slope as f32, slope.atan() as f32);
    }

    fn set_opencv(&mut self, lens: &OpenCv) {
        let ([k1, k2, k3, k4, k5, k6], [p1, p2], s) = (lens.k(), lens.p(), lens.s());
        self.model = 1;
        self.c = [[k1, k2, k3, k4], [k5, k6, p1, p2], s].map(|row| row.map(|value| value as f32));
    }

    fn set_fisheye(&mut self, lens: &Fisheye) {
        self.model = 2;
        self.set_rising(lens.radius());
    }

    fn set_ftheta(&mut self, lens: &FTheta) {
        self.model = match lens.reference() {
            FThetaReference::AngleToPixel => 2,
            FThetaReference::PixelToAngle => 3,
        };
        self.linear = columns(lens.linear());
        self.set_rising(lens.rising());
    }

    /// In shares of the end no power of a distance in pixels leaves f32.
    fn set_rising(&mut self, rising: &MonotonePolynomial) {
        let end = rising.end();
        self.end = end as f32;
        self.end_value = rising.at(end) as f32;
        self.end_slope = rising.slope(end) as f32;
        let scaled = rising.coefficients().iter().zip(0..).map(|(c, power)| c * end.powi(power));
        for (to, c) in self.c.as_flattened_mut().iter_mut().zip(scaled.skip(1)) {
            *to = c as f32;
        }
    }

    /// Its polynomials less the angles themselves, padded to order 5.
    fn set_windshield(&mut self, windshield: &Windshield) {
        self.windshield = match windshield.reference() {
            WindshieldReference::Forward => 1,
            WindshieldReference::Backward => 2,
        };
        for (axis, polynomial) in
            [windshield.horizontal(), windshield.vertical()].iter().enumerate()
        {
            let mut place = 0;
            for j in 0..=5 {
                for i in 0..=5 - j {
                    let own = if [i, j] == [1 - axis, axis] { 1.0 } else { 0.0 };
                    self.bend[place][axis] = (polynomial.coefficient(i, j) - own) as f32;
                    place += 1;
                }
            }
        }
    }

    fn set_rolling(&mut self, still: &ShutterMotion) {
        let [a, b, c] = still.remaining.map(|value| value as f32);
        self.rolls = [a, b, c, 0.0];
        self.moved_world_m = still.translation_world_m.as_vec3().to_array();
        self.moved_m = still.translation_m.as_vec3().to_array();
        self.turned = still.axis.extend(still.rotation_rad).as_vec4().to_array();
    }
}

fn columns(m: DMat2) -> [f32; 4] {
    m.to_cols_array().map(|value| value as f32)
}
