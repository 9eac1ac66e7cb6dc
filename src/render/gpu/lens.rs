//! Parameters of lenses, windshields, and rolling shutters on the device, uploaded from the first
//! frame on that has one of them. Frames with only static pinhole cameras have no such buffer or
//! binding, and their shaders have no test for them.
//!
//! f32 suffices, since no large numbers cancel: polynomials take fractions of the lens' field,
//! those of a windshield give only the change of the angles, and a rolling camera is described by
//! its pose at the end of the exposure and the small motion back from there. WGSL's `atan2` and
//! `sin` may be off by 2^-11, so `shaders/shared/angle.wgsl` has fits of its own.
//!
//! WGSL: `shaders/lens.wgsl`. The lens models are in the scene package (`geometry::camera`), the
//! search for the row that sees a point in `render/view.rs`.

use bytemuck::Zeroable;
use glam::{DMat2, DVec2};
use wgpu::{BindingResource, BufferUsages};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::layout::Lens;
use crate::actor_views::ActorViews;
use crate::expansion::ExpansionBound;
use crate::unscented::max_center_angle_rad;
use crate::view::ShutterMotion;
use crate::{Frame, MAX_VIEWS, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::camera::{
    self, FTheta, FThetaReference, Fisheye, MonotonePolynomial, OpenCv, Windshield,
    WindshieldReference,
};

/// The lenses of a frame's views on the device.
#[derive(Debug, Default)]
pub(super) struct Lenses {
    buffer: Option<GrowableBuffer>,
}

impl Lenses {
    /// Uploads the lenses of a frame's views; nothing if all are static pinholes. The views of
    /// actors that move relative to the camera while a shutter rolls follow, in the order of
    /// [`LensIndices`].
    pub(super) fn upload(&mut self, device: &Device, frame: &Frame<'_>, actors: &ActorViews) {
        let is_own = |(view, relative): &(&View, &View)| has_own_lens(view, relative);
        let views = frame.views.iter().zip(actors.all());
        let pairs =
            views.flat_map(|(view, relative)| relative.iter().map(move |from| (view, from)));
        let mut own =
            pairs.filter(is_own).map(|(_, relative)| Lens::new(relative, frame.profile)).peekable();
        // The shaders of such a frame bind no lenses: what an earlier frame has uploaded is not
        // read.
        if frame.views.iter().all(View::is_static_pinhole) && own.peek().is_none() {
            return;
        }
        // A place for every view that a frame may have, so that the lenses of actors begin at
        // MAX_VIEWS whatever the number of views.
        let mut lenses = vec![Lens::zeroed(); MAX_VIEWS];
        for (lens, view) in lenses.iter_mut().zip(frame.views) {
            if !view.is_static_pinhole() {
                *lens = Lens::new(view, frame.profile);
            }
        }
        lenses.extend(own);
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer =
            self.buffer.get_or_insert_with(|| GrowableBuffer::new(device, "lenses", usage));
        buffer.fill(device, bytemuck::cast_slice(&lenses));
    }

    /// The lenses as a shader's resource; `None` if no frame has had any.
    pub(super) fn bind(&self) -> Option<(u32, BindingResource<'_>)> {
        self.buffer.as_ref().map(|buffer| (12, buffer.bind()))
    }
}

/// The index of each actor's lens in each view: its own, which follows those of all views, or that
/// of the view.
#[derive(Debug, Default)]
pub(super) struct LensIndices(Vec<Vec<u32>>);

impl LensIndices {
    pub(super) fn new(frame: &Frame<'_>, actors: &ActorViews) -> Self {
        // Counts view by view and, in a view, actor by actor: the order in which `Lenses::upload`
        // appends.
        let mut next = MAX_VIEWS as u32;
        let mut of_view = |(index, (view, relative)): (usize, (&View, &[View]))| {
            let mut lens = |relative: &View| {
                if !has_own_lens(view, relative) {
                    return index as u32;
                }
                next += 1;
                next - 1
            };
            relative.iter().map(&mut lens).collect()
        };
        Self(frame.views.iter().zip(actors.all()).enumerate().map(&mut of_view).collect())
    }

    /// The index of the lens with which a view sees a placed chunk.
    pub(super) fn index(&self, view: usize, placed: usize) -> u32 {
        self.0[view][placed]
    }
}

/// Whether a view sees an actor with other lens parameters than the twin: those of a rolling
/// shutter depend on the motion relative to the actor.
fn has_own_lens(view: &View, relative: &View) -> bool {
    let rolls = view.rolling_shutter.is_some() || relative.rolling_shutter.is_some();
    rolls && !relative.is_static_pinhole()
}

impl Lens {
    /// The parameters of a view that is not a static pinhole.
    fn new(view: &View, profile: &RenderProfile) -> Self {
        let camera = &view.camera;
        let pinhole = &camera.pinhole;
        let mut lens = Self {
            center_px: [pinhole.cx as f32, pinhole.cy as f32],
            linear: columns(DMat2::from_diagonal(DVec2::new(pinhole.fx, pinhole.fy))),
            widest_rad: max_center_angle_rad(camera) as f32,
            by_distance: camera.depth_is_distance().into(),
            non_pinhole: 1,
            ..Self::zeroed()
        };
        match &camera.lens {
            // The model stays 0, which the shader takes for a pinhole.
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
        if let Some(motion) = view.shutter_motion() {
            lens.set_shutter_motion(&motion);
        }
        if let Some(bound) = ExpansionBound::new(view, profile) {
            let ExpansionBound { max_error_px, second_px, third_px } = bound;
            let bound = [max_error_px, second_px, third_px, 0.0];
            lens.expansion = bound.map(|value| value as f32);
        }
        lens
    }

    /// Start of the extrapolation, as a slope.
    fn set_end(&mut self, slope: f64) {
        self.end = slope as f32;
        self.end_rad = slope.atan() as f32;
    }

    fn set_opencv(&mut self, lens: &OpenCv) {
        let [k1, k2, k3, k4, k5, k6] = lens.k();
        let [p1, p2] = lens.p();
        let rows = [[k1, k2, k3, k4], [k5, k6, p1, p2], lens.s()];
        self.model = 1;
        self.coefficients = rows.map(|row| row.map(|value| value as f32));
    }

    fn set_fisheye(&mut self, lens: &Fisheye) {
        self.model = 2;
        self.set_polynomial(lens.radius());
    }

    fn set_ftheta(&mut self, lens: &FTheta) {
        self.model = match lens.reference() {
            FThetaReference::AngleToPixel => 2,
            FThetaReference::PixelToAngle => 3,
        };
        self.linear = columns(lens.linear());
        self.set_polynomial(lens.rising());
    }

    /// The polynomial takes a fraction of its end, so that no power of a radius in pixels overflows
    /// f32.
    fn set_polynomial(&mut self, polynomial: &MonotonePolynomial) {
        let end = polynomial.end();
        self.end = end as f32;
        self.end_value = polynomial.at(end) as f32;
        self.end_slope = polynomial.slope(end) as f32;
        let scaled =
            polynomial.coefficients().iter().zip(0..).map(|(c, power)| c * end.powi(power));
        // A polynomial that does not vanish at 0 has an end of 0, so the constant term has no
        // place.
        for (to, c) in self.coefficients.as_flattened_mut().iter_mut().zip(scaled.skip(1)) {
            *to = c as f32;
        }
    }

    /// The windshield's polynomials minus the angles themselves, padded to order 5.
    fn set_windshield(&mut self, windshield: &Windshield) {
        self.windshield = match windshield.reference() {
            WindshieldReference::Forward => 1,
            WindshieldReference::Backward => 2,
        };
        for (axis, polynomial) in
            [windshield.horizontal(), windshield.vertical()].iter().enumerate()
        {
            let mut index = 0;
            for j in 0..=5 {
                for i in 0..=5 - j {
                    // The identity is the first power of the polynomial's own angle: i of the
                    // horizontal one, j of the vertical one.
                    let identity = if [i, j] == [1 - axis, axis] { 1.0 } else { 0.0 };
                    let shift = polynomial.coefficient(i, j) - identity;
                    self.windshield_shift[index][axis] = shift as f32;
                    index += 1;
                }
            }
        }
    }

    fn set_shutter_motion(&mut self, motion: &ShutterMotion) {
        let [a, b, c] = motion.remaining.map(|value| value as f32);
        self.remaining_exposure = [a, b, c, 0.0];
        self.moved_world_m = motion.translation_world_m.as_vec3().to_array();
        self.moved_m = motion.translation_m.as_vec3().to_array();
        self.axis_angle = motion.axis.extend(motion.rotation_rad).as_vec4().to_array();
    }
}

/// The columns of a matrix, one after the other.
fn columns(m: DMat2) -> [f32; 4] {
    m.to_cols_array().map(|value| value as f32)
}
