//! `wildcity twin label`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;
use glam::DVec3;

use wildcity_scene::SemanticClass;
use wildcity_scene::geometry::Pose;
use wildcity_sim::ground::{DriveBoxes, Ground};
use wildcity_sim::limits::MAP_BYTES;
use wildcity_sim::scenario::TracksFile;
use wildcity_twin::ingest;
use wildcity_twin::store::{CutPlace, Labels};

use crate::cli::actor::{Region, swept};
use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output;

/// Farthest of the plane of the nearest drive that counts as the ground, in metres: less than the
/// height of a kerb.
const GROUND_M: f64 = 0.1;

/// Give Gaussians of a twin classes, which sessions get with `outputs.semantics`: makes a new
/// version.
///
/// Classes are the names of Cityscapes, such as road, sidewalk, building, vegetation, pole and car;
/// an unknown name lists them all. Boxes take precedence over tracks, and tracks over the ground.
/// Gaussians of no box, track or ground keep their classes. Open sessions keep the version that
/// they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("what").args(["ground", "tracks", "boxes"]).required(true).multiple(true))]
pub(in crate::cli) struct Label {
    /// The twin: NAME, or NAME@NUMBER to start from an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// Class of the Gaussians on the ground: within 10 cm of the plane of the wheels of the nearest
    /// recorded drive, and at most 25 m from it.
    #[arg(long, value_name = "CLASS", value_parser = parse_class)]
    ground: Option<SemanticClass>,

    /// Give the Gaussians that recorded actors of a wildcity.tracks/1 file swept the class of their
    /// actor: vehicle, person, bicycle or dynamic.
    #[arg(long, value_name = "FILE")]
    tracks: Option<PathBuf>,

    /// Give the Gaussians in a box a class, from 5 cm above its bottom on: the class, the point on
    /// the ground under its middle and its heading, in world axes (metres, and degrees to the left
    /// from x), and its length, width and height in metres. May be given several times.
    #[arg(long = "box", value_name = "CLASS,X,Y,Z,DEGREES,L,W,H", value_parser = parse_box)]
    boxes: Vec<(SemanticClass, Region)>,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin label street --ground road
  wildcity twin label street --box car,31.2,-4.8,0,0,4.6,1.9,1.6 --box building,40,20,0,0,12,10,15
  wildcity twin label street --tracks recorded.tracks.json";

fn parse_class(name: &str) -> Result<SemanticClass, String> {
    let class = SemanticClass::from_name(name).filter(|class| *class != SemanticClass::None);
    class.ok_or_else(|| {
        // Without the first one, `None`, which a label cannot be.
        let names: Vec<&str> = SemanticClass::ALL[1..].iter().map(|class| class.name()).collect();
        format!("there is no class {name:?}; the classes are {}", names.join(", "))
    })
}

fn parse_box(text: &str) -> Result<(SemanticClass, Region), String> {
    const FORM: &str = "a box is CLASS,X,Y,Z,DEGREES,L,W,H: a class, the middle of its bottom in metres, its heading, \
                        and its length, width and height in metres";
    let (class, region) = text.split_once(',').ok_or(FORM)?;
    Ok((parse_class(class)?, region.parse().map_err(|error| format!("{error}; {FORM}"))?))
}

impl Label {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.twin.name, self.twin.number)?;
        let drives = &base.manifest.trajectories;
        anyhow::ensure!(
            self.ground.is_none() || !drives.is_empty(),
            "--ground: twin {} has no recorded drive, from which the ground is known: give --box, or add a drive with \
             `wildcity twin drive`",
            self.twin.name
        );
        let mut places: Vec<(CutPlace, SemanticClass)> = Vec::new();
        let mut options = Vec::new();
        if let Some(class) = self.ground {
            options.push(format!("ground as {class}"));
        }
        if let Some(path) = &self.tracks {
            let context = || format!("{}", path.display());
            let bytes = ingest::read_whole(path, MAP_BYTES as u64).with_context(context)?;
            let file = TracksFile::parse(&bytes).with_context(context)?;
            let of_tracks = swept(&file).with_context(context)?;
            options.push(output::counted(file.tracks.len(), "track"));
            places.extend(
                of_tracks
                    .into_iter()
                    .map(|(place, class)| (place, SemanticClass::from_actor(class))),
            );
        }
        for (class, region) in &self.boxes {
            let DVec3 { x, y, z } = region.place().world_from_box.position_m;
            options.push(format!("box at {x:.3},{y:.3},{z:.3} as {class}"));
            places.push((region.place(), *class));
        }
        let drive_boxes = DriveBoxes::new(drives);
        // The drive is on the road: its height is that of the ground around it.
        let drives = Ground::from_drives(drives).with_boxes(&drive_boxes);
        let is_ground = |at_m: DVec3| {
            let placed = drives.find(Pose { position_m: at_m, ..Pose::IDENTITY });
            placed.is_some_and(|placed| (placed.position_m.z - at_m.z).abs() <= GROUND_M)
        };
        let ground =
            self.ground.map(|class| (class, &is_ground as &(dyn Fn(DVec3) -> bool + Sync)));
        let labels = Labels { ground, places: &places };
        let labelled = catalog.label(&base, labels, format!("label={}", options.join("; ")))?;
        writeln!(
            output::stdout(),
            "twin {} version {}: {} labelled\nblake3 {}",
            self.twin.name,
            labelled.version.number,
            output::counted(labelled.gaussians as usize, "Gaussian"),
            labelled.version.hash,
        )?;
        Ok(())
    }
}
