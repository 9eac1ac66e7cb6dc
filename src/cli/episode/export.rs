//! `wildcity episode export`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use wildcity_episode::{
    EpisodeExport, EpisodeFile, ExportError, Exported, ExportedImage, Ros2Export, export_file,
    export_ros2, write_whole,
};
use wildcity_scene::Rig;
use wildcity_session::{
    RecordedEpisode, ReplayReport, ReplayUntil, ReplayedImage, jpeg, limits as session,
};
use wildcity_twin::residency::Cache;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{Episodes, Twins};
use crate::cli::progress;

use super::kept::{camera_index, driven, keep_cameras};

/// Export an episode as MCAP, for Foxglove, Rerun and others: indexed, compressed, with schemas.
///
/// Runs and servers export each episode when it ends, without images. With --images the episode is
/// driven and rendered again, and compared with its record.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Export {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    /// The MCAP file to write.
    #[arg(long, value_name = "FILE")]
    mcap: PathBuf,

    /// Render the images again, and add them as JPEG.
    #[arg(long)]
    images: bool,

    /// Write messages of ROS 2 in place of Foxglove's: clock, tf, odometry, camera_info, compressed
    /// images and plans, for `ros2 bag play` and programs that read bags.
    #[arg(long)]
    ros2: bool,

    /// A camera whose images are added; may be given several times [default: all cameras of the
    /// episode]
    #[arg(long, value_name = "NAME", requires = "images")]
    camera: Vec<String>,

    #[command(flatten)]
    episodes: Episodes,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode export agent-1 --mcap agent-1.mcap
  wildcity episode export agent-1 --mcap agent-1.mcap --images
  wildcity episode export agent-1 --mcap agent-1-ros.mcap --images --ros2
  wildcity episode export run/episodes/straight-0-1.jsonl --mcap straight.mcap --images --camera front";

/// Difference of a calibration from its lens above which a note is printed, in pixels.
const NOTED_ERROR_PX: f64 = 0.1;

impl Export {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let path = super::find_record(&self.episode, &self.episodes)?;
        let is_record = self
            .mcap
            .canonicalize()
            .is_ok_and(|mcap| path.canonicalize().is_ok_and(|record| record == mcap));
        anyhow::ensure!(
            !is_record,
            "--mcap {}: this is the record itself; name another file",
            self.mcap.display()
        );
        let (exported, report) = if self.images {
            self.with_images(&path).map(|(exported, report)| (exported, Some(report)))?
        } else {
            (self.without_images(&path)?, None)
        };
        let mut out = io::stdout().lock();
        writeln!(out, "exported    {} messages to {}", exported.messages, self.mcap.display())?;
        if let Some(report) = &report {
            writeln!(out, "images      {}", report.images)?;
        }
        if let Some(difference) = report.and_then(|report| report.difference) {
            writeln!(out, "differs     {difference}")?;
        }
        let error_px = exported.calibration_error_px;
        if error_px > NOTED_ERROR_PX {
            writeln!(
                out,
                "note        calibrations differ from the lenses by up to {error_px:.1} px"
            )?;
        }
        Ok(())
    }

    fn without_images(&self, path: &Path) -> anyhow::Result<Exported> {
        if !self.ros2 {
            return Ok(export_file(path, &self.mcap)?);
        }
        let episode = EpisodeFile::read(path)?;
        let rig = EpisodeFile::rig(path)?;
        Ok(write_whole(&self.mcap, |out| export_ros2(&episode, rig.as_ref(), out))?)
    }

    fn with_images(&self, path: &Path) -> anyhow::Result<(Exported, ReplayReport)> {
        let episode = EpisodeFile::read(path)?;
        let rig = EpisodeFile::rig(path)?;
        let mut recording = RecordedEpisode::read(path)?;
        let count = recording.header.rig.cameras.len();
        let wanted = self.camera.iter().map(|name| camera_index(&recording, name));
        let mut wanted = wanted.collect::<anyhow::Result<Vec<usize>>>()?;
        if wanted.is_empty() {
            wanted = (0..count).collect();
        }
        let shown = driven(&recording.frames);
        for (index, frame) in recording.frames.iter_mut().enumerate() {
            let cameras = if shown.binary_search(&index).is_ok() { &wanted[..] } else { &[] };
            keep_cameras(frame, cameras, count);
        }
        let cache = Cache::new(self.twins.catalog()?);
        let backend = self.backend.replay_backend(&recording.header.backend)?;
        let bar = progress::count("rendering");
        bar.set_length(recording.frames.iter().map(|frame| frame.images.len() as u64).sum());
        let written = write_whole(&self.mcap, |out| {
            let mut export = AnyExport::begin(self.ros2, &episode, rig.as_ref(), out)?;
            let mut add = |image: &ReplayedImage<'_>| {
                bar.inc(1);
                add_image(&mut export, &recording, image)
            };
            let report = recording.replay(&cache, &*backend, ReplayUntil::End, &mut add);
            let report = report.map_err(|error| ExportError::Images(error.to_string()))?;
            Ok((export.finish()?, report))
        });
        bar.finish_and_clear();
        Ok(written?)
    }
}

/// An export of one of the two kinds.
enum AnyExport<'a, W: io::Write + io::Seek> {
    Foxglove(EpisodeExport<'a, W>),
    Ros2(Ros2Export<'a, W>),
}

impl<'a, W: io::Write + io::Seek> AnyExport<'a, W> {
    fn begin(
        is_ros2: bool,
        episode: &'a EpisodeFile,
        rig: Option<&Rig>,
        out: W,
    ) -> Result<Self, ExportError> {
        Ok(if is_ros2 {
            Self::Ros2(Ros2Export::begin(episode, rig, out)?)
        } else {
            Self::Foxglove(EpisodeExport::begin(episode, rig, out)?)
        })
    }

    fn image(&mut self, image: &ExportedImage<'_>) -> Result<(), ExportError> {
        match self {
            Self::Foxglove(export) => export.image(image),
            Self::Ros2(export) => export.image(image),
        }
    }

    fn finish(self) -> Result<Exported, ExportError> {
        match self {
            Self::Foxglove(export) => export.finish(),
            Self::Ros2(export) => export.finish(),
        }
    }
}

/// Adds an image, unless it is of a warm-up whose times the record does not have.
fn add_image<W: io::Write + io::Seek>(
    export: &mut AnyExport<'_, W>,
    recording: &RecordedEpisode,
    image: &ReplayedImage<'_>,
) -> Result<(), String> {
    let frame = &recording.frames[image.frame];
    let has_time = !frame.times_us.is_empty() || image.pose + 1 == frame.poses.len();
    let cameras = &recording.header.rig.cameras;
    let camera = cameras.iter().position(|camera| camera.name == image.camera.name);
    let (true, Some(camera)) = (has_time, camera) else { return Ok(()) };
    let size = &image.camera.camera;
    let jpeg = jpeg(image.rgb8, size.width_px, size.height_px, session::JPEG_QUALITY)?;
    let time_us = frame.taken_us(image.pose);
    let added = export.image(&ExportedImage { camera, time_us, jpeg: &jpeg });
    added.map_err(|error| error.to_string())
}
