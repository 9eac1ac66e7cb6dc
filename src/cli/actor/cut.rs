//! `wildcity actor cut`.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use glam::{DQuat, DVec3};

use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorBox, ActorClass, RecordFormat};
use wildcity_sim::limits::MAP_BYTES;
use wildcity_sim::scenario::TracksFile;
use wildcity_twin::ingest;
use wildcity_twin::store::{Catalog, CutPlace, Version};

use super::asset_options::parse_class;
use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output;

/// Cut the Gaussians in a box out of a twin: makes a new version without them, and an asset of
/// exactly these Gaussians.
///
/// So a parked car can become an actor that drives away. Everything from 5 cm above the bottom of
/// the box on is cut; the ground stays. Where the car hid the ground, the new version may have a
/// hole, which shows in the opacity. Open sessions keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Cut {
    /// The twin: NAME, or NAME@NUMBER to start from an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// The box: the point on the ground under its middle and its heading, in world axes (metres,
    /// and degrees to the left from x), and its length, width and height in metres.
    #[arg(long = "box", value_name = "X,Y,Z,DEGREES,L,W,H", allow_hyphen_values = true)]
    #[arg(required_unless_present = "tracks", conflicts_with = "tracks", requires = "name")]
    region: Option<Region>,

    /// Cut the volume that the recorded actors of a wildcity.tracks/1 file swept, instead of a box.
    /// Vehicles drove through this volume, so it contains no static object. Makes no asset, because
    /// a moving car is reconstructed as a smear.
    #[arg(long, value_name = "FILE")]
    tracks: Option<PathBuf>,

    /// Name of the asset, made of a-z 0-9 . _ -; with --box.
    #[arg(long, value_name = "NAME", conflicts_with = "tracks")]
    name: Option<String>,

    /// Class of the actor: vehicle, pedestrian, bicycle or object.
    #[arg(long, default_value = "vehicle", value_parser = parse_class)]
    class: ActorClass,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity actor cut street --box 31.2,-4.8,0,0,4.6,1.9,1.6 --name parked
  wildcity actor cut street@2 --box=-12,7.5,0.1,178,5.2,2.0,2.1 --name van
  wildcity actor cut street --tracks recorded.tracks.json";

/// Largest motion of a swept box between two places at which it is cut, in metres.
const SWEEP_STEP_M: f64 = 0.25;
/// Largest number of places of all tracks together: 25 km of driving.
const SWEEP_PLACES: usize = 100_000;

/// A box on the ground.
#[derive(Clone, Copy, Debug)]
pub(in crate::cli) struct Region {
    world_from_box: Pose,
    box_: ActorBox,
}

impl Region {
    /// As a place to cut out, or to give a class.
    pub(in crate::cli) fn place(&self) -> CutPlace {
        CutPlace { world_from_box: self.world_from_box, box_: self.box_ }
    }
}

impl FromStr for Region {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
        let numbers = numbers.map_err(|error| format!("{error}; expected seven numbers"))?;
        let [x, y, z, degrees, length_m, width_m, height_m] = numbers[..] else {
            return Err(format!("{} numbers; expected seven", numbers.len()));
        };
        let finite = numbers.iter().all(|number| number.is_finite());
        if !finite {
            return Err("a number is not finite".to_owned());
        }
        let box_ = ActorBox { length_m, width_m, height_m };
        box_.check().map_err(|error| error.to_string())?;
        let rotation = DQuat::from_rotation_z(degrees.to_radians());
        Ok(Self { world_from_box: Pose { position_m: DVec3::new(x, y, z), rotation }, box_ })
    }
}

