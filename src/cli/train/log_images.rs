//! The images of a log as a run of training reads them: with the poses of its rig, with depths of
//! its LiDAR, and without what moves.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use glam::DVec3;
use image::image_dimensions;
use wildcity_eval::images::picture;
use wildcity_eval::{Boxes, GROWN_PX, hide};
use wildcity_log::check::Projection;
use wildcity_log::{ImageRow, Log, Poses, SweepRow, Tracks};
use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Manifest, Rig, Trajectory};
use wildcity_train::ground::is_ground;
use wildcity_train::poses::{Place, RigPoses};
use wildcity_train::run::{TrainingImage, TrainingImages};

use super::depths::Depths;
use super::images::{Shrunk, factor, shrink};
use crate::cli::exit;

/// Images within this time of the first are of one time of the rig, in microseconds.
const SAME_TIME_US: i64 = 40_000;

/// A sweep's points are depths of images within this time of them, in microseconds.
const SWEEP_US: i64 = 60_000;

/// Ground masks that are looked at, at most.
const MOST_GROUND_MASKS: usize = 200;

/// A ground mask tells of points this near to its camera, in metres: farther ones are a pixel or
/// two.
const GROUND_M: f64 = 25.0;

/// The images of a log.
pub(super) struct LogImages {
    log: Log,
    poses: Poses,
    images: Vec<LoggedImage>,
    /// In the order of their beginnings.
    sweeps: Vec<SweepRow>,
    longest_sweep_us: i64,
    tracks: Tracks,
    boxes: Boxes,
    pub(super) rig: RigPoses,
    /// The time of each pose of the rig, in microseconds.
    times_us: Vec<i64>,
    size: f64,
    held_out_every: usize,
    held_out: Vec<bool>,
    /// Images at times without a pose.
    pub(super) left_out: usize,
}

struct LoggedImage {
    row: ImageRow,
    place: Place,
}

impl LogImages {
    pub(super) fn new(log: Log, size: f64, held_out_every: usize) -> anyhow::Result<Self> {
        let poses = log.poses()?;
        let rows = log.images()?.context("the log has no images.jsonl: there is no image")?;
        let sweeps = log.sweeps()?.map(|rows| rows.collect::<Result<Vec<_>, _>>()).transpose()?;
        let tracks = Tracks::read(&log, [i64::MIN, i64::MAX])?;
        let boxes = Boxes::from_tracks(&tracks);
        let cameras = log.rig.cameras.iter().map(|camera| camera.rig_from_camera);
        let rig = RigPoses { world_from_ego: Vec::new(), ego_from_camera: cameras.collect() };
        let mut sweeps = sweeps.unwrap_or_default();
        sweeps.sort_by_key(|sweep| sweep.time_us);
        let length_us = |sweep: &SweepRow| sweep.until_us.saturating_sub(sweep.time_us);
        let longest_sweep_us = sweeps.iter().map(length_us).max().unwrap_or(0);
        let mut all = Self {
            log,
            poses,
            images: Vec::new(),
            sweeps,
            longest_sweep_us,
            tracks,
            boxes,
            rig,
            times_us: Vec::new(),
            size,
            held_out_every,
            held_out: Vec::new(),
            left_out: 0,
        };
        for row in rows {
            all.add(row?)?;
        }
        ensure!(!all.images.is_empty(), "no image of the log has a pose at its time");
        all.hold_out();
        Ok(all)
    }

    /// Chooses the images that are held out: those that the log marks, or else the same as
    /// `wildcity eval --log`, one of some in the order of cameras and then of times.
    fn hold_out(&mut self) {
        self.held_out = self.images.iter().map(|image| image.row.held_out).collect();
        if self.held_out.contains(&true) || self.held_out_every == 0 {
            return;
        }
        let mut order: Vec<usize> = (0..self.images.len()).collect();
        // By camera and then by time: in the order of the rows every n-th image could be of one
        // camera.
        order.sort_by_key(|&index| {
            let ImageRow { camera, time_us, .. } = &self.images[index].row;
            (camera, *time_us)
        });
        for index in order.into_iter().step_by(self.held_out_every) {
            self.held_out[index] = true;
        }
    }

