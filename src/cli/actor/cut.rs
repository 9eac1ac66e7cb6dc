//! `wildcity actor cut`.

use std::io::{self, Write};
use std::str::FromStr;

use anyhow::Context;
use glam::{DQuat, DVec3};

use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorBox, ActorClass, RecordFormat};

use super::import::parse_class;
use crate::cli::directories::{TwinVersion, Twins};

/// Lift what lies in a box out of a twin: makes a new version without it, and an asset of exactly these Gaussians.
///
/// For parked cars that shall drive away. Everything from 5 cm above the bottom of the box on is cut; the ground stays.
/// Where the car hid the ground, the new version may have a hole, which shows in the opacity. Open sessions keep the
/// version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Cut {
    /// The twin: NAME, or NAME@NUMBER to start from an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// The box: the point on the ground under its middle and its heading, in world axes (metres, and degrees to the
    /// left from x), and its length, width and height in metres.
    #[arg(long = "box", value_name = "X,Y,Z,DEGREES,L,W,H", allow_hyphen_values = true)]
    region: Region,

    /// Name of the asset, made of a-z 0-9 . _ -.
    #[arg(long, value_name = "NAME")]
    name: String,

    /// What it is: vehicle, pedestrian, bicycle or object.
    #[arg(long, default_value = "vehicle", value_parser = parse_class)]
    class: ActorClass,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity actor cut street --box 31.2,-4.8,0,0,4.6,1.9,1.6 --name parked
  wildcity actor cut street@2 --box=-12,7.5,0.1,178,5.2,2.0,2.1 --name van";

/// A box on the ground.
#[derive(Clone, Copy, Debug)]
struct Region {
    world_from_box: Pose,
    box_: ActorBox,
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
        anyhow::ensure!(
            is_name(&self.name),
            "{:?} cannot be the name of an actor: names have 1 to 64 of a-z 0-9 . _ - and do not start with .",
            self.name
        );
        let Region { world_from_box, box_ } = self.region;
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.twin.name, self.twin.number)?;
        let cut = catalog.cut(&base, &world_from_box, &box_)?;

        // Exact, since the twin's own record has rounded its values already.
        let source = format!("cut from twin {} version {}", self.twin.name, base.hash);
        let provenance = Provenance::of(source);
        let description = AssetDescription { name: self.name, class: self.class, box_, provenance };
        let asset = ActorAsset::new(&cut.gaussians, description).context("cannot make an asset")?;
        let stored = catalog.put_actor(&asset, RecordFormat::F32)?;
        writeln!(
            io::stdout().lock(),
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
