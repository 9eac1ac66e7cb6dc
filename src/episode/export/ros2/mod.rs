//! Episodes as MCAP files of ROS 2: its schemas and CDR, for `ros2 bag play` and programs that read
//! bags.
//!
//! | topic | message |
//! |---|---|
//! | `/clock` | `rosgraph_msgs/Clock`: the time of each step |
//! | `/tf` | `tf2_msgs/TFMessage`: `map` to `base_link` at each step |
//! | `/tf_static` | the same: `base_link` to each camera's optical frame |
//! | `/odometry` | `nav_msgs/Odometry`: pose in `map`, velocities in `base_link` |
//! | `/camera/NAME/camera_info` | `sensor_msgs/CameraInfo`, at the start and with each image |
//! | `/camera/NAME/compressed` | `sensor_msgs/CompressedImage`: JPEG, if the caller renders the images |
//! | `/lidar/NAME/points` | `sensor_msgs/PointCloud2` in `base_link` at the sweep's time, if the caller casts the sweeps |
//! | `/plan` | `nav_msgs/Path` in `base_link`: the agent's trajectory, when it was decided |
//!
//! Times are those of the other export: those of the episode plus 1,000 s.

mod cdr;
mod messages;
mod schemas;

use std::io::{Seek, Write};
use std::iter::Peekable;

use wildcity_scene::Rig;
use wildcity_scene::rig::RigCamera;
use wildcity_score::EgoSample;

use super::calibration::Calibration;
use super::container::McapFile;
use super::error::{ExportError, Exported};
use super::messages as foxglove;
use super::parts::motions;
use super::sweep::ExportedSweep;
use super::write::ExportedImage;
use crate::file::{EpisodeFile, Frame};

use messages::{BASE, Stamp, Transform};

/// An MCAP file of ROS 2 that is being written, in the order of time as far as images are.
pub struct Ros2Export<'a, W: Write + Seek> {
    file: McapFile<W>,
    /// The frames that are not written yet, each with the ego's motion.
    frames: Peekable<std::vec::IntoIter<(&'a Frame, Option<EgoSample>)>>,
    cameras: Vec<Ros2Camera>,
    /// Names of the LiDARs in topics.
    lidars: Vec<String>,
    calibration_error_px: f64,
}

/// A camera of the rig, as ROS 2 has it.
struct Ros2Camera {
    /// Its name in topics and frames.
    name: String,
    calibration: foxglove::CameraCalibration,
}

impl<'a, W: Write + Seek> Ros2Export<'a, W> {
    /// Starts a file with the cameras. `rig` is that of the episode's header; without one there are
    /// no cameras.
    ///
    /// # Errors
    /// The file cannot be written, or the episode has no frame.
    pub fn begin(episode: &'a EpisodeFile, rig: Option<&Rig>, out: W) -> Result<Self, ExportError> {
        let frames = episode.driven();
        let begin_us = frames.first().ok_or(ExportError::Empty)?.time_us;
        let motions = motions(&frames, episode.header.dt_us);
        let mounted = rig.map_or(&[][..], |rig| &rig.cameras);
        let lidars = rig.map_or(&[][..], |rig| &rig.lidars);
        let calibrations: Vec<Calibration> = mounted
            .iter()
            .enumerate()
            .map(|(index, camera)| Calibration::new(index, camera, begin_us))
            .collect();
        let errors_px = calibrations.iter().map(|calibration| calibration.error_px);
        let calibration_error_px = errors_px.fold(0.0, f64::max);
        let names = ros_names(mounted.iter().map(|camera| &*camera.name));
        let cameras = names
            .into_iter()
            .zip(calibrations)
            .map(|(name, calibration)| Ros2Camera { name, calibration: calibration.message });
        let mut export = Self {
            cameras: cameras.collect(),
            lidars: ros_names(lidars.iter().map(|lidar| &*lidar.name)),
            file: McapFile::create_ros2(out)?,
            frames: frames.iter().copied().zip(motions).collect::<Vec<_>>().into_iter().peekable(),
            calibration_error_px,
        };
        export.mounts(mounted, begin_us)?;
        for index in 0..export.cameras.len() {
            export.camera_info(index, begin_us)?;
        }
        Ok(export)
    }

