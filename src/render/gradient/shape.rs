//! From a splat back to the Gaussian in space, in f64: the derivatives of its projection.
//!
//! A static pinhole is linearised at the centre, with the derivatives of that linearisation. Every
//! other camera has six points projected, each with the lens' own derivatives there, and with those
//! of the moment at which a rolling shutter exposes it.

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::Twist;
use crate::constants::{MIN_BLUR_SHARE, SLOPE_SLACK};
use crate::view::ProjectedPoint;
use crate::{RollingShutter, View};
use wildcity_scene::geometry::Camera;

/// The derivatives of a loss by a splat's place and shape.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct FootprintGradient {
    pub(crate) mean_px: DVec2,
    /// By the covariance after the filter (xx, xy, yy), as a symmetric matrix: the change of the
    /// loss is `xx dxx + 2 xy dxy + yy dyy`.
    pub(crate) covariance: DVec3,
    /// By the logarithm of the determinant before the blur as a share of that after it, where it
    /// exceeds [`MIN_BLUR_SHARE`].
    pub(crate) ln_blur_share: f64,
    /// By the logarithm of the determinant after the blur of native pixels.
    pub(crate) ln_det_native: f64,
    /// The variances of that blur, along x and y.
    pub(crate) native_px2: DVec2,
    pub(crate) depth_m: f64,
    /// Whether depth is z for every lens, and not [`Camera::depth_m`].
    pub(crate) depth_is_z: bool,
    /// By the vector from the camera to the centre, in world axes.
    pub(crate) toward: DVec3,
}

/// The derivatives of a loss by a Gaussian's place and shape, and by the camera's pose.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ShapeGradient {
    pub(crate) mean_m: DVec3,
    /// By the axes times their standard deviations, which are the columns.
    pub(crate) axes_m: DMat3,
    pub(crate) twist: Twist,
}

impl ShapeGradient {
    /// The derivatives by the logarithms of the standard deviations, and by the unit quaternion
    /// (w, x, y, z) tangentially, of a Gaussian with these axes.
    ///
    /// A rotation by a small δ changes the axes by `δ × axis` and a quaternion q by
    /// `½ (0, δ) q`, so that with the torque `t = Σ axis × v_axis` the latter's derivative is
    /// `2 (0, t) q`: it is tangential by itself, as that of a normalised quaternion must be.
    pub(crate) fn to_scale_and_rotation(
        self,
        axes_m: DMat3,
        rotation: DQuat,
    ) -> ([f64; 3], [f64; 4]) {
        let ln_scale = [0, 1, 2].map(|k| axes_m.col(k).dot(self.axes_m.col(k)));
        let torque: DVec3 = (0..3).map(|k| axes_m.col(k).cross(self.axes_m.col(k))).sum();
        let DQuat { x, y, z, w } = DQuat::from_vec4(torque.extend(0.0)) * rotation;
        (ln_scale, [w, x, y, z].map(|value| 2.0 * value))
    }
}

impl FootprintGradient {
    /// From the image back to a Gaussian with this centre and these axes, all in the world.
    pub(crate) fn to_shape(self, view: &View, mean_m: DVec3, axes_m: DMat3) -> ShapeGradient {
        if view.is_static_pinhole() {
            self.to_shape_by_pinhole(view, mean_m, axes_m)
        } else {
            self.to_shape_by_points(view, mean_m, axes_m)
        }
    }

    /// The derivatives by the columns of a root of the covariance before the filter, `2 V column`.
    ///
    /// Its determinant is the sum of the squares of the root's minors: `xx yy - xy²` would cancel
    /// for needles. The logarithm of a determinant has the derivative `C⁻¹`.
    fn by_root<const N: usize>(self, root: &[DVec2; N]) -> [DVec2; N] {
        let [mut xx, mut xy, mut yy, mut det] = [0.0; 4];
        for (i, column) in root.iter().enumerate() {
            xx += column.x * column.x;
            xy += column.x * column.y;
            yy += column.y * column.y;
            det += root[..i].iter().map(|other| column.perp_dot(*other).powi(2)).sum::<f64>();
        }
        let native = self.native_px2;
        let det_native = det + native.x * (yy + native.y) + native.y * xx;
        let mut by_covariance = self.covariance;
        let mut by_native = self.ln_det_native;
        if det > MIN_BLUR_SHARE * det_native {
            by_covariance += self.ln_blur_share / det * DVec3::new(yy, -xy, xx);
            by_native -= self.ln_blur_share;
        }
        by_covariance += by_native / det_native * DVec3::new(yy + native.y, -xy, xx + native.x);
        let DVec3 { x: v_xx, y: v_xy, z: v_yy } = by_covariance;
        root.map(|column| {
            2.0 * DVec2::new(v_xx * column.x + v_xy * column.y, v_xy * column.x + v_yy * column.y)
        })
    }

