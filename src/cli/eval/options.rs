//! Options of `wildcity eval` for labels, networks and views beside the drive.

use std::path::PathBuf;

use wildcity_repair::LoadOptions;

use crate::cli::repair_options::runtime_library;

/// Largest value of `--lidar-window`, in seconds.
const LONGEST_S: f64 = 10.0;

/// `--boxes` and `--lidar`.
#[derive(Debug, clap::Args)]
pub(super) struct LabelOptions {
    /// File of boxes around vehicles and pedestrians, one JSON object per line: time_us, track,
    /// size (length, width, height in the unit of the poses), world_from_box ({"xyz", "q"}: the
    /// middle of the box, in the axes of the poses of --images), and optionally velocity. Pixels in
    /// boxes that move faster than 1 m/s do not count. The images need time_us in their list.
    #[arg(long, value_name = "FILE")]
    pub(super) boxes: Option<PathBuf>,

    /// Points of a LiDAR, a safetensors file: points_m [n, 3], time_us [n]; and optionally
    /// rig_from_lidar [4, 4], pose_time_us [m] and world_from_rig [m, 4, 4] in the axes of the
    /// poses of --images [default: the twin's first drive]. The rendered depth is compared with
    /// these points. The images need time_us in their list, in the same clock.
    #[arg(long, value_name = "FILE")]
    pub(super) lidar: Option<PathBuf>,

    /// Largest time between an image and the LiDAR points that are compared with it, in seconds.
    #[arg(long, value_name = "S", default_value = "0.05", value_parser = seconds, requires = "lidar")]
    pub(super) lidar_window: f64,
}

/// `--lpips` and `--features`.
#[derive(Debug, clap::Args)]
pub(super) struct NetworkOptions {
    /// Manifest of a network that computes the distance between two images, such as LPIPS
    /// (docs/evaluation.md). Pixels that do not count are replaced by those of the real image.
    #[arg(long, value_name = "FILE")]
    pub(super) lpips: Option<PathBuf>,

    /// Manifest of a network that computes the features of an image, such as Inception. They give
    /// KID, the distance between the set of rendered images and the set of real ones; with
    /// --extrapolate also for the views off the drive.
    #[arg(long, value_name = "FILE")]
    pub(super) features: Option<PathBuf>,
}

/// Largest number of threads of a network.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;

/// `--repair` and the runtime of networks.
#[derive(Debug, clap::Args)]
pub(super) struct RepairerOptions {
    /// Also repair each image with the model of this manifest (docs/repair.md), and compare the
    /// repaired image, too. Every image is repaired, at any trust. A model that compares with
    /// recorded images needs a twin with a drive; the images that are compared here are withheld
    /// from it.
    #[arg(long, value_name = "FILE")]
    pub(super) repair: Option<PathBuf>,

    /// ONNX Runtime library for --repair, --lpips and --features, version 1.18 or later [default:
    /// $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of each network on the processor. The results do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,
}

/// Largest distance from the drive, in metres.
const FARTHEST_M: f64 = 50.0;

/// Largest number of distances.
const MOST: usize = 16;

/// The distances of `--extrapolate`, in metres.
#[derive(Clone, Debug)]
pub(super) struct Offsets(pub(super) Vec<f64>);

impl std::str::FromStr for Offsets {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let must = || {
            format!(
                "expected 1 to {MOST} distances in metres, such as 1,3,5: at most {FARTHEST_M}, not 0"
            )
        };
        let offset = |text: &str| text.trim().parse::<f64>().map_err(|_| must());
        let offsets = text.split(',').map(offset).collect::<Result<Vec<f64>, String>>()?;
        // NaN fails the second comparison.
        let is_offset = |offset: &f64| *offset != 0.0 && offset.abs() <= FARTHEST_M;
        if offsets.len() > MOST || !offsets.iter().all(is_offset) {
            return Err(must());
        }
        Ok(Self(offsets))
    }
}

impl RepairerOptions {
    /// How networks are loaded.
    pub(super) fn load_options(&self) -> LoadOptions {
        let library = runtime_library(self.onnxruntime.as_ref());
        LoadOptions { threads: self.repair_threads.into(), ..LoadOptions::new(library) }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let must = || format!("expected seconds from 0 to {LONGEST_S}");
    let seconds: f64 = text.parse().map_err(|_| must())?;
    if (0.0..=LONGEST_S).contains(&seconds) { Ok(seconds) } else { Err(must()) }
}
