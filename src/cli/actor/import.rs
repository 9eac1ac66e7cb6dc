//! `wildcity actor import`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;
use glam::DVec3;

use wildcity_push::{
    AssetSettings, AssetSource, SourceAxes, SourceScene, make_asset, provenance, read_actor,
    read_tracked,
};
use wildcity_scene::ActorBox;
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_twin::ingest::{Antialiasing, TrackedObject};
use wildcity_twin::store::{Catalog, StoredActor};

use super::asset_options::{AssetOptions, name_from};
use super::summary::Summary;
use crate::cli::directories::Twins;
use crate::cli::file_notes;
use crate::cli::output;
use crate::cli::packed_folder::scene_file;
use crate::cli::progress;

/// Make an asset of an actor from a file: Gaussians of any format that `wildcity import` reads, or
/// a glTF mesh.
///
/// The box is that of the Gaussians' centres. They are moved so that the origin is on the ground
/// under the middle of the box.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Import {
    /// The file; for a scene in a folder, the folder of a SOG, or the .gltf file.
    #[arg(value_name = "FILE")]
    source: PathBuf,

    #[command(flatten)]
    options: AssetOptions,

    /// Import the tracked objects of a recorded drive, each as an asset named NAME-TRACK: those of
    /// NuRec, or drivestudio's RigidNodes (python -m wildcity.convert CKPT.pth OUT.safetensors
    /// --model RigidNodes).
    #[arg(long)]
    tracked: bool,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity actor import car.glb --axes '0 0 1 1 0 0 0 1 0'
  wildcity actor import person.ply --class pedestrian --axes y-up-z-back --scale 0.01
  wildcity actor import truck.glb --name truck --axes '1 0 0 0 0 -1 0 1 0' --gaussians 400000
  wildcity actor import drive.usdz --tracked --name log7";

impl Import {
    pub(super) fn run(mut self) -> anyhow::Result<()> {
        let settings = self.options.settings(&self.source)?;
        self.source = scene_file(self.source)?;
        let axes = self.options.source_axes()?;
        let catalog = self.twins.catalog()?;

        if self.tracked {
            return self.import_tracked(&settings, &axes, &catalog);
        }

        let cannot = || format!("cannot import {}", self.source.display());
        let bar = progress::bytes("reading");
        let show = &mut progress::show(&bar);
        let read = read_actor(&self.source, &axes, settings.mesh_gaussians, show);
        let SourceScene { gaussians, hash, options, mut notes, .. } = read.with_context(cannot)?;
        bar.finish_and_clear();
        // The note would speak of a profile, which an actor does not have.
        if let Some(Antialiasing { blur_px2: Some(_), said_by }) = notes.antialiasing.take() {
            notes
                .warnings
                .push(format!("{said_by}: an actor is rendered with the profile of its twin"));
        }
        file_notes::print(&self.source, &notes)?;
        let source = AssetSource { gaussians, hashes: vec![hash], options: options.to_vec() };
        let asset = make_asset(source, &settings).with_context(cannot)?;
        print(&catalog.put_actor(&asset, settings.record).with_context(cannot)?)?;
        Ok(())
    }

    /// Imports each tracked object. Its origin stays under the middle of the track's box, where the
    /// track's poses are.
    fn import_tracked(
        &self,
        settings: &AssetSettings,
        axes: &SourceAxes,
        catalog: &Catalog,
    ) -> anyhow::Result<()> {
        let cannot = || format!("cannot import {}", self.source.display());
        let bar = progress::bytes("reading");
        let read = read_tracked(&self.source, axes, &mut progress::show(&bar));
        let (objects, hash) = read.with_context(cannot)?;
        bar.finish_and_clear();
        for TrackedObject { track, mut gaussians } in objects {
            let name = name_from(&format!("{}-{track}", settings.name));
            let of_track = || format!("track {track:?} of {}", self.source.display());
            let Bounds { min_m, max_m } = ActorAsset::bounds(&gaussians);
            // The origin of an actor is on the ground: its lowest point gets the height 0.
            let down_m = DVec3::new(0.0, 0.0, -min_m.z);
            gaussians.transform(&Pose { position_m: down_m, ..Pose::IDENTITY });
            // A box of an actor is centred on its origin, and has to reach both ends.
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
            let description = AssetDescription { name, class: settings.class, box_, provenance };
            let asset = ActorAsset::new(&gaussians, description).with_context(of_track)?;
            print(&catalog.put_actor(&asset, settings.record).with_context(of_track)?)?;
        }
        Ok(())
    }
}

fn print(stored: &StoredActor) -> io::Result<()> {
    let ActorBox { length_m, width_m, height_m } = stored.description.box_;
    let summary = Summary {
        name: &stored.description.name,
        class: stored.description.class.name(),
        size_m: [length_m, width_m, height_m],
        gaussians: stored.gaussians(),
        sh_degree: stored.sh_degree,
        levels: stored.levels.len(),
        bytes: stored.bytes,
        hash: &stored.hash,
    };
    writeln!(output::stdout(), "{summary}")
}