    fn add(&mut self, row: ImageRow) -> anyhow::Result<()> {
        let file = self.log.path(&row.file);
        ensure!(file.is_file(), "there is no image {}", file.display());
        let camera = self.log.camera_index(&row.camera)?;
        let Some(world_from_rig) = self.poses.at(row.time_us) else {
            self.left_out += 1;
            return Ok(());
        };
        // Cameras that are triggered together share one pose of the rig, which is trained for all
        // of them.
        let is_later = |before: &i64| row.time_us > before.saturating_add(SAME_TIME_US);
        if self.times_us.last().is_none_or(is_later) {
            self.times_us.push(row.time_us);
            self.rig.world_from_ego.push(world_from_rig);
        }
        let ego = self.rig.world_from_ego.len() - 1;
        // What remains of the recorded motion between the shared time and that of the image.
        let motion = self.rig.world_from_ego[ego].inverse() * world_from_rig;
        self.images.push(LoggedImage { row, place: Place { ego, camera, motion } });
        Ok(())
    }

    /// Takes the poses that an earlier run has trained, which are in the twin that it made. Without
    /// such, those of the log stay. Returns whether there are such.
    pub(super) fn take_refined(&mut self, twin: &Manifest) -> bool {
        let name = self.refined_name();
        let drive = twin.trajectories.iter().find(|drive| drive.name == name);
        let Some(drive) = drive else { return false };
        let Some(rig) = &twin.rig else { return false };
        let is_of_log =
            drive.keyframes.iter().map(|key| key.time_us).eq(self.times_us.iter().copied());
        let names = rig.cameras.iter().map(|camera| &camera.name);
        // Of another log, or of other cameras of it: the poses would belong to other images.
        if !is_of_log || !names.eq(&self.camera_names()) {
            return false;
        }
        let poses = drive.keyframes.iter().map(|key| key.world_from_rig);
        self.rig.world_from_ego = poses.collect();
        let mounts = rig.cameras.iter().map(|camera| camera.rig_from_camera);
        self.rig.ego_from_camera = mounts.collect();
        true
    }

    fn refined_name(&self) -> String {
        format!("{}-refined", self.log.header.name)
    }

    /// The drive and the rig with poses that were trained. The drive has the times of images.
    pub(super) fn refined(&self, poses: &RigPoses) -> (Trajectory, Rig) {
        let keyframe = |(&time_us, &world_from_rig)| Keyframe { time_us, world_from_rig };
        let keyframes = self.times_us.iter().zip(&poses.world_from_ego).map(keyframe);
        let name = self.refined_name();
        let mut rig = self.log.rig.clone();
        for (camera, pose) in rig.cameras.iter_mut().zip(&poses.ego_from_camera) {
            camera.rig_from_camera = *pose;
        }
        (Trajectory { name, keyframes: keyframes.collect() }, rig)
    }

    pub(super) fn camera_names(&self) -> Vec<String> {
        self.log.rig.cameras.iter().map(|camera| camera.name.clone()).collect()
    }

    /// The recorded pose of each image.
    pub(super) fn world_from_camera(&self) -> Vec<Pose> {
        self.images.iter().map(|image| self.rig.world_from_camera(image.place)).collect()
    }

    /// A text by which a checkpoint knows its images: the lenses, the tables, and the poses.
    pub(super) fn inputs(&self) -> anyhow::Result<String> {
        let mut text = format!("{} {}\n{:?}\n", self.size, self.held_out_every, self.rig);
        for LoggedImage { row, place } in &self.images {
            text += &format!("{row:?} {place:?}\n");
        }
        for name in ["log.json", "rig.json", "lidar.jsonl", "tracks.jsonl"] {
            let path = self.log.path(name);
            if path.is_file() {
                let mut hasher = blake3::Hasher::new();
                let hashed = fs::File::open(&path).and_then(|file| {
                    hasher.update_reader(file)?;
                    Ok(())
                });
                hashed.with_context(|| format!("cannot read {}", path.display()))?;
                text += &format!("{name} {}\n", hasher.finalize());
            }
        }
        Ok(text)
    }

