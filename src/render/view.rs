//! Views: a camera with a pose in the world, at rest or in motion while its rows are exposed.

use glam::{DMat3, DVec2, DVec3};

use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;

/// A camera with a pose in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Size, intrinsics and lens.
    pub camera: Camera,
    /// The camera's pose at the end of the exposure.
    pub world_from_camera: Pose,
    /// The camera's motion while its rows are exposed; `None` if all are exposed at once, or the
    /// camera is at rest.
    pub rolling_shutter: Option<RollingShutter>,
    /// In which order its rows or columns are exposed, if one after the other: actors move during
    /// the exposure even if the camera is at rest. Without it, as in `rolling_shutter`.
    pub readout: Option<ShutterDirection>,
}

/// The motion of a camera during one exposure: [`Pose::interpolate`] at constant speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingShutter {
    /// In which order rows or columns are exposed.
    pub direction: ShutterDirection,
    /// The camera's pose when the first row or column is exposed.
    pub world_from_camera_first: Pose,
}

/// A rolling shutter relative to the camera's frame at the end of the exposure, so that f32 loses
/// little: the remaining part of the exposure, and of the camera's motion, while a place of the
/// image is exposed. The motion is that of [`Pose::interpolate`].
#[derive(Clone, Copy, Debug)]
pub(super) struct ShutterMotion {
    /// `[a, b, c]`: at (x, y) of the image, in pixels, the fraction `a x + b y + c` of the exposure
    /// remains, clamped to 0 to 1.
    pub(super) remaining: [f64; 3],
    /// The camera's translation during the whole exposure, in metres, in world axes.
    pub(super) translation_world_m: DVec3,
    /// This translation in the camera's frame at the end of the exposure.
    pub(super) translation_m: DVec3,
    /// Unit axis of the camera's rotation during the exposure, in its own frame.
    pub(super) axis: DVec3,
    /// The angle of that rotation, in radians.
    pub(super) rotation_rad: f64,
}

/// A point of the world on the image of a camera that may move.
#[derive(Clone, Copy, Debug)]
pub struct ProjectedPoint {
    /// Its position in pixels, which may be outside of the image.
    pub at_px: DVec2,
    /// When it is exposed, as a fraction of the exposure: 0 with the first row, 1 with the last.
    pub fraction: f64,
    /// The camera's pose then.
    pub world_from_camera: Pose,
    /// The point in the camera's frame then, in metres.
    pub point_m: DVec3,
}

impl View {
    /// Most rounds of the search for the row that sees a point.
    const MAX_ROUNDS: u32 = 32;

    /// The search ends when the moment changes by at most this fraction of the exposure: 1e-7 of 1
    /// m.
    const CONVERGED: f64 = 1e-7;

    /// A camera at rest.
    pub fn new(camera: Camera, world_from_camera: Pose) -> Self {
        Self { camera, world_from_camera, rolling_shutter: None, readout: None }
    }

    /// The cameras of a rig at rest.
    pub fn from_rig(cameras: &[RigCamera], world_from_rig: Pose) -> Vec<Self> {
        Self::from_moving_rig(cameras, world_from_rig, &|_| world_from_rig)
    }

    /// The cameras of a rig with the pose `world_from_rig` now, and the pose
    /// `world_from_rig_before(age_us)` that many microseconds ago, which cameras with a rolling
    /// shutter need.
    pub fn from_moving_rig(
        cameras: &[RigCamera],
        world_from_rig: Pose,
        world_from_rig_before: &dyn Fn(i64) -> Pose,
    ) -> Vec<Self> {
        let view = |camera: &RigCamera| {
            let world_from_camera = world_from_rig * camera.rig_from_camera;
            // A camera at rest is kept as such: a static pinhole has its own, faster path.
            let rolling_shutter = camera.shutter.and_then(|shutter| {
                let before = world_from_rig_before(shutter.duration_us);
                let world_from_camera_first = before * camera.rig_from_camera;
                let moves = !same_pose(&world_from_camera_first, &world_from_camera);
                moves.then_some(RollingShutter {
                    direction: shutter.direction,
                    world_from_camera_first,
                })
            });
            let readout = camera.shutter.map(|shutter| shutter.direction);
            Self { camera: camera.camera, world_from_camera, rolling_shutter, readout }
        };
        cameras.iter().map(view).collect()
    }

    /// The time from the first row of a camera's image to its last, in microseconds: how long
    /// before a frame's time [`PlacedChunk::world_from_actor_at_start`] is. 0 without a rolling
    /// shutter.
    pub fn exposure_us(camera: &RigCamera) -> i64 {
        camera.shutter.map_or(0, |shutter| shutter.duration_us)
    }

    /// The longest exposure of some cameras, in microseconds.
    pub fn longest_exposure_us(cameras: &[RigCamera]) -> i64 {
        cameras.iter().map(Self::exposure_us).max().unwrap_or(0)
    }

