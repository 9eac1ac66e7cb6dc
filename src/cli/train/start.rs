//! What a run of training begins with.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use glam::DVec3;
use wildcity_log::ColoredPoint;
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile};
use wildcity_train::settings::Settings;
use wildcity_train::start::{Point, gaussians_from_points};
use wildcity_train::trainer::Start;
use wildcity_twin::ingest::{self, ReadLimits, ReadScene, capture};

use super::log_images::LogImages;
use crate::cli::{file_notes, progress};

/// What a run begins with.
#[derive(Debug, clap::Args)]
pub(super) struct StartOptions {
    /// Points to begin with: a PLY file, or a COLMAP model [default: those of SOURCE; of a log,
    /// those of its LiDAR]
    #[arg(long, value_name = "POINTS")]
    points: Option<PathBuf>,

    /// Gaussians to begin with instead: a scene that was trained here or by another program, in any
    /// format that `wildcity import` reads, in the axes and the unit of SOURCE.
    #[arg(long, value_name = "SCENE", conflicts_with = "points")]
    start: Option<PathBuf>,
}

impl StartOptions {
    /// Whether the run begins with a scene, and not with points.
    pub(super) fn is_scene(&self) -> bool {
        self.start.is_some()
    }

    /// The Gaussians that the run begins with, and its image formation.
    pub(super) fn read(
        &self,
        source: &Path,
        settings: &Settings,
    ) -> anyhow::Result<(Start, RenderProfile)> {
        let profile = RenderProfile::default();
        let cap = settings.growth.cap;
        if let Some(start) = &self.start {
            let cannot = || format!("--start {}", start.display());
            let bar = progress::bytes("reading");
            let limits = ReadLimits::for_own_file();
            let read = ingest::read_limited(start, &limits, &mut progress::show(&bar));
            let ReadScene { gaussians, notes, .. } = read.with_context(cannot)?;
            bar.finish_and_clear();
            file_notes::print(start, &notes)?;
            let count = gaussians.len();
            ensure!(
                count <= cap,
                "{} has {count} Gaussians, more than --cap {cap}",
                start.display()
            );
            let start = Start { gaussians, ..Start::default() };
            return Ok((start, notes.profile().apply(profile)?));
        }
        let mut points = self.read_points(source)?;
        let all = points.len();
        if all > cap {
            choose(&mut points, cap, settings.seed);
            writeln!(io::stderr(), "{cap} of {all} points are chosen; --cap changes it")?;
        }
        let gaussians = gaussians_from_points(&points);
        Ok((Start { gaussians, ..Start::default() }, profile))
    }

    fn read_points(&self, source: &Path) -> anyhow::Result<Vec<Point>> {
        let source = match &self.points {
            Some(points) => points.clone(),
            None => listed_points(source)?,
        };
        ensure!(source.exists(), "there are no points at {}", source.display());
        let found = capture::read_points(&source)?;
        let read = found.filter(|points| !points.is_empty()).with_context(|| {
            format!(
                "{} has no points to begin with: give --points, a PLY file or a COLMAP model with \
                 points3D.bin or points3D.txt",
                source.display()
            )
        })?;
        let point = |point: capture::CapturePoint| Point {
            at_m: DVec3::from_array(point.at),
            rgb: point.rgb8.map(|value| f64::from(value) / 255.0),
        };
        Ok(read.into_iter().map(point).collect())
    }

    /// The same for a log: without options, the points of its LiDAR. Poses are those of its rig,
    /// and Gaussians on the ground are known by its drive.
    pub(super) fn read_for_log(
        &self,
        source: &Path,
        images: &LogImages,
        settings: &Settings,
    ) -> anyhow::Result<(Start, RenderProfile)> {
        let (mut start, profile) = match (&self.start, &self.points) {
            (None, None) => (logged_start(images, settings)?, RenderProfile::default()),
            _ => self.read(source, settings)?,
        };
        start.world_from_camera = images.world_from_camera();
        start.rig = Some(images.rig.clone());
        let means_m: Vec<DVec3> =
            start.gaussians.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
        start.is_ground = images.ground(&means_m)?;
        Ok((start, profile))
    }
}

/// Images of each camera of a log whose points of the LiDAR a run begins with.
const STARTING_IMAGES: usize = 100;

/// Most points of a LiDAR that a run begins with: more are added where images need them.
const MOST_LIDAR_POINTS: usize = 500_000;

/// Points of the LiDAR of a log in the colours of its images.
fn logged_start(images: &LogImages, settings: &Settings) -> anyhow::Result<Start> {
    let most = settings.growth.cap.min(MOST_LIDAR_POINTS);
    let points = wildcity_log::colored_points(images.log(), images.poses(), STARTING_IMAGES, most)?;
    ensure!(
        !points.is_empty(),
        "the log has no points of a LiDAR that its images show: give --points, a PLY file or a COLMAP model"
    );
    let point = |point: &ColoredPoint| Point {
        at_m: point.at_m,
        rgb: point.rgb8.map(|value| f64::from(value) / 255.0),
    };
    let points: Vec<Point> = points.iter().map(point).collect();
    Ok(Start { gaussians: gaussians_from_points(&points), ..Start::default() })
}

/// A text by which a checkpoint knows its Gaussians.
pub(super) fn inputs(gaussians: &Gaussians) -> String {
    let Gaussians { sh_degree, means_m, ln_scales, quats_wxyz, logit_opacities, sh, classes } =
        gaussians;
    let mut hasher = blake3::Hasher::new();
    let mut bytes: Vec<u8> = means_m.as_flattened().iter().flat_map(|m| m.to_le_bytes()).collect();
    hasher.update(&bytes);
    for values in [ln_scales.as_flattened(), quats_wxyz.as_flattened(), logit_opacities, sh] {
        bytes.clear();
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        hasher.update(&bytes);
    }
    if let Some(classes) = classes {
        hasher.update(&classes.iter().map(|class| class.value()).collect::<Vec<u8>>());
    }
    format!("{} Gaussians of degree {sh_degree}, {}\n", gaussians.len(), hasher.finalize())
}

/// Keeps as many points as `count`, at random.
fn choose(points: &mut Vec<Point>, count: usize, seed: u64) {
    let mut random = Random::new(seed, "points", 0);
    for k in (1..points.len()).rev() {
        points.swap(k, random.below(k + 1));
    }
    points.truncate(count);
}

/// Where the points of a list are: in the PLY file that a transforms.json names, or in its folder,
/// which may be or have a COLMAP model.
fn listed_points(source: &Path) -> anyhow::Result<PathBuf> {
    let mut folder = source;
    let mut list = source.join("transforms.json");
    if source.extension().is_some_and(|extension| extension == "json") {
        folder = source.parent().unwrap_or(source);
        list = source.to_owned();
    }
    if list.is_file() {
        let cannot = || format!("cannot read {}", list.display());
        let text = fs::read(&list).with_context(cannot)?;
        let json: serde_json::Value = serde_json::from_slice(&text).with_context(cannot)?;
        if let Some(name) = json.get("ply_file_path").and_then(serde_json::Value::as_str) {
            return Ok(folder.join(name));
        }
    }
    // The folder of a bare name is the current one.
    Ok(if folder.as_os_str().is_empty() { PathBuf::from(".") } else { folder.to_owned() })
}