    /// Whether each point lies on the ground: as most of the ground masks of the log say that show
    /// it, and by the plane of the wheels where none does.
    pub(super) fn ground(&self, points_m: &[DVec3]) -> anyhow::Result<Vec<bool>> {
        let mut labels = is_ground(points_m, &self.rig.world_from_ego);
        let masked = |image: &&LoggedImage| image.row.ground_mask.is_some();
        let all: Vec<&LoggedImage> = self.images.iter().filter(masked).collect();
        let every = all.len().div_ceil(MOST_GROUND_MASKS).max(1);
        let mut votes = vec![[0_u32; 2]; points_m.len()];
        for LoggedImage { row, place } in all.into_iter().step_by(every) {
            let Some(file) = &row.ground_mask else { continue };
            let file = self.log.path(file);
            let (width, height) = image_dimensions(&file)
                .with_context(|| format!("cannot read {}", file.display()))?;
            let size_px = [width, height];
            let mask = picture::mask(&file, size_px)?;
            // The mask has the size of its image, which may be smaller than the calibrated one.
            let camera =
                self.log.rig.cameras[place.camera].camera.scaled(width.into(), height.into())?;
            let camera_from_world = self.rig.world_from_camera(*place).inverse();
            for (point_m, votes) in points_m.iter().zip(&mut votes) {
                let at_m = camera_from_world.transform_point(*point_m);
                // Far away one pixel of a mask covers metres of the ground.
                let near = Some(at_m).filter(|at_m| at_m.length() < GROUND_M);
                let Some(px) = near.and_then(|at_m| camera.project(at_m)) else { continue };
                let [x, y] = px.floor().to_array().map(|px| px as i64);
                let is_within = |px: i64, size: u32| (0..i64::from(size)).contains(&px);
                if is_within(x, size_px[0]) && is_within(y, size_px[1]) {
                    let shows = mask[y as usize * size_px[0] as usize + x as usize];
                    votes[usize::from(shows)] += 1;
                }
            }
        }
        for (label, [no, yes]) in labels.iter_mut().zip(votes) {
            // A point that no mask shows keeps the label of its height.
            if no + yes > 0 {
                *label = yes > no;
            }
        }
        Ok(labels)
    }

    pub(super) fn log(&self) -> &Log {
        &self.log
    }

    pub(super) fn poses(&self) -> &Poses {
        &self.poses
    }

    fn decode(&self, index: usize) -> anyhow::Result<TrainingImage> {
        let LoggedImage { row, place } = &self.images[index];
        let mounted = &self.log.rig.cameras[place.camera];
        let path = |file: &str| -> PathBuf { self.log.path(file) };
        let mask = row.mask.as_deref().map(path);
        let mut shrunk =
            Shrunk::read(&path(&row.file), mask.as_deref(), &mounted.camera, self.size)?;
        let size_px = [shrunk.camera.width_px, shrunk.camera.height_px];
        let rig_from_camera = self.rig.ego_from_camera[place.camera];
        let mounted = RigCamera { camera: shrunk.camera, rig_from_camera, ..mounted.clone() };
        let world_from_rig = self.rig.world_from_ego[place.ego] * place.motion;
        // The recorded motion during the exposure, from the pose that it has now.
        let recorded = self.poses.at(row.time_us).unwrap_or(world_from_rig);
        let before = |us: i64| match self.poses.at(row.time_us.saturating_sub(us)) {
            Some(earlier) => world_from_rig * (recorded.inverse() * earlier),
            None => world_from_rig,
        };
        let views = View::from_moving_rig(&[mounted], world_from_rig, &before);
        let view = *views.first().context("a view")?;
        for moving in self.boxes.moving_at(row.time_us) {
            let hull_px = moving.hull_px(&shrunk.camera, &view.world_from_camera);
            let all = || vec![true; shrunk.camera.pixels()];
            let counts = shrunk.mask.get_or_insert_with(all);
            hide(&hull_px, size_px, GROWN_PX * self.size, counts);
        }
        let depth_m = self.depths(row, place.camera, &view)?;
        let exposure = factor(row.exposure_stops);
        let Shrunk { rgb8, mask, own_px, .. } = shrunk;
        let sky = row
            .sky_mask
            .as_deref()
            .map(|file| picture::mask(&path(file), own_px))
            .transpose()?
            .map(|sky| shrink(&sky, own_px, [view.camera.width_px, view.camera.height_px]));
        Ok(TrainingImage { view, rgb8, mask, sky, depth_m, weight: 1.0, exposure })
    }

