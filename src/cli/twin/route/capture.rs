//! `wildcity twin route from-colmap` and `wildcity twin route from-nerfstudio`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use wildcity_scene::align::{
    CaptureOptions, CapturedDrive, DEFAULT_FPS, PosedImage, captured_drive,
};
use wildcity_twin::ingest::capture;

use super::files::to_json;
use crate::cli::placement::Placement;
use crate::cli::{file_notes, output};

/// Make a drive and a rig from the camera poses of a COLMAP model.
///
/// DIR has cameras.bin and images.bin, or cameras.txt and images.txt, or has them in sparse/0. Each
/// folder of images belongs to one camera of the rig. The rig stands level on the ground under the
/// camera with the most images, and looks where that camera looks. Images are in the order of their
/// names.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity import point_cloud.ply --twin street --axes y-down-z-forward
  wildcity twin align street --apply
  wildcity twin route from-colmap capture/sparse/0 --twin street --out drive
  wildcity twin drive street --trajectory drive/capture.json --rig drive/rig.json")]
pub(in crate::cli) struct FromColmap {
    /// The folder of the model, or one that has it in sparse/0.
    #[arg(value_name = "DIR")]
    source: PathBuf,

    #[command(flatten)]
    options: DriveOptions,
}

/// Make a drive and a rig from the camera poses of a transforms.json of nerfstudio or instant-ngp.
///
/// Each folder of images belongs to one camera of the rig. The rig stands level on the ground under
/// the camera with the most images, and looks where that camera looks. Images are in the order of
/// their names. The poses must be in the axes of the scene: nerfstudio moves and scales them when
/// it trains (--orientation-method none --center-method none --auto-scale-poses False keeps them).
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin route from-nerfstudio capture/transforms.json --twin street --out drive
  wildcity twin route from-nerfstudio capture --axes identity --camera-height-m 1.6 --fps 30 --out drive")]
pub(in crate::cli) struct FromNerfstudio {
    /// The file, or its folder.
    #[arg(value_name = "FILE")]
    source: PathBuf,

    #[command(flatten)]
    options: DriveOptions,
}

/// Options of both commands.
#[derive(Debug, clap::Args)]
struct DriveOptions {
    #[command(flatten)]
    placement: Placement,

    /// Name of the drive and of the rig, made of a-z 0-9 . _ -.
    #[arg(long, value_name = "NAME", default_value = "capture")]
    name: String,

    /// Images per second of the capture, if its images have no times (time_us of each frame of a
    /// transforms.json) [default: 10]
    #[arg(long, value_name = "N")]
    fps: Option<f64>,

    /// Height of the camera above the ground, in metres [default: the ground is at z = 0 of the
    /// twin]
    #[arg(long, value_name = "M")]
    camera_height_m: Option<f64>,

    /// Folder of the images of the camera that looks ahead [default: the one with the most images]
    #[arg(long, value_name = "FOLDER")]
    reference: Option<String>,

    /// Folders of the images of the rig's cameras, separated by commas [default: all]
    #[arg(long, value_name = "FOLDERS", value_delimiter = ',')]
    cameras: Vec<String>,

    /// Folder for NAME.json and rig.json; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl FromColmap {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.options.write(&capture::read_colmap(&self.source)?)
    }
}

impl FromNerfstudio {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let capture::NerfstudioCapture { frames, warnings } =
            capture::read_nerfstudio(&self.source)?;
        file_notes::print_warnings(&self.source, &warnings)?;
        let images: Vec<PosedImage> = frames.into_iter().map(|frame| frame.posed).collect();
        self.options.write(&images)
    }
}

impl DriveOptions {
    fn write(self, images: &[PosedImage]) -> anyhow::Result<()> {
        let Self { placement, name, fps, camera_height_m, reference, cameras, out } = self;
        anyhow::ensure!(
            name != "rig",
            "--name rig: the drive and the rig would both be written to rig.json; choose another name"
        );
        let alignment = placement.alignment()?;
        let options = CaptureOptions { name, fps, camera_height_m, reference, cameras };
        let made = captured_drive(images, &alignment, &options)?;
        if options.fps.is_none() && images.iter().all(|image| image.time_us.is_none()) {
            writeln!(
                io::stderr(),
                "note: the images have no times: {DEFAULT_FPS} a second are assumed (--fps)"
            )?;
        }
        output::create_dir(&out)?;
        let drive = out.join(format!("{}.json", options.name));
        let rig = out.join("rig.json");
        output::write(&drive, &to_json(&made.trajectory)?)?;
        let mut text = serde_json::to_vec_pretty(&made.rig).context("the rig")?;
        text.push(b'\n');
        output::write(&rig, &text)?;

        let CapturedDrive { trajectory, rig: cameras, camera_height_m, most_tilt_rad } = made;
        let names: Vec<&str> = cameras.cameras.iter().map(|camera| camera.name.as_str()).collect();
        writeln!(
            output::stdout(),
            "{}, {:.1} m; camera {camera_height_m:.2} m above the ground, tilted by up to {:.1} degrees\n\
             cameras {}\n{}\n{}",
            output::counted(trajectory.keyframes.len(), "keyframe"),
            trajectory.length_m(),
            most_tilt_rad.to_degrees(),
            names.join(", "),
            drive.display(),
            rig.display(),
        )?;
        Ok(())
    }
}
