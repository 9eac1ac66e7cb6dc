//! `wildcity scenario check`.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use super::opened;
use crate::cli::directories::Twins;
use crate::cli::exit::Exit;
use wildcity_scene::ActorBox;
use wildcity_session::StoredAssets;
use wildcity_sim::scenario::{Assets as _, Scenario};
use wildcity_sim::traffic::{Action, Actor, ActorSpec, Trigger};
use wildcity_twin::store::Catalog;

/// Check scenarios against their twins, with every combination of their sweeps.
///
/// Prints one line for each scenario, and warns of actors that no image shows, or that look larger
/// or smaller than they are. The first mistake ends the command with exit code 2, as it ends
/// `wildcity episode run`; it names the place in the file and what is accepted there.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario check cut-in.json
  wildcity scenario check scenarios/*.json --latest")]
pub(in crate::cli) struct Check {
    /// Scenario files; tracks and maps are read from their directories.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Accept twins, tracks and maps whose hashes differ from those that the scenario names, and
    /// say so.
    #[arg(long)]
    latest: bool,

    #[command(flatten)]
    twins: Twins,
}

/// The exit code of a mistake in a scenario.
const BAD_INPUT: u8 = 2;

/// A box that is longer, wider or higher than another by this factor looks wrong in its place.
const OTHER_SIZE: f64 = 1.3;

/// What images show otherwise than a reader of the scenario may expect, one text for each actor.
fn looks(scenario: &Scenario, assets: &StoredAssets<'_>) -> Vec<String> {
    let told = |actor: &Actor| {
        let ActorSpec { name, box_, asset, .. } = &actor.spec;
        let spawns = |trigger: &Trigger| trigger.then.contains(&Action::Spawn);
        if !actor.present && !actor.script.iter().any(spawns) {
            return Some(format!("actor {name:?} never appears: no trigger has spawn"));
        }
        let Some(asset) = asset else {
            return Some(format!("actor {name:?} is invisible, and can be hit"));
        };
        let own = assets.find(asset).ok()?.box_;
        let is_other = own.ratios(box_).iter().any(|ratio| ratio.max(1.0 / ratio) > OTHER_SIZE);
        let size = |box_: &ActorBox| {
            format!("{:.1} x {:.1} x {:.1} m", box_.length_m, box_.width_m, box_.height_m)
        };
        is_other.then(|| {
            let (drawn, real) = (size(&own), size(box_));
            format!("actor {name:?} looks as if it had {drawn}, and has {real}: set its asset")
        })
    };
    scenario.traffic.actors.iter().filter_map(told).collect()
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        self.check(&catalog).map_err(|error| Exit::error(BAD_INPUT, format!("{error:#}")).into())
    }

    fn check(&self, catalog: &Catalog) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        for path in &self.files {
            let context = || format!("{}", path.display());
            let opened = opened(path, catalog)?;
            let cases = opened.document.cases();
            let mut actors = 0;
            let mut unpinned = Vec::new();
            let mut unseen = BTreeSet::new();
            let assets = StoredAssets::new(catalog);
            for case in &cases {
                let file = opened.document.with(&case.values).with_context(context)?;
                let version = (&opened.version.manifest, opened.version.hash.as_str());
                let loaded = opened
                    .scenarios
                    .resolve(file, case.seed, version, self.latest, &assets)
                    .with_context(|| format!("{}, seed {}", path.display(), case.seed))?;
                actors = actors.max(loaded.scenario.traffic.actors.len());
                unpinned = loaded.unpinned;
                unseen.extend(looks(&loaded.scenario, &assets));
            }
            writeln!(
                out,
                "{}: {} episodes in {}@{}, {actors} actors",
                path.display(),
                cases.len(),
                opened.version.manifest.twin,
                opened.version.number,
            )?;
            for line in unpinned {
                writeln!(out, "  not pinned: {line}")?;
            }
            for line in unseen {
                writeln!(out, "  warning: {line}")?;
            }
        }
        Ok(())
    }
}
