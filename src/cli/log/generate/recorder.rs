//! Drives along a twin and records.

use std::sync::Arc;

use anyhow::{anyhow, ensure};
use indicatif::ProgressBar;

use wildcity_augment::mask_png;
use wildcity_log::{ImageRow, LogWriter, SweepRow};
use wildcity_render::lidar::LidarView;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::Rig;
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::route::Route;
use wildcity_scene::trajectory::Keyframe;
use wildcity_session::{lidar_viewpoint, viewpoints};
use wildcity_twin::residency::Resident;

use super::actors::MovingActor;
use super::sensors::{self, LIDAR};

/// Period of cameras, LiDAR, boxes and satellite fixes, in microseconds.
pub(super) const PERIOD_US: i64 = 100_000;

/// Period of poses and of the inertial unit, in microseconds.
const POSE_US: i64 = 10_000;

/// Each camera exposes this long after the one before it, in microseconds.
const CAMERA_STEP_US: i64 = 7_000;

const JPEG_QUALITY: u8 = 92;

/// What records a log.
pub(super) struct Recorder<'a> {
    pub(super) resident: Arc<Resident>,
    pub(super) backend: Box<dyn Backend>,
    pub(super) route: Route<'a>,
    pub(super) rig: Rig,
    pub(super) lidar: Arc<Lidar>,
    pub(super) rig_from_lidar: Pose,
    /// What is added to the times of the LiDAR.
    pub(super) lidar_late_us: i64,
    /// Every this many images, one is left out; 0 for none.
    pub(super) drop_every: usize,
    pub(super) actors: Vec<MovingActor>,
    pub(super) geo: GeoAnchor,
}

/// An image as it was rendered.
struct Rendered {
    rgb8: Vec<u8>,
    opacity: Vec<f32>,
}

