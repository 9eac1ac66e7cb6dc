//! Views: a camera somewhere in the world, at rest or on its way.

use glam::{DMat3, DVec2, DVec3};

use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;

/// A camera somewhere in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Size, intrinsics and lens.
    pub camera: Camera,
    /// Where the camera stands: at the end of the exposure.
    pub world_from_camera: Pose,
    /// How it came there while its rows were exposed; `None` if all were at once, or it stood still.
    pub rolling_shutter: Option<RollingShutter>,
}

/// The way of a camera during one exposure, straight and even.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingShutter {
    /// Which row or column is exposed first.
    pub direction: ShutterDirection,
    /// Where the camera stood then.
    pub world_from_camera_first: Pose,
}

/// A rolling shutter as seen from the exposure's end, where little is lost in f32: what is still to come while
/// a place of the image is exposed. The way is [`Pose::interpolate`]'s.
#[derive(Clone, Copy, Debug)]
pub(super) struct ShutterMotion {
    /// Of the exposure, at (x, y) of the image in pixels: the share `a x + b y + c`, from 0 to 1.
    pub(super) share: [f64; 3],
    /// Of the camera's way, for the whole exposure, in metres in the world and in the camera's frame at the
    /// end.
    pub(super) moved_world_m: DVec3,
    pub(super) moved_m: DVec3,
    /// Of its turn: about this unit axis of its own, by so many radians.
    pub(super) axis: DVec3,
    pub(super) turned_rad: f64,
}

/// Where a point of the world lands.
#[derive(Clone, Copy, Debug)]
pub struct ProjectedPoint {
    /// Where on the image or beside it, in pixels.
    pub at_px: DVec2,
    /// When it is exposed: 0 with the first row, 1 with the last.
    pub fraction: f64,
    /// Where the camera stands then.
    pub world_from_camera: Pose,
    /// The point in the camera's frame then, in metres.
    pub point_m: DVec3,
}

impl View {
    /// Rounds of the search for the row that sees a point. Each leaves of the error what the image moves per
    /// row: a tenth for what passes close by. What passes so close that this is above a half is searched by
    /// halves. Only what keeps up with the rows, and may be on many, is found on one of them or beside the
    /// image.
    const ROUNDS: u32 = 32;

    /// The search ends when it moves by less than this share of the exposure: 1e-7 of 1 m.
    const STILL: f64 = 1e-7;

    /// A camera at rest.
    pub fn new(camera: Camera, world_from_camera: Pose) -> Self {
        Self { camera, world_from_camera, rolling_shutter: None }
    }

    /// The cameras of a rig that stands still.
    pub fn of_rig(cameras: &[RigCamera], world_from_rig: Pose) -> Vec<Self> {
        Self::of_moving_rig(cameras, world_from_rig, &|_| world_from_rig)
    }

    /// The cameras of a rig that stands somewhere now, and stood at `world_from_rig_before(age_us)` so
    /// many microseconds ago: where it did matters to cameras with a rolling shutter.
    pub fn of_moving_rig(
        cameras: &[RigCamera],
        world_from_rig: Pose,
        world_from_rig_before: &dyn Fn(i64) -> Pose,
    ) -> Vec<Self> {
        let view = |camera: &RigCamera| {
            let world_from_camera = world_from_rig * camera.rig_from_camera;
            let rolling_shutter = camera.shutter.and_then(|shutter| {
                let before = world_from_rig_before(shutter.duration_us);
                let world_from_camera_first = before * camera.rig_from_camera;
                let moves = !still(&world_from_camera_first, &world_from_camera);
                moves.then_some(RollingShutter {
                    direction: shutter.direction,
                    world_from_camera_first,
                })
            });
            Self { camera: camera.camera, world_from_camera, rolling_shutter }
        };
        cameras.iter().map(view).collect()
    }

    /// Whether it is a pinhole at rest, which a matrix projects.
    pub fn is_static_pinhole(&self) -> bool {
        self.camera.is_pinhole() && self.rolling_shutter.is_none()
    }

    /// Where the camera stands when a place of its image, in pixels, is exposed.
    pub fn world_from_camera_at(&self, at_px: DVec2) -> Pose {
        match &self.rolling_shutter {
            None => self.world_from_camera,
            Some(rolling_shutter) => self.world_from_camera_at_fraction(
                rolling_shutter.direction.fraction(at_px, &self.camera),
            ),
        }
    }

    /// The unit direction in the world that a place of the image, in pixels, sees; `None` outside of
    /// the lens' field. The ray starts where [`View::world_from_camera_at`] says.
    pub fn ray_world(&self, at_px: DVec2) -> Option<DVec3> {
        let direction = self.camera.unproject(at_px)?;
        Some(self.world_from_camera_at(at_px).rotation * direction)
    }