    /// Adds an image, after all messages of earlier times.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn image(&mut self, image: &ExportedImage<'_>) -> Result<(), ExportError> {
        self.write_until(image.time_us)?;
        self.camera_info(image.camera, image.time_us)?;
        let Some(camera) = self.cameras.get(image.camera) else { return Ok(()) };
        let stamp = Stamp::new(image.time_us);
        let data = messages::compressed_image(stamp, &optical_frame(&camera.name), image.jpeg);
        let topic = format!("/camera/{}/compressed", camera.name);
        self.put(&topic, "sensor_msgs/msg/CompressedImage", image.time_us, &data)
    }

    /// Adds a sweep of a LiDAR, after all messages of earlier times.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn sweep(&mut self, sweep: &ExportedSweep<'_>) -> Result<(), ExportError> {
        self.write_until(sweep.time_us)?;
        // Without a rig in the header a LiDAR has a number.
        let number = sweep.lidar.to_string();
        let name = self.lidars.get(sweep.lidar).unwrap_or(&number);
        let topic = format!("/lidar/{name}/points");
        let data = messages::point_cloud(Stamp::new(sweep.time_us), BASE, sweep.points);
        self.put(&topic, "sensor_msgs/msg/PointCloud2", sweep.time_us, &data)
    }

    /// Writes the remaining messages, and the index.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<Exported, ExportError> {
        self.write_until(i64::MAX)?;
        let calibration_error_px = self.calibration_error_px;
        Ok(Exported { messages: self.file.finish()?, calibration_error_px })
    }

    /// Writes frames before a time: images of a time stand before its other messages.
    fn write_until(&mut self, time_us: i64) -> Result<(), ExportError> {
        while let Some((frame, motion)) = self.frames.next_if(|(frame, _)| frame.time_us < time_us)
        {
            self.step(frame, motion)?;
            // A plan is in the frame of the rig at the start of its step.
            if let Some(plan) = self.frames.peek().and_then(|(next, _)| next.plan()) {
                let poses = plan.iter().map(|timed| &timed.start_from_rig);
                let data = messages::path(Stamp::new(frame.time_us), BASE, poses);
                self.put("/plan", "nav_msgs/msg/Path", frame.time_us, &data)?;
            }
        }
        Ok(())
    }

    /// The clock and the ego at a step.
    fn step(&mut self, frame: &Frame, motion: Option<EgoSample>) -> Result<(), ExportError> {
        let time_us = frame.time_us;
        let stamp = Stamp::new(time_us);
        self.put("/clock", "rosgraph_msgs/msg/Clock", time_us, &messages::clock(stamp))?;
        let Some(map_from_base) = frame.poses.last() else { return Ok(()) };
        let moved =
            Transform { parent: messages::MAP, child: BASE.to_owned(), pose: *map_from_base };
        let data = messages::transforms(stamp, &[moved]);
        self.put("/tf", "tf2_msgs/msg/TFMessage", time_us, &data)?;
        let data = messages::odometry(stamp, map_from_base, motion);
        self.put("/odometry", "nav_msgs/msg/Odometry", time_us, &data)
    }

    /// Where the cameras are on the rig.
    fn mounts(&mut self, cameras: &[RigCamera], time_us: i64) -> Result<(), ExportError> {
        let names = self.cameras.iter().map(|camera| &camera.name);
        let mounts = cameras.iter().zip(names).map(|(camera, name)| Transform {
            parent: BASE,
            child: optical_frame(name),
            pose: camera.rig_from_camera,
        });
        let mounts: Vec<Transform> = mounts.collect();
        if mounts.is_empty() {
            return Ok(());
        }
        let data = messages::transforms(Stamp::new(time_us), &mounts);
        self.put("/tf_static", "tf2_msgs/msg/TFMessage", time_us, &data)
    }

    fn camera_info(&mut self, index: usize, time_us: i64) -> Result<(), ExportError> {
        let Some(Ros2Camera { name, calibration }) = self.cameras.get(index) else { return Ok(()) };
        let data = messages::camera_info(Stamp::new(time_us), &optical_frame(name), calibration);
        let topic = format!("/camera/{name}/camera_info");
        self.put(&topic, "sensor_msgs/msg/CameraInfo", time_us, &data)
    }

    fn put(
        &mut self,
        topic: &str,
        schema: &'static str,
        time_us: i64,
        data: &[u8],
    ) -> Result<(), ExportError> {
        self.file.cdr(topic, schema, schemas::definition, time_us, data)
    }
}

/// Writes an episode for ROS 2 without images, as [`super::export`] does.
///
/// # Errors
/// The file cannot be written, or the episode has no frame.
pub fn export_ros2<W: Write + Seek>(
    episode: &EpisodeFile,
    rig: Option<&Rig>,
    out: W,
) -> Result<Exported, ExportError> {
    Ros2Export::begin(episode, rig, out)?.finish()
}

/// Names as ROS accepts them. One that another has become already gets its number.
fn ros_names<'a>(names: impl Iterator<Item = &'a str>) -> Vec<String> {
    let mut known: Vec<String> = Vec::new();
    for (number, name) in names.enumerate() {
        let plain = ros_name(name);
        let is_new = !known.contains(&plain);
        known.push(if is_new { plain } else { format!("{plain}_{number}") });
    }
    known
}

/// A name as ROS accepts it in topics and frames: letters, digits and underscores.
fn ros_name(name: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    name.chars().map(allowed).collect()
}

/// The frame of a camera with x to the right, y down and z into the image (REP 103).
fn optical_frame(name: &str) -> String {
    format!("{name}_optical_frame")
}
