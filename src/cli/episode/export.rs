//! `wildcity episode export`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use wildcity_episode::{
    EpisodeExport, EpisodeFile, ExportError, Exported, ExportedImage, ExportedSweep,
    NuscenesExport, NuscenesImage, Ros2Export, export_file, export_nuscenes, export_ros2,
    write_whole,
};
use wildcity_scene::Rig;
use wildcity_session::{
    FrameRecord, RecordedEpisode, ReplayReport, ReplayUntil, Replayed, ReplayedImage,
    ReplayedSweep, jpeg, limits as session,
};
use wildcity_twin::residency::Cache;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{Episodes, Twins};
use crate::cli::output;
use crate::cli::progress;

use super::kept::{camera_index, driven, keep_cameras};

/// Export an episode as MCAP, for Foxglove, Rerun and others: indexed, compressed, with schemas; or
/// as tables of nuScenes.
///
/// Runs and servers export each episode when it ends, without images. With --images or --lidar the
/// episode is driven and rendered again, and compared with its record.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group(clap::ArgGroup::new("target").required(true).args(["mcap", "nuscenes"])))]
pub(super) struct Export {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    /// The MCAP file to write.
    #[arg(long, value_name = "FILE")]
    mcap: Option<PathBuf>,

    /// Write the tables of nuScenes 1.0 to this folder, which must not exist: samples at 2 Hz,
    /// cameras as pinholes, boxes of actors; and with --images the images.
    #[arg(long, value_name = "FOLDER")]
    nuscenes: Option<PathBuf>,

    /// Render the images again, and add them as JPEG.
    #[arg(long)]
    images: bool,

    /// Cast the sweeps of the LiDARs again, and add them as point clouds in the frame of the rig.
    /// The ego's motion during a sweep is taken out.
    #[arg(long, conflicts_with = "nuscenes")]
    lidar: bool,

    /// Write messages of ROS 2 in place of Foxglove's: clock, tf, odometry, camera_info, compressed
    /// images, point clouds and plans, for `ros2 bag play` and programs that read bags.
    #[arg(long, conflicts_with = "nuscenes")]
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
  wildcity episode export agent-1 --mcap agent-1-ros.mcap --images --lidar --ros2
  wildcity episode export agent-1 --nuscenes agent-1-nuscenes --images
  wildcity episode export run/episodes/straight-0-1.jsonl --mcap straight.mcap --images --camera front";

/// Difference of a calibration from its lens above which a note is printed, in pixels.
const NOTED_ERROR_PX: f64 = 0.1;

impl Export {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let path = super::find_record(&self.episode, &self.episodes)?;
        let target = self.target()?;
        let is_record = target
            // A target that does not exist yet has no canonical path, and is not the record.
            .canonicalize()
            .is_ok_and(|target| path.canonicalize().is_ok_and(|record| record == target));
        anyhow::ensure!(
            !is_record,
            "{}: this is the record itself; name another file",
            target.display()
        );
        let (exported, replayed) = if self.images || self.lidar {
            self.replayed(&path).map(|(exported, replayed)| (exported, Some(replayed)))?
        } else {
            (self.without_replay(&path)?, None)
        };
        let mut out = output::stdout();
        let what = if self.nuscenes.is_some() { "rows" } else { "messages" };
        writeln!(out, "exported    {} {what} to {}", exported.messages, target.display())?;
        if let Some(Replay { report, sweeps }) = &replayed {
            if self.images {
                writeln!(out, "images      {}", report.images)?;
            }
            if self.lidar {
                writeln!(out, "sweeps      {sweeps}")?;
            }
        }
        if let Some(difference) = replayed.and_then(|replayed| replayed.report.difference) {
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

    /// The file or the folder to write.
    fn target(&self) -> anyhow::Result<&Path> {
        let target = self.nuscenes.as_deref().or(self.mcap.as_deref());
        target.context("name a file with --mcap, or a folder with --nuscenes")
    }

    fn without_replay(&self, path: &Path) -> anyhow::Result<Exported> {
        let target = self.target()?;
        if self.nuscenes.is_none() && !self.ros2 {
            return Ok(export_file(path, target)?);
        }
        let episode = EpisodeFile::read(path)?;
        let rig = EpisodeFile::rig(path)?;
        if self.nuscenes.is_some() {
            return Ok(export_nuscenes(&episode, rig.as_ref(), target)?);
        }
        Ok(write_whole(target, |out| export_ros2(&episode, rig.as_ref(), out))?)
    }

    fn replayed(&self, path: &Path) -> anyhow::Result<(Exported, Replay)> {
        let episode = EpisodeFile::read(path)?;
        let rig = EpisodeFile::rig(path)?;
        let mut recording = RecordedEpisode::read(path)?;
        let count = recording.header.rig.cameras.len();
        let mut wanted = self
            .camera
            .iter()
            .map(|name| camera_index(&recording, name))
            .collect::<anyhow::Result<Vec<usize>>>()?;
        if wanted.is_empty() && self.images {
            wanted = (0..count).collect();
        }
        if self.lidar {
            anyhow::ensure!(
                !recording.header.rig.lidars.is_empty(),
                "--lidar: the rig {:?} of the episode has no LiDAR",
                recording.header.rig.name
            );
        } else {
            recording.leave_out_sweeps();
        }
        let shown = driven(&recording.frames);
        for (index, frame) in recording.frames.iter_mut().enumerate() {
            // Otherwise the session returned to an earlier state, and drove on from there.
            let is_shown = shown.binary_search(&index).is_ok();
            keep_cameras(frame, if is_shown { &wanted } else { &[] }, count);
            if !is_shown {
                frame.sweeps.clear();
            }
        }
        let cache = Cache::new(self.twins.catalog()?);
        let backend = self.backend.replay_backend(&recording.header.backend)?;
        let bar = progress::count("rendering");
        let parts = |frame: &FrameRecord| (frame.images.len() + frame.sweeps.len()) as u64;
        bar.set_length(recording.frames.iter().map(parts).sum());
        let replay = |add: &mut Add<'_>| -> Result<Replay, ExportError> {
            let mut sweeps = 0;
            let mut add = |replayed: &Replayed<'_>| {
                bar.inc(1);
                sweeps += u64::from(matches!(replayed, Replayed::Sweep(_)));
                add(replayed)
            };
            let replayed = recording.replay(&cache, &*backend, ReplayUntil::End, &mut add);
            let report = replayed.map_err(|error| ExportError::Images(error.to_string()))?;
            Ok(Replay { report, sweeps })
        };
        let target = self.target()?;
        let written = if self.nuscenes.is_some() {
            NuscenesExport::begin(&episode, rig.as_ref(), target).and_then(|mut export| {
                let replayed = replay(&mut |replayed| match replayed {
                    Replayed::Image(image) => add_to_nuscenes(&mut export, &recording, image),
                    // Without --lidar there is none.
                    Replayed::Sweep(_) => Ok(()),
                })?;
                Ok((export.finish()?, replayed))
            })
        } else {
            write_whole(target, |out| {
                let mut export = AnyExport::begin(self.ros2, &episode, rig.as_ref(), out)?;
                let replayed = replay(&mut |replayed| match replayed {
                    Replayed::Image(image) => add_to_mcap(&mut export, &recording, image),
                    Replayed::Sweep(sweep) => {
                        export.sweep(sweep).map_err(|error| error.to_string())
                    }
                })?;
                Ok((export.finish()?, replayed))
            })
        };
        bar.finish_and_clear();
        Ok(written?)
    }
}