    fn to_shape_by_pinhole(self, view: &View, mean_m: DVec3, axes_m: DMat3) -> ShapeGradient {
        let camera_from_world = view.world_from_camera.inverse();
        let point_m = camera_from_world.transform_point(mean_m);
        let axes = camera_from_world.rotation_matrix() * axes_m;
        let Linearisation { rows, is_clamped, .. } = Linearisation::new(point_m, &view.camera);

        // The root of the covariance, `J axes`, and the derivatives by it.
        let root = axes.to_cols_array_2d().map(|axis| {
            let axis = DVec3::from_array(axis);
            DVec2::new(rows[0].dot(axis), rows[1].dot(axis))
        });
        let by_root = self.by_root(&root);

        // By the axes, `Jᵀ v`, and by the rows of J.
        let mut by_axes = DMat3::ZERO;
        let mut by_rows = [DVec3::ZERO; 2];
        for (k, v) in by_root.iter().enumerate() {
            *by_axes.col_mut(k) = v.x * rows[0] + v.y * rows[1];
            by_rows[0] += v.x * axes.col(k);
            by_rows[1] += v.y * axes.col(k);
        }

        // A row is (f/z)(1, 0, -slope): its derivatives by z and by the slope, which has none where
        // it is clamped; and those of the centre, f slope + c, where it never is.
        let focal_px = [view.camera.pinhole.fx, view.camera.pinhole.fy];
        let slope = point_m.truncate() / point_m.z;
        let mut by_point = DVec3::ZERO;
        for axis in 0..2 {
            let mut by_slope = focal_px[axis] * self.mean_px[axis];
            if !is_clamped[axis] {
                by_slope -= focal_px[axis] / point_m.z * by_rows[axis].z;
            }
            by_point[axis] += by_slope / point_m.z;
            by_point.z -= by_slope * slope[axis] / point_m.z;
            by_point.z -= by_rows[axis].dot(rows[axis]) / point_m.z;
        }
        by_point.z += self.depth_m;

        let world_from_camera = view.world_from_camera.rotation;
        let toward = world_from_camera.inverse() * self.toward;
        let torque: DVec3 = (0..3).map(|k| axes.col(k).cross(by_axes.col(k))).sum();
        ShapeGradient {
            mean_m: world_from_camera * by_point + self.toward,
            axes_m: DMat3::from_quat(world_from_camera) * by_axes,
            twist: Twist { rho: by_point + toward, phi: point_m.cross(by_point) + torque },
        }
    }

    fn to_shape_by_points(self, view: &View, mean_m: DVec3, axes_m: DMat3) -> ShapeGradient {
        let center = view.project_extrapolated(mean_m, 1.0);
        let project = |k: usize, side: f64| {
            let point_m = mean_m + side * 3.0_f64.sqrt() * axes_m.col(k);
            view.project_extrapolated(point_m, center.fraction)
        };
        let points = [0, 1, 2].map(|k| [project(k, 1.0), project(k, -1.0)]);
        let mean_px = points.iter().flatten().map(|point| point.at_px).sum::<DVec2>() / 6.0;
        let mut root = [DVec2::ZERO; 6];
        for (column, point) in root.iter_mut().zip(points.iter().flatten()) {
            *column = (point.at_px - mean_px) / 6.0_f64.sqrt();
        }
        let by_root = self.by_root(&root);

        let mut shape = ShapeGradient::default();
        let mut add = |point: &ProjectedPoint, by_px: DVec2, by_point: DVec3, by_moment: f64| {
            let by_point = point_gradient(view, point, by_px, by_point, by_moment);
            shape.twist.rho += by_point;
            shape.twist.phi += point.point_m.cross(by_point);
            let by_world = point.world_from_camera.rotation * by_point;
            shape.mean_m += by_world;
            by_world
        };
        let mut by_axes = DMat3::ZERO;
        for (k, sides) in points.iter().enumerate() {
            for (side, point) in sides.iter().enumerate() {
                // The columns add up to 0, so that the mean in each of them has no derivative.
                let by_px = self.mean_px / 6.0 + by_root[2 * k + side] / 6.0_f64.sqrt();
                let by_world = add(point, by_px, DVec3::ZERO, 0.0);
                let side = if side == 0 { 1.0 } else { -1.0 };
                *by_axes.col_mut(k) += side * 3.0_f64.sqrt() * by_world;
            }
        }

        // Depth and viewing direction, at the moment at which the centre is exposed.
        let is_distance = view.camera.depth_is_distance() && !self.depth_is_z;
        let per_m = if is_distance { center.point_m.normalize() } else { DVec3::Z };
        let by_depth = self.depth_m * per_m;
        // The direction is the centre minus the camera's position, which moves.
        let by_moment = -self.toward.dot(velocity(view).0);
        add(&center, DVec2::ZERO, by_depth, by_moment);
        shape.mean_m += self.toward;
        shape.twist.rho += center.world_from_camera.rotation.inverse() * self.toward;
        shape.axes_m = by_axes;
        shape
    }
}

/// Least difference between the speed of a point's image and that of the readout, as a share of the
/// latter, at which the moment of the point has a derivative. Where both are equal, the point is
/// exposed all the time: its derivative has a pole, and one such point would be all of the view's
/// twist.
const LEAST_SLIP: f64 = 0.1;

