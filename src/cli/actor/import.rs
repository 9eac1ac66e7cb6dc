//! `wildcity actor import`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;
use glam::DVec3;

use wildcity_push::{SourceAxes, SourceScene, provenance, read_actor, read_tracked};
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::rig::is_name;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat};
use wildcity_twin::ingest::TrackedObject;
use wildcity_twin::store::{Catalog, StoredActor};

use crate::cli::directories::Twins;
use crate::cli::{limits, progress};

/// Make an asset of an actor from a file: Gaussians of any format that `wildcity import` reads, or a glTF mesh.
///
/// The box is that of the Gaussians' centres. They are moved so that the origin is on the ground under the middle of
/// the box.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Import {
    /// The file. For a scene in a folder: its meta.json, lod-meta.json or .gltf.
    #[arg(value_name = "FILE")]
    source: PathBuf,

    /// Name of the asset, made of a-z 0-9 . _ - [default: the file's name]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,

    /// What it is: vehicle, pedestrian, bicycle or object.
    #[arg(long, default_value = "vehicle", value_parser = parse_class)]
    class: ActorClass,

    /// Directions of the file's axes: a preset, or the 9 numbers of the matrix from the file's axes to the actor's
    /// (x forward, y left, z up), row by row. A glTF file that looks along +z, as the standard says, has
    /// '0 0 1 1 0 0 0 1 0'.
    #[arg(long, default_value = "identity", allow_hyphen_values = true)]
    axes: String,

    /// Metres per unit of the file, applied after --axes.
    #[arg(long, default_value_t = 1.0, allow_negative_numbers = true)]
    scale: f64,

    /// Number of flat Gaussians that cover the triangles of a mesh, 1,000 to 1,000,000. Small triangles add more.
    #[arg(
        long,
        value_name = "N",
        default_value_t = limits::ACTOR_MESH_GAUSSIANS,
        value_parser = clap::value_parser!(u32).range(1_000..=1_000_000)
    )]
    gaussians: u32,

    /// Import the tracked objects of a recorded drive, each as an asset named NAME-TRACK: those of NuRec, or
    /// drivestudio's RigidNodes (python -m wildcity.convert CKPT.pth OUT.safetensors --model RigidNodes).
    #[arg(long)]
    tracked: bool,

    /// Record format in which Gaussians are stored: f32 (exact), h52, q32 or q24.
    #[arg(long, value_name = "FORMAT", default_value_t)]
    record: RecordFormat,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity actor import car.glb --axes '0 0 1 1 0 0 0 1 0'
  wildcity actor import person.ply --class pedestrian --axes y-up-z-back --scale 0.01
  wildcity actor import truck.glb --name truck --gaussians 400000
  wildcity actor import drive.usdz --tracked --name log7";

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // 1. Options.
        let name = match &self.name {
            Some(name) => name.clone(),
            None => name_of(&self.source),
        };
        anyhow::ensure!(
            is_name(&name),
            "{name:?} cannot be the name of an actor: names have 1 to 64 of a-z 0-9 . _ - and do not start with .; \
             give --name"
        );
        let axes = SourceAxes::parse(&self.axes, self.scale)?;
        let catalog = self.twins.catalog()?;

        if self.tracked {
            return self.import_tracked(&name, &axes, &catalog);
        }

        // 2. The Gaussians, in the actor's axes.
        let cannot = || format!("cannot import {}", self.source.display());
        let bar = progress::bytes("reading");
        let read = read_actor(&self.source, &axes, self.gaussians, &mut progress::show(&bar));
        let SourceScene { mut gaussians, hash, .. } = read.with_context(cannot)?;
        bar.finish_and_clear();
        let box_ = center(&mut gaussians).with_context(cannot)?;

        // 3. The asset.
        let mut options = axes.options().to_vec();
        options.push(format!("gaussians={}", self.gaussians));
        let provenance = provenance(&[hash], options, true);
        let description = AssetDescription { name, class: self.class, box_, provenance };
        let asset = ActorAsset::new(&gaussians, description).with_context(cannot)?;
        print(&catalog.put_actor(&asset, self.record).with_context(cannot)?)?;
        Ok(())
    }

    /// Imports each tracked object. Its origin stays under the middle of the track's box, where the track's poses are.
    fn import_tracked(
        &self,
        name: &str,
        axes: &SourceAxes,
        catalog: &Catalog,
    ) -> anyhow::Result<()> {
        let cannot = || format!("cannot import {}", self.source.display());
        let bar = progress::bytes("reading");
        let read = read_tracked(&self.source, axes, &mut progress::show(&bar));
        let (objects, hash) = read.with_context(cannot)?;
        bar.finish_and_clear();
        for TrackedObject { track, mut gaussians } in objects {
            let name = name_from(&format!("{name}-{track}"));
            let of_track = || format!("track {track:?} of {}", self.source.display());
            let Bounds { min_m, max_m } = ActorAsset::bounds(&gaussians);
            let down_m = DVec3::new(0.0, 0.0, -min_m.z);
            gaussians.transform(&Pose { position_m: down_m, ..Pose::IDENTITY });
            let half_m = min_m.abs().max(max_m.abs());
            let box_ = ActorBox {
                length_m: 2.0 * half_m.x,
                width_m: 2.0 * half_m.y,
                height_m: max_m.z - min_m.z,
            };
            box_.check().with_context(of_track)?;
            let mut options = axes.options().to_vec();
            options.push(format!("track={track}"));
            let provenance = provenance(std::slice::from_ref(&hash), options, true);
            let description = AssetDescription { name, class: self.class, box_, provenance };
            let asset = ActorAsset::new(&gaussians, description).with_context(of_track)?;
            print(&catalog.put_actor(&asset, self.record).with_context(of_track)?)?;
        }
        Ok(())
    }
}

