//! `wildcity episode verify`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;

use wildcity_session::{
    FrameRequest, RecordedEpisode, RecordedRepair, RepairedImages, ReplayUntil, Replayed,
    ReplayedImage,
};
use wildcity_twin::residency::Cache;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{Episodes, Twins};
use crate::cli::exit::{self, Exit};
use crate::cli::output::{self, counted};
use crate::cli::progress;
use crate::cli::repair_options::RepairOptions;

use super::folder::record_file;

/// Render a recorded episode again, and compare every image with the recording.
///
/// Prints a summary of the recording, and the first step and camera where pixels differ from the
/// recorded ones. The exit code is 1 if an image, a time, a hash or the summary at the end differs,
/// or if there are no frames. It is 3 if everything is as recorded, but the recording was cut: the
/// episode still runs, or the server was killed.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Verify {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    /// Write every image as DIR/<frame>_<request>_<camera>.png; the directory is created if it is
    /// missing. Without it, the command stops at the first difference.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    #[command(flatten)]
    episodes: Episodes,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,

    #[command(flatten)]
    repair: RepairOptions,
}

/// The exit code for a recording that was cut and is as recorded up to there.
const CUT_EXIT_CODE: u8 = 3;

const EXAMPLES: &str = "\
Examples:
  wildcity episode verify agent-1
  wildcity episode verify run/episodes/agent-1.jsonl
  wildcity episode verify agent-1 --repair zero-dce.json   (repairs images again, too)
  wildcity episode verify agent-1 --out images --backend reference";

impl Verify {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let file = record_file(&self.episode, &self.episodes)?;
        let recording = RecordedEpisode::read(&file).map_err(super::bad_input)?;
        let mut out = output::stdout();
        summary(&mut out, &recording)?;
        if let Some(dir) = &self.out {
            output::create_dir(dir)?;
        }
        let cache = Cache::new(self.twins.catalog()?);
        let header = &recording.header;
        let backend = self.backend.replay_backend(&header.backend)?;

        let bar = progress::count("rendering");
        bar.set_length(recording.frames.iter().map(|frame| frame.images.len() as u64).sum());
        // With --out all images are rendered. Without it, the first difference decides the result.
        let extent =
            if self.out.is_some() { ReplayUntil::End } else { ReplayUntil::FirstDifference };
        let models = self.repair.models()?;
        let report =
            recording.replay_repaired(&cache, &*backend, &models, extent, &mut |replayed| {
                let Replayed::Image(image) = replayed else { return Ok(()) };
                bar.inc(1);
                match &self.out {
                    Some(dir) => write_png(dir, image).map_err(|error| exit::chain(&error)),
                    None => Ok(()),
                }
            })?;
        bar.finish_and_clear();

        for change in &report.changes {
            writeln!(out, "changed     {}: {} -> {}", change.what, change.recorded, change.now)?;
        }
        if let Some(diverged) = &report.diverged {
            anyhow::bail!("diverges at {diverged}");
        }
        if let Some(difference) = &report.difference {
            anyhow::bail!("differs at {difference}");
        }
        let sweeps = with_sweeps(report.sweeps as usize);
        let images = counted(report.images as usize, "image");
        writeln!(out, "verified    {images}{sweeps}, all as recorded")?;
        let RepairedImages { compared, not_compared } = report.repaired;
        if compared > 0 {
            let compared = counted(compared as usize, "image");
            writeln!(out, "repaired    {compared}, repaired again and compared")?;
        }
        if not_compared > 0 {
            let images = counted(not_compared as usize, "image");
            let model = header.repair.as_ref().map_or("", |repair| &repair.model);
            writeln!(
                out,
                "repaired    {images}, compared as rendered only: give the model {model} with --repair"
            )?;
        }
        if let Some(wrong) = &report.wrong_value {
            anyhow::bail!("the record contradicts itself: {wrong}");
        }
        // An empty or unfinished recording does not prove that the whole episode repeats.
        let last = recording.frames.last().context("the recording has no frames")?;
        if recording.end.is_none() {
            let step = last.step;
            let message = format!(
                "the recording is cut, verified to step {step}: the episode still runs, or was interrupted"
            );
            return Err(Exit::error(CUT_EXIT_CODE, message).into());
        }
        Ok(())
    }
}

fn summary(out: &mut impl Write, recording: &RecordedEpisode) -> io::Result<()> {
    let RecordedEpisode { header, frames, versions, end, .. } = recording;
    let cameras = header.rig.cameras.iter().map(|camera| camera.name.clone());
    let lidars = header.rig.lidars.iter().map(|lidar| format!("{} (LiDAR)", lidar.name));
    let sensors: Vec<String> = cameras.chain(lidars).collect();
    let sweeps = with_sweeps(frames.iter().map(|frame| frame.sweeps.len()).sum());
    let images: usize = frames.iter().map(|frame| frame.images.len()).sum();
    writeln!(out, "session     {}, seed {}", header.session, header.seed)?;
    writeln!(out, "twin        {} version {}", header.twin, header.version)?;
    writeln!(out, "manifest    {}", header.version_hash)?;
    writeln!(out, "recorded by {}, backend {}", header.build, header.backend)?;
    writeln!(out, "rig         {}: {}", header.rig.name, sensors.join(", "))?;
    if let Some(repair) = &header.repair {
        let count = frames.iter().flat_map(|frame| &frame.repairs).flatten().count();
        let RecordedRepair { model, version, provider, .. } = repair;
        let images = counted(count, "image");
        writeln!(out, "repair      {model} {version} on {provider}, {images}")?;
    }
    let images = counted(images, "image");
    writeln!(out, "frames      {} with {images}{sweeps}", frames.len())?;
    for (before, version) in versions {
        writeln!(
            out,
            "switched    to version {} after {}",
            version.version,
            counted(*before, "frame")
        )?;
    }
    match end {
        Some(end) => writeln!(
            out,
            "end         {:?} after {}, {:.1} s, {:.1} m",
            end.outcome,
            counted(end.steps as usize, "step"),
            end.time_us as f64 * 1e-6,
            end.distance_m,
        ),
        None => {
            writeln!(out, "end         not recorded: the episode still runs, or was interrupted")
        }
    }
}

/// The number of LiDAR sweeps beside that of images; nothing without LiDAR.
fn with_sweeps(count: usize) -> String {
    if count == 0 { String::new() } else { format!(" and {}", counted(count, "sweep")) }
}

fn write_png(dir: &Path, image: &ReplayedImage<'_>) -> anyhow::Result<()> {
    let ReplayedImage { frame, request, pose, camera, rgb8, .. } = image;
    let request = match request {
        FrameRequest::Reset => "reset".to_owned(),
        FrameRequest::Step => "step".to_owned(),
        FrameRequest::Restore => "restore".to_owned(),
        FrameRequest::Observe => format!("observe{pose}"),
    };
    let path = dir.join(format!("{frame:06}_{request}_{}.png", camera.name));
    let width = camera.camera.width_px;
    let height = camera.camera.height_px;
    let file = wildcity_session::png(rgb8, width, height).map_err(anyhow::Error::msg);
    output::write(&path, &file.with_context(|| format!("cannot write {}", path.display()))?)
}
