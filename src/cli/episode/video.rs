//! `wildcity episode video`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use wildcity_session::{FrameRecord, FrameRequest, RecordedEpisode, ReplayUntil, ReplayedImage};
use wildcity_twin::residency::Cache;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{Episodes, Twins};
use crate::cli::{output, progress};

/// Write the frames of an episode as numbered pictures, for a video.
///
/// The episode is driven and rendered again, and compared with its record. No video is encoded here, since this program
/// has no encoder; the printed ffmpeg command makes one of the pictures, at the speed of the simulation.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Video {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    /// Directory for the pictures 000000.png, 000001.png ..; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// The camera [default: the first one of the episode]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,

    #[command(flatten)]
    episodes: Episodes,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode video agent-1 --out frames
  wildcity episode video run/episodes/straight-0-1.jsonl --out frames --camera front_wide_120fov";

impl Video {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let path = super::file_of(&self.episode, &self.episodes)?;
        let mut recording = RecordedEpisode::read(&path)?;
        let camera = self.camera_of(&recording)?;
        for frame in &mut recording.frames {
            keep_camera(frame, camera, recording.header.rig.cameras.len());
        }
        output::create_dir(&self.out)?;
        let cache = Cache::new(self.twins.catalog()?);
        let header = &recording.header;
        let backend = self.backend.backend_of(&header.backend)?;

        let bar = progress::count("rendering");
        bar.set_length(recording.frames.iter().map(|frame| frame.images.len() as u64).sum());
        let mut written = 0_usize;
        let report = recording.replay(&cache, &*backend, ReplayUntil::End, &mut |image| {
            bar.inc(1);
            let path = self.out.join(format!("{written:06}.png"));
            written += 1;
            write_png(&path, image).map_err(|error| format!("{error:#}"))
        })?;
        bar.finish_and_clear();

        let mut out = io::stdout().lock();
        let name = &header.rig.cameras[camera].name;
        writeln!(out, "written     {written} pictures of camera {name} to {}", self.out.display())?;
        if let Some(difference) = &report.difference {
            writeln!(out, "differs     {difference}")?;
        }
        writeln!(
            out,
            "video       none: wildcity has no encoder. With ffmpeg:\n            ffmpeg -framerate {} -i {} -pix_fmt \
             yuv420p episode.mp4",
            1e6 / header.dt_us as f64,
            self.out.join("%06d.png").display()
        )?;
        Ok(())
    }

    /// Index of the wanted camera.
    fn camera_of(&self, recording: &RecordedEpisode) -> anyhow::Result<usize> {
        let cameras = &recording.header.rig.cameras;
        let Some(wanted) = &self.camera else { return Ok(0) };
        cameras.iter().position(|camera| camera.name == *wanted).with_context(|| {
            let known: Vec<&str> = cameras.iter().map(|camera| &*camera.name).collect();
            format!("--camera {wanted}: the episode has {}", known.join(", "))
        })
    }
}

/// Leaves of a frame the images of one camera; none of poses that were only looked at.
fn keep_camera(frame: &mut FrameRecord, camera: usize, rig_cameras: usize) {
    let is_driven = matches!(frame.request, FrameRequest::Reset | FrameRequest::Step);
    let mut images = std::mem::take(&mut frame.images).into_iter();
    let mut kept = Vec::new();
    let mut cameras = Vec::new();
    for pose in 0..frame.poses.len() {
        let mut of_pose = Vec::new();
        for rendered in frame.cameras_of(pose, rig_cameras) {
            let image = images.next();
            if rendered == camera && is_driven {
                of_pose.push(camera);
                kept.extend(image);
            }
        }
        cameras.push(of_pose);
    }
    frame.images = kept;
    frame.cameras = cameras;
}

fn write_png(path: &Path, image: &ReplayedImage<'_>) -> anyhow::Result<()> {
    let size = &image.camera.camera;
    let file = wildcity_session::png(image.rgb8, size.width_px, size.height_px);
    output::write(path, &file.map_err(anyhow::Error::msg)?)
}