fn print(stored: &StoredActor) -> io::Result<()> {
    let ActorBox { length_m, width_m, height_m } = stored.description.box_;
    writeln!(
        io::stdout().lock(),
        "actor {}: {}, {length_m:.2} m long, {width_m:.2} m wide, {height_m:.2} m high; {} Gaussians of SH degree \
         {} in {} levels of detail, {:.1} MB\nblake3 {}",
        stored.description.name,
        stored.description.class.name(),
        stored.gaussians(),
        stored.sh_degree,
        stored.levels.len(),
        stored.bytes as f64 / 1e6,
        stored.hash,
    )
}

/// Moves Gaussians so that their origin is on the ground under the middle of their box. Returns the box.
fn center(gaussians: &mut Gaussians) -> anyhow::Result<ActorBox> {
    anyhow::ensure!(!gaussians.is_empty(), "it holds no Gaussians");
    let Bounds { min_m, max_m } = ActorAsset::bounds(gaussians);
    let middle_m = 0.5 * (min_m + max_m);
    let origin_m = DVec3::new(middle_m.x, middle_m.y, min_m.z);
    gaussians.transform(&Pose { position_m: -origin_m, ..Pose::IDENTITY });
    let DVec3 { x: length_m, y: width_m, z: height_m } = max_m - min_m;
    let box_ = ActorBox { length_m, width_m, height_m };
    box_.check().context("check --axes and --scale")?;
    Ok(box_)
}

/// The file's name without its extension, in small letters, with _ for other characters.
fn name_of(source: &std::path::Path) -> String {
    name_from(&source.file_stem().unwrap_or_default().to_string_lossy())
}

fn name_from(text: &str) -> String {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "._-".contains(c);
    text.to_lowercase().chars().map(|c| if allowed(c) { c } else { '_' }).collect()
}

pub(super) fn parse_class(text: &str) -> Result<ActorClass, String> {
    let found = ActorClass::ALL.into_iter().find(|class| class.name() == text);
    let names = ActorClass::ALL.map(ActorClass::name).join(", ");
    found.ok_or_else(|| format!("there is no class {text:?}; the classes are {names}"))
}