    /// The sweeps that have points near a time.
    fn sweeps_near(&self, time_us: i64) -> impl Iterator<Item = &SweepRow> {
        let from_us = time_us.saturating_sub(SWEEP_US);
        let until_us = time_us.saturating_add(SWEEP_US);
        // Sorted by their beginning only: a sweep that begins earlier than this has ended before.
        let earliest_us = from_us.saturating_sub(self.longest_sweep_us);
        let first = self.sweeps.partition_point(|sweep| sweep.time_us < earliest_us);
        let last = self.sweeps.partition_point(|sweep| sweep.time_us <= until_us);
        self.sweeps[first..last].iter().filter(move |sweep| sweep.until_us >= from_us)
    }

    /// The depths of the LiDAR's points near the time of an image, where these are seen.
    fn depths(
        &self,
        row: &ImageRow,
        camera: usize,
        view: &View,
    ) -> anyhow::Result<Option<Vec<f32>>> {
        if self.sweeps.is_empty() {
            return Ok(None);
        }
        let own = &self.log.rig.cameras[camera];
        let mounted = RigCamera { camera: view.camera, ..own.clone() };
        let projection = Projection { poses: &self.poses, mounted: &mounted, time_us: row.time_us };
        let mut depths = Depths::new([view.camera.width_px, view.camera.height_px]);
        let near = self.tracks.near(row.time_us);
        for sweep in self.sweeps_near(row.time_us) {
            for (time_us, rig_m) in self.log.points_on_rig(sweep)? {
                // A part of a sweep may be too early or too late, although the sweep as a whole is
                // near.
                if time_us.abs_diff(row.time_us) > SWEEP_US.unsigned_abs() {
                    continue;
                }
                let Some(world_from_rig) = self.poses.at(time_us) else { continue };
                let world_m = world_from_rig.transform_point(rig_m);
                let Some((at_px, _)) = projection.project(world_m) else { continue };
                // With a rolling shutter the camera is elsewhere for each row, also along its axis.
                let camera_m = view.world_from_camera_at(at_px).inverse().transform_point(world_m);
                // A moving object is elsewhere at the time of the image than when the point was
                // seen.
                if !near.hides(world_m, time_us) {
                    depths.add(at_px.as_uvec2().to_array(), view.camera.depth_m(camera_m) as f32);
                }
            }
        }
        Ok(Some(depths.seen()))
    }
}

impl TrainingImages for LogImages {
    fn count(&self) -> usize {
        self.images.len()
    }

    /// Those that the log marks, or one of some if it marks none.
    fn is_held_out(&self, index: usize) -> bool {
        self.held_out[index]
    }

    fn place(&self, index: usize) -> Option<Place> {
        Some(self.images[index].place)
    }

    fn view(&self, index: usize) -> View {
        let place = self.images[index].place;
        let camera = self.log.rig.cameras[place.camera].camera;
        View::new(camera, self.rig.world_from_camera(place))
    }

    fn name(&self, index: usize) -> String {
        let ImageRow { camera, time_us, .. } = &self.images[index].row;
        format!("{camera} at {:.3} s", *time_us as f64 / 1e6)
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        self.decode(index).map_err(|error| exit::chain(&error))
    }
}