impl Cut {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.twin.name, self.twin.number)?;
        match (&self.region, &self.tracks) {
            (Some(region), _) => self.cut_box(&catalog, &base, region),
            (None, Some(path)) => self.cut_tracks(&catalog, &base, path),
            (None, None) => anyhow::bail!("give --box or --tracks"),
        }
    }

    fn cut_tracks(&self, catalog: &Catalog, base: &Version, path: &Path) -> anyhow::Result<()> {
        let context = || format!("{}", path.display());
        let bytes = ingest::read_whole(path, MAP_BYTES as u64).with_context(context)?;
        let file = TracksFile::parse(&bytes).with_context(context)?;
        let places = swept(&file).with_context(context)?;
        let places: Vec<CutPlace> = places.into_iter().map(|(place, _)| place).collect();
        let tracks = output::counted(file.tracks.len(), "track");
        let option = format!("cut={tracks} at {}", output::counted(places.len(), "place"));
        let cut = catalog.cut_all(base, &places, option)?;
        writeln!(
            output::stdout(),
            "twin {} version {}: without {} Gaussians that {tracks} swept\nblake3 {}",
            self.twin.name,
            cut.version.number,
            cut.gaussians.len(),
            cut.version.hash,
        )?;
        Ok(())
    }

    fn cut_box(&self, catalog: &Catalog, base: &Version, region: &Region) -> anyhow::Result<()> {
        let name = self.name.clone().unwrap_or_default();
        anyhow::ensure!(
            is_name(&name),
            "{name:?} cannot be the name of an actor: names have 1 to 64 of a-z 0-9 . _ - and do not start with .",
        );
        let Region { world_from_box, box_ } = *region;
        let cut = catalog.cut(base, &world_from_box, &box_)?;

        // Exact, since the twin's own record has rounded its values already.
        let source = format!("cut from twin {} version {}", self.twin.name, base.hash);
        let provenance = Provenance::new(source);
        let description = AssetDescription { name, class: self.class, box_, provenance };
        let asset = ActorAsset::new(&cut.gaussians, description).context("cannot make an asset")?;
        let stored = catalog.put_actor(&asset, RecordFormat::F32)?;
        writeln!(
            output::stdout(),
            "twin {} version {}: without {} Gaussians\nblake3 {}\nactor {}: {} Gaussians, {:.1} MB\nblake3 {}",
            self.twin.name,
            cut.version.number,
            cut.gaussians.len(),
            cut.version.hash,
            stored.description.name,
            stored.gaussians(),
            stored.bytes as f64 / 1e6,
            stored.hash,
        )?;
        Ok(())
    }
}

/// The places of all boxes on their tracks with their classes, close enough that nothing is left
/// between two of them.
pub(in crate::cli) fn swept(file: &TracksFile) -> anyhow::Result<Vec<(CutPlace, ActorClass)>> {
    let mut places = Vec::new();
    for section in &file.tracks {
        let [length_m, width_m, height_m] = section.size;
        let box_ = ActorBox { length_m, width_m, height_m };
        let track = section.shifted(0)?;
        let place = |world_from_box: Pose| (CutPlace { world_from_box, box_ }, section.class);
        for pair in track.keyframes().windows(2) {
            let from = pair[0].world_from_actor;
            let to = pair[1].world_from_actor;
            // The corners also move as the box turns.
            let turned_m = 0.5 * length_m.hypot(width_m) * from.rotation.angle_between(to.rotation);
            let moved_m = from.position_m.distance(to.position_m) + turned_m;
            // A track that stands still has one place for each pair, so that its box is cut, too.
            let count = (moved_m / SWEEP_STEP_M).ceil().max(1.0) as usize;
            anyhow::ensure!(
                places.len() + count <= SWEEP_PLACES,
                "the tracks sweep more than {SWEEP_PLACES} places {SWEEP_STEP_M} m apart: give fewer tracks"
            );
            places
                .extend((0..count).map(|k| place(from.interpolate(&to, k as f64 / count as f64))));
        }
        // Each pair leaves its end out, which is the beginning of the next one.
        places.extend(track.keyframes().last().map(|last| place(last.world_from_actor)));
    }
    Ok(places)
}
