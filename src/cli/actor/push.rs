//! `wildcity actor push`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context as _;

use wildcity_client::{ActorAsset, ActorBox, ActorClass, HttpClient, NewActor};
use wildcity_push::AssetSettings;
use wildcity_scene::ActorClass as Class;

use super::asset_options::AssetOptions;
use super::summary::Summary;
use crate::cli::output;
use crate::cli::progress;
use crate::cli::push::{Server, upload_all};

/// Make an asset on a running server from files of this machine. `wildcity actor import` does this
/// on the server's machine.
///
/// The same files with the same options give the same hash. Sessions that open afterwards can use
/// the asset, by name and by hash. The name is refused if an asset with other content has it. To
/// continue an upload after a lost connection, run the same command again.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Push {
    /// Files of Gaussians, or glTF meshes, and the files that they name. Files in folders below
    /// that of the first file keep these folders in their names.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    #[command(flatten)]
    options: AssetOptions,

    #[command(flatten)]
    server: Server,
}

const EXAMPLES: &str = "\
Examples:
  wildcity actor push car.glb --axes '0 0 1 1 0 0 0 1 0'
  wildcity actor push person.ply --class pedestrian --axes y-down-z-forward --name walker --server http://sim:8080 --token-file token
  wildcity actor push truck.gltf truck.bin textures/paint.png --axes '1 0 0 0 0 -1 0 1 0' --gaussians 400000";

impl Push {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // Refuses bad options before anything is sent.
        let first = self.files.first().context("give a file")?;
        let settings = self.options.settings(first)?;
        self.options.source_axes()?;
        let client = self.server.client()?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        print(&runtime.block_on(self.push(&client, settings))?)?;
        Ok(())
    }

    async fn push(
        &self,
        client: &HttpClient,
        settings: AssetSettings,
    ) -> anyhow::Result<ActorAsset> {
        let AssetOptions { axes, scale, .. } = &self.options;
        let files = upload_all(client, &self.files, Some(axes), Some(*scale)).await?;
        let AssetSettings { name, class, mesh_gaussians, record } = settings;
        let asked = NewActor {
            class: match class {
                Class::Vehicle => ActorClass::Vehicle,
                Class::Pedestrian => ActorClass::Pedestrian,
                Class::Bicycle => ActorClass::Bicycle,
                Class::Object => ActorClass::Object,
            },
            files,
            gaussians: Some(mesh_gaussians),
            record: Some(record.to_string()),
            name,
        };
        let spinner = progress::waiting("the server makes the asset");
        let made = client.push_actor(&asked).await;
        spinner.finish_and_clear();
        made.with_context(|| format!("cannot push the actor {:?}", asked.name))
    }
}

fn print(actor: &ActorAsset) -> io::Result<()> {
    let ActorBox { length_m, width_m, height_m } = actor.box_;
    let summary = Summary {
        name: &actor.name,
        class: actor.class.name(),
        size_m: [length_m, width_m, height_m],
        gaussians: actor.gaussians,
        sh_degree: actor.sh_degree,
        levels: actor.levels.len(),
        bytes: actor.bytes,
        hash: &actor.hash,
    };
    writeln!(output::stdout(), "{summary}")
}