    /// This view from an actor's axes: how the camera sees the Gaussians of a placed chunk.
    ///
    /// The camera's motion relative to the actor is taken as that of [`Pose::interpolate`] between
    /// its ends. This is exact for an actor that does not turn. For one that turns by an angle α
    /// during the exposure, the camera's arc around it at a distance r is replaced by the chord,
    /// which is r α²/8 away: 0.6 mm at 20 m, 0.5 rad/s and 30 ms.
    pub fn seen_from(&self, placed: &PlacedChunk) -> Self {
        let last = relative_pose(&placed.world_from_actor, &self.world_from_camera);
        let from_shutter = self.rolling_shutter.map(|shutter| shutter.direction);
        let rolling_shutter = self.readout.or(from_shutter).and_then(|direction| {
            let world_from_camera_first = self
                .rolling_shutter
                .map_or(self.world_from_camera, |shutter| shutter.world_from_camera_first);
            let first = relative_pose(&placed.world_from_actor_at_start, &world_from_camera_first);
            let moves = !same_pose(&first, &last);
            moves.then_some(RollingShutter { direction, world_from_camera_first: first })
        });
        Self { world_from_camera: last, rolling_shutter, ..*self }
    }

    /// Whether it is a pinhole at rest, without a windshield: the camera that one matrix projects.
    pub fn is_static_pinhole(&self) -> bool {
        self.camera.is_pinhole() && self.rolling_shutter.is_none()
    }

    /// The camera's pose when a place of its image, in pixels, is exposed.
    pub fn world_from_camera_at(&self, at_px: DVec2) -> Pose {
        match &self.rolling_shutter {
            None => self.world_from_camera,
            Some(rolling_shutter) => self.world_from_camera_at_fraction(
                rolling_shutter.direction.fraction(at_px, &self.camera),
            ),
        }
    }

    /// The unit direction, in the world, in which a place of the image, in pixels, looks; `None`
    /// outside of the lens' field. The ray's origin is the position of
    /// [`View::world_from_camera_at`].
    pub fn ray_world(&self, at_px: DVec2) -> Option<DVec3> {
        let direction = self.camera.unproject(at_px)?;
        Some(self.world_from_camera_at(at_px).rotation * direction)
    }

    /// For a static pinhole: rows that take `(x, y, 1)` of the image to a direction in a sky's
    /// axes, of any length. f32 is accurate to 1e-7 rad, since only the direction matters.
    pub(super) fn sky_from_pixel(&self, sky_from_world: DMat3) -> [[f32; 3]; 3] {
        let p = &self.camera.pinhole;
        let camera_from_pixel = DMat3::from_cols(
            DVec3::new(1.0 / p.fx, 0.0, 0.0),
            DVec3::new(0.0, 1.0 / p.fy, 0.0),
            DVec3::new(-p.cx / p.fx, -p.cy / p.fy, 1.0),
        );
        let world_from_camera = self.world_from_camera.rotation_matrix();
        let rows = (sky_from_world * world_from_camera * camera_from_pixel).transpose();
        rows.to_cols_array_2d().map(|row| row.map(|value| value as f32))
    }

    /// Rows that take directions in the camera's frame at the end of the exposure to a sky's axes.
    pub(super) fn sky_from_camera(&self, sky_from_world: DMat3) -> [[f32; 3]; 3] {
        let rows = (sky_from_world * self.world_from_camera.rotation_matrix()).transpose();
        rows.to_cols_array_2d().map(|row| row.map(|value| value as f32))
    }

    /// The image of a point of the world, in pixels; `None` outside of the lens' field.
    pub fn project_world(&self, point_m: DVec3) -> Option<DVec2> {
        self.camera.project(self.project_extrapolated(point_m, 1.0).point_m)
    }