    /// Of a pinhole at rest: rows that take `(x, y, 1)` of the image to a direction in a sky's axes, of any
    /// length. As only its direction matters, f32 is right to 1e-7 rad.
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

    /// Rows that take directions in the camera's frame at the exposure's end to a sky's axes.
    pub(super) fn sky_from_camera(&self, sky_from_world: DMat3) -> [[f32; 3]; 3] {
        let rows = (sky_from_world * self.world_from_camera.rotation_matrix()).transpose();
        rows.to_cols_array_2d().map(|row| row.map(|value| value as f32))
    }

    /// Where a point of the world lands, in pixels; `None` outside of the lens' field.
    pub fn project_world(&self, point_m: DVec3) -> Option<DVec2> {
        self.camera.project(self.project_extrapolated(point_m, 1.0).point_m)
    }

    /// Where a point of the world lands if the lens is continued beyond its field. With a rolling
    /// shutter the row decides where the camera stands, and that decides the row: found by going back
    /// and forth, from a first guess of when.
    #[inline(always)]
    pub fn project_extrapolated(&self, world_m: DVec3, guess: f64) -> ProjectedPoint {
        let landing = |fraction: f64, world_from_camera: Pose| {
            let from_camera_m = world_m - world_from_camera.position_m;
            let point_m = world_from_camera.rotation.inverse() * from_camera_m;
            let at_px = self.camera.project_extrapolated(point_m);
            ProjectedPoint { at_px, fraction, world_from_camera, point_m }
        };
        let Some(rolling_shutter) = &self.rolling_shutter else {
            return landing(1.0, self.world_from_camera);
        };
        let mut landed = landing(guess, self.world_from_camera_at_fraction(guess));
        let (mut sooner, mut later, mut off_before) = (0.0, 1.0, f64::INFINITY);
        for _ in 0..Self::ROUNDS {
            let exposed = rolling_shutter.direction.fraction(landed.at_px, &self.camera);
            let off = exposed - landed.fraction;
            if off.abs() <= Self::STILL {
                break;
            }
            if off > 0.0 {
                sooner = landed.fraction;
            } else {
                later = landed.fraction;
            }
            let closes = off.abs() <= 0.5 * off_before && (sooner..=later).contains(&exposed);
            let next = if closes { exposed } else { 0.5 * (sooner + later) };
            off_before = off.abs();
            landed = landing(next, self.world_from_camera_at_fraction(next));
        }
        landed
    }

    /// Of a rolling shutter, seen from the exposure's end.
    pub(super) fn shutter_motion(&self) -> Option<ShutterMotion> {
        let RollingShutter { direction, world_from_camera_first: first } =
            self.rolling_shutter.as_ref()?;
        let last = &self.world_from_camera;
        let Camera { width_px, height_px, .. } = self.camera;
        // 0 for the last row's middle, 1 for the first's; a single row is the last one.
        let along = |size_px: u32| {
            let last_px = f64::from(size_px) - 1.0;
            if last_px > 0.0 { [-1.0 / last_px, 1.0 + 0.5 / last_px] } else { [0.0; 2] }
        };
        let (columns, rows) = (along(width_px), along(height_px));
        let from_end =
            |[slope, start]: [f64; 2], size_px: u32| [-slope, start + slope * f64::from(size_px)];
        let share = match direction {
            ShutterDirection::TopToBottom => [0.0, rows[0], rows[1]],
            ShutterDirection::BottomToTop => {
                let [slope, start] = from_end(rows, height_px);
                [0.0, slope, start]
            }
            ShutterDirection::LeftToRight => [columns[0], 0.0, columns[1]],
            ShutterDirection::RightToLeft => {
                let [slope, start] = from_end(columns, width_px);
                [slope, 0.0, start]
            }
        };
        let moved_world_m = last.position_m - first.position_m;
        let turn = first.rotation.inverse() * last.rotation;
        // The short way round.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let sine = turn.xyz().length();
        Some(ShutterMotion {
            share,
            moved_world_m,
            moved_m: last.rotation.inverse() * moved_world_m,
            axis: if sine > 0.0 { turn.xyz() / sine } else { DVec3::Z },
            turned_rad: 2.0 * sine.atan2(turn.w),
        })
    }

    /// Where the camera stands at a fraction of the exposure.
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

/// Whether two poses are the same but for rounding: a nanometre, and 1e-12 rad.
fn still(a: &Pose, b: &Pose) -> bool {
    let turned = (a.rotation - b.rotation).length().min((a.rotation + b.rotation).length());
    a.position_m.distance(b.position_m) <= 1e-9 && turned <= 1e-12
}
