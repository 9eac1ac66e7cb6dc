//! `wildcity twin align`.

mod picture;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use glam::DVec3;

use wildcity_scene::Gaussians;
use wildcity_scene::align::{
    Alignment, CaptureCameras, GroundPlane, GroundSearch, find_ground, find_ground_below,
    scale_from_points,
};
use wildcity_scene::geometry::Pose;
use wildcity_twin::ingest::capture;
use wildcity_twin::store::{Catalog, Edit, Version};

use super::{blind, change};
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::{file_notes, output, placement, progress};

/// Put a capture on the ground: find the plane that the scene stands on, and make it level, at
/// height 0, in metres.
///
/// Without --apply nothing changes: the command prints the ground that it found, and draws the twin
/// before and after, with the ground as a grid. Look at the picture, then run the command again
/// with --apply: that makes a new version, with the drives and the sky of the old one in the new
/// axes. The twin's place on the earth is dropped, because it belongs to the old axes. Open
/// sessions keep the version that they have. The version records the change:
/// `wildcity push --frame capture` pushes files that are still in the axes of the capture.
///
/// The ground is the plane with most of the scene on it and little of it below. With --cameras it
/// is the plane below the cameras, and a small part of the scene on it is enough. The same twin
/// gives the same plane. All Gaussians are in memory at once: 56 bytes each without SH, 236 with SH
/// degree 3, and as much for the picture.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Align {
    #[command(flatten)]
    edited: EditedTwin,

    /// Direction that is up in the twin now, within 45 degrees: x, -x, y, -y, z, -z; auto tries all
    /// directions.
    #[arg(long, value_name = "AXIS", default_value = "auto", allow_hyphen_values = true)]
    up: Up,

    /// The COLMAP model or the transforms.json that the scene was trained from: its cameras are
    /// above the ground, and say where up is, unless --up does.
    #[arg(long, value_name = "SOURCE")]
    cameras: Option<PathBuf>,

    /// Median height of these cameras above the ground, in metres, which gives the scale: 1.6 if
    /// they were held at the eyes.
    #[arg(long, value_name = "M", requires = "cameras", conflicts_with_all = ["from", "scale"],
        value_parser = height_m)]
    camera_height_m: Option<f64>,

    /// First of two points whose real distance is known, in the twin's axes and unit; see --to and
    /// --distance-m.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, requires_all = ["to", "distance_m"])]
    from: Option<Point>,

    /// Second of the two points.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "from")]
    to: Option<Point>,

    /// Real distance between the two points, in metres.
    #[arg(long, value_name = "M", requires = "from")]
    distance_m: Option<f64>,

    /// Metres per unit of the twin, in place of two points [default: 1]
    #[arg(long, value_name = "M", conflicts_with = "from")]
    scale: Option<f64>,

    /// PNG file to write: the twin before in the upper row and after in the lower one; on the left
    /// a slice from the side, on the right the view from above [default: TWIN-align.png]
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,

    /// Make the new version.
    #[arg(long)]
    apply: bool,

    /// Seed of the search.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin align street                                  (look at street-align.png)
  wildcity twin align street --apply
  wildcity twin align capture --cameras sparse/0 --camera-height-m 1.6
  wildcity twin align capture --up -y --from 0.1,0,2 --to 0.1,0,2.7 --distance-m 1.2 --apply";

/// A direction that is up, or any.
#[derive(Clone, Copy, Debug)]
struct Up(Option<DVec3>);

impl FromStr for Up {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Ok(Self(match text {
            "auto" => None,
            "x" => Some(DVec3::X),
            "-x" => Some(DVec3::NEG_X),
            "y" => Some(DVec3::Y),
            "-y" => Some(DVec3::NEG_Y),
            "z" => Some(DVec3::Z),
            "-z" => Some(DVec3::NEG_Z),
            _ => return Err("expected auto, x, -x, y, -y, z or -z".to_owned()),
        }))
    }
}

#[derive(Clone, Copy, Debug)]
struct Point(DVec3);

impl FromStr for Point {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
        match numbers.as_deref() {
            Ok(&[x, y, z]) if [x, y, z].iter().all(|n| n.is_finite()) => {
                Ok(Self(DVec3::new(x, y, z)))
            }
            _ => Err("expected three numbers, such as 1.5,-2,0".to_owned()),
        }
    }
}

impl Align {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let metres_per_unit = self.metres_per_unit()?;
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let cameras = self.read_cameras(&catalog, &base)?;
        let sh_degree = base.manifest.sh_degree;
        let mut gaussians = Gaussians { sh_degree, ..Gaussians::default() };
        // In full detail only: coarser levels show the same surfaces again.
        catalog.visit_full_detail(&base, &|_| true, &mut |section| gaussians.append(&section))?;