/// What is done with each image and sweep.
type Add<'a> = dyn FnMut(&Replayed<'_>) -> Result<(), String> + 'a;

/// The result of driving and rendering an episode again.
struct Replay {
    report: ReplayReport,
    /// Sweeps that were added.
    sweeps: u64,
}

/// A file of one of the two kinds.
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

    fn sweep(&mut self, sweep: &ReplayedSweep<'_>) -> Result<(), ExportError> {
        let points = sweep.points();
        let sweep = ExportedSweep { lidar: sweep.lidar, time_us: sweep.time_us, points: &points };
        match self {
            Self::Foxglove(export) => export.sweep(&sweep),
            Self::Ros2(export) => export.sweep(&sweep),
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
fn add_to_mcap<W: io::Write + io::Seek>(
    export: &mut AnyExport<'_, W>,
    recording: &RecordedEpisode,
    image: &ReplayedImage<'_>,
) -> Result<(), String> {
    let Some((camera, time_us)) = place_and_time(recording, image) else { return Ok(()) };
    let jpeg = encoded(image)?;
    let added = export.image(&ExportedImage { camera, time_us, jpeg: &jpeg });
    added.map_err(|error| error.to_string())
}

/// Adds an image with the pose from which it was rendered, as [`add_to_mcap`] does.
fn add_to_nuscenes(
    export: &mut NuscenesExport<'_>,
    recording: &RecordedEpisode,
    image: &ReplayedImage<'_>,
) -> Result<(), String> {
    let Some((camera, time_us)) = place_and_time(recording, image) else { return Ok(()) };
    let poses = &recording.frames[image.frame].poses;
    let Some(&world_from_rig) = poses.get(image.pose) else { return Ok(()) };
    let jpeg = encoded(image)?;
    let added = export.image(&NuscenesImage { camera, time_us, world_from_rig, jpeg: &jpeg });
    added.map_err(|error| error.to_string())
}

/// Index of the camera of an image, and when it was taken; none if the record does not have it.
fn place_and_time(recording: &RecordedEpisode, image: &ReplayedImage<'_>) -> Option<(usize, i64)> {
    let frame = &recording.frames[image.frame];
    let has_time = !frame.times_us.is_empty() || image.pose + 1 == frame.poses.len();
    let cameras = &recording.header.rig.cameras;
    let camera = cameras.iter().position(|camera| camera.name == image.camera.name)?;
    has_time.then(|| (camera, frame.taken_us(image.pose)))
}

fn encoded(image: &ReplayedImage<'_>) -> Result<Vec<u8>, String> {
    let size = &image.camera.camera;
    jpeg(image.rgb8, size.width_px, size.height_px, session::JPEG_QUALITY)
}