/// The derivatives of a loss by a point of the camera's frame at the moment of its exposure, given
/// those by the point's image, directly by the point, and by that moment.
///
/// A place of the image has its moment, `f = f(px)`, and the point moves in the camera's frame
/// during the exposure: `dpx = J (dp + p′ df)` and `df = g dpx`. So the derivatives by the moment
/// add `g` times themselves to those by the image, and `dpx = (I - J p′ gᵀ)⁻¹ J dp`, whose
/// transpose takes v to `v + g (J p′ · v)/(1 - g · J p′)`.
fn point_gradient(
    view: &View,
    point: &ProjectedPoint,
    mut by_px: DVec2,
    by_point: DVec3,
    by_moment: f64,
) -> DVec3 {
    let [jx, jy] = lens_jacobian(&view.camera, point.point_m);
    if let Some(shutter) = &view.rolling_shutter {
        let moment_per_px = fraction_gradient(shutter, view, point.at_px);
        let motion = motion_of_point(view, point);
        let motion_px = DVec2::new(jx.dot(motion), jy.dot(motion));
        by_px += (by_moment + by_point.dot(motion)) * moment_per_px;
        let slip = 1.0 - moment_per_px.dot(motion_px);
        if slip.abs() >= LEAST_SLIP {
            by_px += moment_per_px * (motion_px.dot(by_px) / slip);
        }
    }
    by_point + by_px.x * jx + by_px.y * jy
}

/// Rows of `∂pixel/∂point`, in px/m, at which the pinhole is linearised.
struct Linearisation {
    rows: [DVec3; 2],
    /// Whether the slope x/z, or y/z, of the centre is beyond the image's edges and the slack.
    is_clamped: [bool; 2],
}

impl Linearisation {
    fn new(point_m: DVec3, camera: &Camera) -> Self {
        let p = &camera.pinhole;
        let mut rows = [DVec3::ZERO; 2];
        let mut is_clamped = [false; 2];
        let axes = [(p.fx, p.cx, camera.width_px), (p.fy, p.cy, camera.height_px)];
        for (axis, (focal_px, center_px, size_px)) in axes.into_iter().enumerate() {
            let size_px = f64::from(size_px);
            let slack = SLOPE_SLACK * 0.5 * size_px / focal_px;
            let least = -center_px / focal_px - slack;
            let most = (size_px - center_px) / focal_px + slack;
            let slope = point_m[axis] / point_m.z;
            is_clamped[axis] = slope < least || slope > most;
            rows[axis][axis] = focal_px / point_m.z;
            rows[axis].z = -focal_px / point_m.z * slope.clamp(least, most);
        }
        Self { rows, is_clamped }
    }
}

/// The rows of `∂pixel/∂point` of a camera at rest, in px/m, by central differences.
///
/// The step is in proportion to the distance: its rounding (1e-16/1e-5) and its curvature (1e-10)
/// are both far below what f32 resolves.
fn lens_jacobian(camera: &Camera, point_m: DVec3) -> [DVec3; 2] {
    let h = 1e-5 * point_m.length();
    let mut rows = [DVec3::ZERO; 2];
    for (k, axis) in DVec3::AXES.into_iter().enumerate() {
        let ahead_px = camera.project_extrapolated(point_m + h * axis);
        let behind_px = camera.project_extrapolated(point_m - h * axis);
        let per_m = (ahead_px - behind_px) / (2.0 * h);
        rows[0][k] = per_m.x;
        rows[1][k] = per_m.y;
    }
    rows
}

/// The camera's velocity in the world, and its angular velocity in its own axes, per exposure.
fn velocity(view: &View) -> (DVec3, DVec3) {
    match view.shutter_motion() {
        None => (DVec3::ZERO, DVec3::ZERO),
        Some(motion) => (motion.translation_world_m, motion.rotation_rad * motion.axis),
    }
}

/// How a point at rest moves in the camera's frame at the moment of its exposure, in metres per
/// exposure.
fn motion_of_point(view: &View, point: &ProjectedPoint) -> DVec3 {
    let (translation_m, rotation) = velocity(view);
    -(point.world_from_camera.rotation.inverse() * translation_m) - rotation.cross(point.point_m)
}

/// The change of the moment of exposure, as a fraction of the exposure, per pixel; 0 before the
/// first row and after the last.
fn fraction_gradient(shutter: &RollingShutter, view: &View, at_px: DVec2) -> DVec2 {
    let fraction = |at_px: DVec2| shutter.direction.fraction(at_px, &view.camera);
    let here = fraction(at_px);
    let is_between = here > 0.0 && here < 1.0;
    if !is_between {
        return DVec2::ZERO;
    }
    // Linear between its ends: any two places of the image give the slope.
    let middle_px = 0.5 * view.camera.size_px();
    let per_px =
        |axis: DVec2| fraction(middle_px + 0.25 * axis) - fraction(middle_px - 0.25 * axis);
    2.0 * DVec2::new(per_px(DVec2::X), per_px(DVec2::Y))
}
