//! `wildcity episode video`.

use std::io::Write;
use std::path::{Path, PathBuf};

use wildcity_session::{RecordedEpisode, ReplayUntil, Replayed, ReplayedImage};
use wildcity_twin::residency::Cache;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{Episodes, Twins};
use crate::cli::{exit, output, progress};

use super::kept::{camera_index, keep_cameras};

/// Write the frames of an episode as numbered pictures, for a video.
///
/// The episode is driven and rendered again, and compared with its record. This program has no
/// video encoder. It prints an ffmpeg command that makes a video of the pictures, at the speed of
/// the simulation. The command pads an odd width or height with a black column or row, because most
/// players need even sizes.
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
        let path = super::find_record(&self.episode, &self.episodes)?;
        let mut recording = RecordedEpisode::read(&path).map_err(super::bad_input)?;
        let camera = match &self.camera {
            Some(name) => camera_index(&recording, name)?,
            None => 0,
        };
        for frame in &mut recording.frames {
            keep_cameras(frame, &[camera], recording.header.rig.cameras.len());
        }
        recording.leave_out_sweeps();
        output::create_dir(&self.out)?;
        let cache = Cache::new(self.twins.catalog()?);
        let header = &recording.header;
        let backend = self.backend.replay_backend(&header.backend)?;

        let bar = progress::count("rendering");
        bar.set_length(recording.frames.iter().map(|frame| frame.images.len() as u64).sum());
        let mut written = 0_usize;
        let report = recording.replay(&cache, &*backend, ReplayUntil::End, &mut |replayed| {
            let Replayed::Image(image) = replayed else { return Ok(()) };
            bar.inc(1);
            let path = self.out.join(format!("{written:06}.png"));
            written += 1;
            write_png(&path, image).map_err(|error| exit::chain(&error))
        })?;
        bar.finish_and_clear();

        let mut out = output::stdout();
        let name = &header.rig.cameras[camera].name;
        writeln!(out, "written     {written} pictures of camera {name} to {}", self.out.display())?;
        if let Some(difference) = &report.difference {
            writeln!(out, "differs     {difference}")?;
        }
        let size = &header.rig.cameras[camera].camera;
        // yuv420p has half the colour in both directions, and so needs even sides.
        let is_odd = size.width_px % 2 == 1 || size.height_px % 2 == 1;
        writeln!(
            out,
            "video       none: wildcity has no encoder. With ffmpeg:\n            ffmpeg -framerate {} -i '{}' {}-pix_fmt \
             yuv420p episode.mp4",
            1e6 / header.dt_us as f64,
            self.out.join("%06d.png").display(),
            if is_odd { PAD } else { "" }
        )?;
        Ok(())
    }
}

/// Most players support only yuv420p, which has one colour for 2 x 2 pixels: an odd size gets a
/// black row or column.
const PAD: &str = "-vf 'pad=ceil(iw/2)*2:ceil(ih/2)*2' ";

fn write_png(path: &Path, image: &ReplayedImage<'_>) -> anyhow::Result<()> {
    let size = &image.camera.camera;
    let file = wildcity_session::png(image.rgb8, size.width_px, size.height_px);
    output::write(path, &file.map_err(anyhow::Error::msg)?)
}