    /// The image of a point of the world, with the lens extrapolated beyond its field.
    ///
    /// With a rolling shutter, the row decides when a point is exposed, that decides the camera's
    /// pose, and the pose decides the row. A fixed-point iteration finds the moment, beginning with
    /// `first_guess`. Each round multiplies the error by what the image moves per row: a tenth for
    /// an object that passes close by. Where an object passes so close that a round leaves more
    /// than half of the error, the interval between a moment that is too early and one that is too
    /// late is halved instead. An object that moves over the image as fast as the rows are read may
    /// have several solutions; it is found on one of them, or outside of the image.
    #[inline(always)]
    pub fn project_extrapolated(&self, world_m: DVec3, first_guess: f64) -> ProjectedPoint {
        let project_at = |fraction: f64, world_from_camera: Pose| {
            let from_camera_m = world_m - world_from_camera.position_m;
            let point_m = world_from_camera.rotation.inverse() * from_camera_m;
            let at_px = self.camera.project_extrapolated(point_m);
            ProjectedPoint { at_px, fraction, world_from_camera, point_m }
        };
        let Some(rolling_shutter) = &self.rolling_shutter else {
            return project_at(1.0, self.world_from_camera);
        };
        let mut projected =
            project_at(first_guess, self.world_from_camera_at_fraction(first_guess));
        // Invariant: the moment is not before `earliest` and not after `latest`.
        let mut earliest = 0.0;
        let mut latest = 1.0;
        let mut error_before = f64::INFINITY;
        for _ in 0..Self::MAX_ROUNDS {
            let exposed = rolling_shutter.direction.fraction(projected.at_px, &self.camera);
            let error = exposed - projected.fraction;
            if error.abs() <= Self::CONVERGED {
                break;
            }
            // The row is exposed later than was assumed: the moment was too early.
            if error > 0.0 {
                earliest = projected.fraction;
            } else {
                latest = projected.fraction;
            }
            // The fixed point's own step if it halves the error and stays in the interval, or else
            // a bisection: 32 rounds give 2^-32 at worst.
            let converges =
                error.abs() <= 0.5 * error_before && (earliest..=latest).contains(&exposed);
            let next = if converges { exposed } else { 0.5 * (earliest + latest) };
            error_before = error.abs();
            projected = project_at(next, self.world_from_camera_at_fraction(next));
        }
        projected
    }

    /// The rolling shutter relative to the end of the exposure; `None` if the camera does not move.
    pub(super) fn shutter_motion(&self) -> Option<ShutterMotion> {
        let RollingShutter { direction, world_from_camera_first: first } =
            self.rolling_shutter.as_ref()?;
        let last = &self.world_from_camera;
        let Camera { width_px, height_px, .. } = self.camera;
        // Slope and offset of the remaining fraction along an axis: 1 at the middle of the first
        // row or column, 0 at the middle of the last; a single row is the last one.
        let along = |size_px: u32| {
            let last_px = f64::from(size_px) - 1.0;
            // At pixel centre 0.5 the value is 1, at last_px + 0.5 it is 0.
            if last_px > 0.0 { [-1.0 / last_px, 1.0 + 0.5 / last_px] } else { [0.0; 2] }
        };
        let columns = along(width_px);
        let rows = along(height_px);
        // Slope and offset for the opposite direction.
        let reversed =
            // Replace x by size - x.
            |[slope, start]: [f64; 2], size_px: u32| [-slope, start + slope * f64::from(size_px)];
        let remaining = match direction {
            ShutterDirection::TopToBottom => [0.0, rows[0], rows[1]],
            ShutterDirection::BottomToTop => {
                let [slope, start] = reversed(rows, height_px);
                [0.0, slope, start]
            }
            ShutterDirection::LeftToRight => [columns[0], 0.0, columns[1]],
            ShutterDirection::RightToLeft => {
                let [slope, start] = reversed(columns, width_px);
                [slope, 0.0, start]
            }
        };
        let translation_world_m = last.position_m - first.position_m;
        // In the camera's own axes. The axis is the same in those of the first pose and of the
        // last.
        let turn = first.rotation.inverse() * last.rotation;
        // Take the quaternion of the rotation that has the smaller angle; the other has the
        // opposite sign.
        let rotation = if turn.w < 0.0 { -turn } else { turn };
        let sine = rotation.xyz().length();
        Some(ShutterMotion {
            remaining,
            translation_world_m,
            translation_m: last.rotation.inverse() * translation_world_m,
            axis: if sine > 0.0 { rotation.xyz() / sine } else { DVec3::Z },
            // atan2 and not acos, which is inaccurate for small angles.
            rotation_rad: 2.0 * sine.atan2(rotation.w),
        })
    }

    /// The camera's pose at a fraction of the exposure.
    #[inline(always)]
    fn world_from_camera_at_fraction(&self, fraction: f64) -> Pose {
        match &self.rolling_shutter {
            None => self.world_from_camera,
            Some(rolling_shutter) => rolling_shutter
                .world_from_camera_first
                .interpolate(&self.world_from_camera, fraction),
        }
    }
}

/// `world_from_a⁻¹ world_from_b`. Positions are subtracted first, so that little is lost far from
/// the world's origin.
fn relative_pose(world_from_a: &Pose, world_from_b: &Pose) -> Pose {
    let a_from_world = world_from_a.rotation.inverse();
    Pose {
        // In this order; a product of the two poses would cancel large coordinates.
        position_m: a_from_world * (world_from_b.position_m - world_from_a.position_m),
        rotation: (a_from_world * world_from_b.rotation).normalize(),
    }
}

/// Whether two poses differ by rounding at most: a nanometre, and 1e-12 rad.
fn same_pose(a: &Pose, b: &Pose) -> bool {
    // q and -q are the same rotation.
    let rotation = (a.rotation - b.rotation).length().min((a.rotation + b.rotation).length());
    a.position_m.distance(b.position_m) <= 1e-9 && rotation <= 1e-12
}