        let search = GroundSearch { up: self.up.0, seed: self.seed, ..GroundSearch::default() };
        let found = match &cameras {
            None => find_ground(&gaussians, &search),
            Some(cameras) => find_ground_below(&gaussians, cameras, &search),
        };
        let ground = found.with_context(|| format!("twin {}", self.edited.twin.name))?;
        let height = cameras.map(|cameras| cameras.height_above(&ground));
        let scale = match (self.camera_height_m, height) {
            // `height` is that of the cameras in units of the twin; the wanted one is in metres.
            (Some(height_m), Some(height)) => height_m / height,
            _ => metres_per_unit,
        };
        let alignment = Alignment::onto(&ground).scaled(scale).context("--camera-height-m")?;
        print_proposal(&ground, &alignment)?;
        if let Some(height) = height {
            let height_m = scale * height;
            writeln!(output::stdout(), "cameras     {height_m:.2} m above the ground (median)")?;
        }

        let picture = self
            .picture
            .clone()
            .unwrap_or_else(|| format!("{}-align.png", self.edited.twin.name).into());
        // Before the version is written: the picture shows whether the proposal is right.
        let (png, step_m) =
            picture::before_and_after(gaussians, &alignment, base.manifest.profile)?;
        output::write(&picture, &png)?;
        let picture = picture.display();
        writeln!(output::stdout(), "picture     {picture}, with a grid of {} m", rounded(step_m))?;
        if !self.apply {
            writeln!(output::stdout(), "nothing is changed: look at it, then give --apply")?;
            return Ok(());
        }

        let bar = progress::count("writing");
        let edit = Edit { alignment, trajectories: Vec::new(), rig: None };
        let version = catalog.edit(&base, edit, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        // An anchor is the place of the old origin, with the old axes.
        if base.manifest.geo.is_some() {
            let name = &self.edited.twin.name;
            writeln!(
                io::stderr(),
                "note: the version has no place on the earth, because it was that of the old axes: \
                 `wildcity twin geo {name}` says it again"
            )?;
        }
        blind::warn(&catalog, &version)?;
        change::print(&version, "the ground is level, at height 0")
    }

    /// The cameras of `--cameras`, in the axes of the twin.
    fn read_cameras(
        &self,
        catalog: &Catalog,
        base: &Version,
    ) -> anyhow::Result<Option<CaptureCameras>> {
        let Some(source) = &self.cameras else { return Ok(None) };
        let in_twin = placement::from_version(catalog, base).context(
            "--cameras: their poses cannot be placed in the twin; leave it out, and give --up",
        )?;
        let poses = read_poses(source).context("--cameras")?;
        let poses: Vec<Pose> = poses.iter().map(|pose| in_twin.pose(pose)).collect();
        let cameras = match self.up.0 {
            None => CaptureCameras::new(&poses),
            Some(up) => CaptureCameras::with_up(&poses, up),
        };
        cameras.context("--cameras").map(Some)
    }

    /// The scale of the options.
    fn metres_per_unit(&self) -> anyhow::Result<f64> {
        match (self.from, self.to, self.distance_m) {
            (Some(from), Some(to), Some(distance_m)) => {
                Ok(scale_from_points([from.0, to.0], distance_m)
                    .context("--from, --to, --distance-m")?)
            }
            _ => {
                let scale = self.scale.unwrap_or(1.0);
                // Checked here, so that a bad scale is refused before the twin is read.
                Alignment::IDENTITY.scaled(scale).context("--scale")?;
                Ok(scale)
            }
        }
    }
}

/// The poses of the cameras of a COLMAP model or a transforms.json.
fn read_poses(source: &Path) -> anyhow::Result<Vec<Pose>> {
    let is_colmap = source.is_dir() && !source.join("transforms.json").is_file();
    let images = if is_colmap {
        capture::read_colmap(source)?
    } else {
        let capture::NerfstudioCapture { frames, warnings } = capture::read_nerfstudio(source)?;
        file_notes::print_warnings(source, &warnings)?;
        frames.into_iter().map(|frame| frame.posed).collect()
    };
    Ok(images.into_iter().map(|image| image.world_from_camera).collect())
}

fn height_m(text: &str) -> Result<f64, String> {
    match text.parse() {
        // NaN is in no range, and is refused, too.
        Ok(height_m) if (1e-3..=1e4).contains(&height_m) => Ok(height_m),
        _ => Err("expected a height above the ground in metres, such as 1.6".to_owned()),
    }
}

/// Without the rounding errors of a power of ten: 0.1 for 0.10000000000000003.
fn rounded(step_m: f64) -> f64 {
    // A power of ten that keeps the first digit of a step below 1: 0.2000000001 becomes 0.2.
    let digits = 10_f64.powf((-step_m.log10()).ceil().max(0.0));
    (step_m * digits).round() / digits
}

fn print_proposal(ground: &GroundPlane, alignment: &Alignment) -> anyhow::Result<()> {
    let mut out = output::stdout();
    let DVec3 { x, y, z } = ground.up;
    let tilt_degrees = ground.up.angle_between(DVec3::Z).to_degrees();
    let height = ground.up.dot(ground.point);
    let below = if height < 0.0 { "below" } else { "above" };
    writeln!(
        out,
        "ground      {:.3} {below} the origin; up is ({x:.4}, {y:.4}, {z:.4}), {tilt_degrees:.2} degrees from z",
        height.abs()
    )?;
    writeln!(out, "scale       {} m per unit", alignment.metres_per_unit)?;
    Ok(())
}