impl Recorder<'_> {
    /// Records the drive up to a length in metres. Returns the number of images.
    pub(super) fn record(
        &self,
        length_m: f64,
        log: &mut LogWriter,
        bar: &ProgressBar,
    ) -> anyhow::Result<usize> {
        let from_us = self.route.at(0.0).time_us;
        let to_us = self.route.at(length_m).time_us;
        ensure!(
            to_us - from_us >= 2 * PERIOD_US,
            "{length_m} m of the drive take {} µs: a log has at least 0.2 s; give a larger --length-m",
            to_us - from_us
        );
        self.record_poses(from_us, to_us, log)?;
        // Whole turns only: the last sweep must end before the last pose.
        let turns = (to_us - from_us) / PERIOD_US;
        bar.set_length(turns as u64);
        let mut images = 0;
        for turn in 0..turns {
            let begin_us = from_us + turn * PERIOD_US;
            images += self.record_images(turn as usize, begin_us, log)?;
            self.record_sweep(begin_us, log)?;
            bar.inc(1);
        }
        Ok(images)
    }

    fn record_poses(&self, from_us: i64, to_us: i64, log: &mut LogWriter) -> anyhow::Result<()> {
        for step in 0..=(to_us - from_us) / POSE_US {
            let time_us = from_us + step * POSE_US;
            let world_from_rig = self.route.pose_at(time_us)?;
            log.add(&Keyframe { time_us, world_from_rig })?;
            let imu = sensors::imu(&self.route, time_us);
            imu.map_or(Ok(()), |row| log.add(&row))?;
            // Fixes and boxes at the rate of the LiDAR, every tenth pose.
            if step % (PERIOD_US / POSE_US) == 0 {
                log.add(&sensors::gps(&self.geo, &world_from_rig, time_us)?)?;
                for actor in &self.actors {
                    let row = actor.row(&self.route, time_us, self.since_start_s(time_us));
                    row.map_or(Ok(()), |row| log.add(&row))?;
                }
            }
        }
        Ok(())
    }

    /// Records an image of each camera. Returns how many are kept.
    fn record_images(&self, turn: usize, us: i64, log: &mut LogWriter) -> anyhow::Result<usize> {
        let mut kept = 0;
        // Within the turn, however many cameras there are: rows are in order of time.
        let step_us = CAMERA_STEP_US.min(PERIOD_US / self.rig.cameras.len().max(1) as i64);
        for (index, mounted) in self.rig.cameras.iter().enumerate() {
            // Counted from 1: counted from 0, the first image would always be dropped.
            let number = turn * self.rig.cameras.len() + index + 1;
            if self.drop_every > 0 && number.is_multiple_of(self.drop_every) {
                continue;
            }
            self.record_image(mounted, us + step_us * index as i64, log)?;
            kept += 1;
        }
        Ok(kept)
    }

    fn record_image(
        &self,
        mounted: &RigCamera,
        time_us: i64,
        log: &mut LogWriter,
    ) -> anyhow::Result<()> {
        let RigCamera { name, camera, rig_from_camera, .. } = mounted;
        let world_from_camera = self.route.pose_at(time_us)? * *rig_from_camera;
        let rendered = self.render(&View::new(*camera, world_from_camera), time_us)?;
        let width = camera.width_px;
        let height = camera.height_px;
        let jpeg = wildcity_session::jpeg(&rendered.rgb8, width, height, JPEG_QUALITY);
        let file = format!("images/{name}/{time_us:010}.jpg");
        log.put(&file, &jpeg.map_err(|reason| anyhow!("{file}: {reason}"))?)?;
        // Where no Gaussian is, the twin shows its sky.
        let is_sky: Vec<bool> = rendered.opacity.iter().map(|opacity| *opacity < 0.5).collect();
        let sky_file = format!("sky/{name}/{time_us:010}.png");
        log.put(&sky_file, &mask_png(&is_sky, [width, height])?)?;
        log.add(&ImageRow {
            time_us,
            camera: name.clone(),
            file,
            mask: None,
            ground_mask: None,
            sky_mask: Some(sky_file),
            exposure_stops: None,
            exposure_us: None,
            held_out: false,
        })?;
        Ok(())
    }

    fn record_sweep(&self, begin_us: i64, log: &mut LogWriter) -> anyhow::Result<()> {
        let late_us = self.lidar_late_us;
        let end_us = begin_us + PERIOD_US;
        let at = |time_us| anyhow::Ok(self.route.pose_at(time_us)? * self.rig_from_lidar);
        // Rendered at the true times: only what the log says of them is late.
        let view = LidarView {
            lidar: self.lidar.clone(),
            world_from_lidar: at(end_us)?,
            world_from_lidar_first: at(begin_us)?,
        };
        let profile = self.resident.version.manifest.profile;
        let mut scene = self.resident.scene(&[lidar_viewpoint(&view)], &profile)?;
        scene.place(self.placed(end_us, begin_us));
        let sweep = self.backend.sweep(&scene, &profile, &view)?;
        let points = sensors::points(&self.lidar, &sweep, begin_us + late_us);
        let file = format!("lidar/{begin_us:010}.safetensors");
        log.put(&file, &points.bytes(file.as_ref())?)?;
        log.add(&SweepRow {
            time_us: begin_us + late_us,
            until_us: end_us + late_us,
            lidar: LIDAR.to_owned(),
            file,
            compensated_to_us: None,
        })?;
        Ok(())
    }

    /// The objects at the end of an exposure, on their way from its start.
    fn placed(&self, time_us: i64, start_us: i64) -> Vec<PlacedChunk> {
        let at = |actor: &MovingActor, time_us, index| {
            actor.placed(&self.route, self.since_start_s(time_us), index)
        };
        let placed = (0..).zip(&self.actors).filter_map(|(index, actor)| {
            let end = at(actor, time_us, index)?;
            let start = at(actor, start_us, index)
                // An actor that is not on the drive yet when the turn begins stands still during
                // it.
                .map_or(end.world_from_actor, |start| start.world_from_actor);
            Some(PlacedChunk { world_from_actor_at_start: start, ..end })
        });
        placed.collect()
    }

    /// Renders the twin with the objects at a time.
    fn render(&self, view: &View, time_us: i64) -> anyhow::Result<Rendered> {
        let profile = self.resident.version.manifest.profile;
        let views = [*view];
        let mut scene = self.resident.scene(&viewpoints(&views), &profile)?;
        scene.place(self.placed(time_us, time_us));
        let pixels = view.camera.pixels();
        let mut rendered = Rendered { rgb8: vec![0; 3 * pixels], opacity: vec![0.0; pixels] };
        let target = Target {
            rgb8: Some(&mut rendered.rgb8),
            opacity: Some(&mut rendered.opacity),
            ..Target::default()
        };
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        self.backend.render(&frame, &mut [target], &|_, _| {})?;
        Ok(rendered)
    }

    fn since_start_s(&self, time_us: i64) -> f64 {
        (time_us - self.route.at(0.0).time_us) as f64 / 1e6
    }
}
