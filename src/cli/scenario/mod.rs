//! `wildcity scenario`.

#[cfg(feature = "suite")]
mod check;
#[cfg(feature = "log")]
mod from_log;
#[cfg(feature = "convert")]
mod import;
mod show;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use serde_json::Value;

use wildcity_scene::rig::is_name;
use wildcity_session::{ScenarioSource, Scenarios};
use wildcity_sim::scenario::{Document, Values};
use wildcity_twin::store::{Catalog, Version};

/// Check scenarios, show one as an episode runs it, and import those of other formats.
///
/// A scenario is a JSON file: a twin, an ego, actors, a route, and when an episode ends. The tracks
/// and maps that it names are in the same directory. docs/scenarios.md explains every field.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario check cut-in.json
  wildcity scenario show cut-in.json --seed 7
  wildcity scenario import cut-in.xosc --twin street --out cut-in.json
  wildcity scenario from-log log --twin street --at 12.5 --out merge.json")]
pub(super) struct ScenarioCommand {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    #[cfg(feature = "suite")]
    Check(check::Check),
    Show(show::Show),
    #[cfg(feature = "convert")]
    Import(import::Import),
    #[cfg(feature = "log")]
    FromLog(from_log::FromLog),
}

impl ScenarioCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}

/// A scenario file with its directory and the version of its twin.
struct Opened {
    scenarios: Scenarios,
    document: Document,
    version: Version,
}

/// Opens a scenario file, and the latest version of its twin or the one that it names.
fn opened(path: &Path, catalog: &Catalog) -> anyhow::Result<Opened> {
    let context = || format!("{}", path.display());
    let dir = path.parent().map_or_else(|| PathBuf::from("."), Path::to_owned);
    let scenarios = Scenarios::in_dir(dir);
    let has_extension = path.extension().is_some_and(|extension| extension == "json");
    anyhow::ensure!(has_extension, "{}: a scenario is a .json file", path.display());
    let name = scenario_name(path)?;
    let document = scenarios.document(&ScenarioSource::Named(name)).with_context(context)?;
    let file = document.with(&document.first_values()).with_context(context)?;
    let found = match &file.twin.version_hash {
        None => catalog.version(&file.twin.name, None),
        Some(hash) => find_version(catalog, &file.twin.name, hash),
    };
    let version = found.with_context(context)?;
    Ok(Opened { scenarios, document, version })
}

/// The name of a scenario, which is that of its file.
fn scenario_name(path: &Path) -> anyhow::Result<String> {
    let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
    anyhow::ensure!(
        is_name(stem),
        "{}: a scenario has the name of its file, and {stem:?} is no name: use 1 to 64 of a-z 0-9 . _ - that do not \
         start with a dot",
        path.display()
    );
    Ok(stem.to_owned())
}

/// The version with a hash. If there is none, the latest version, which the check of the hash then
/// refuses.
fn find_version(
    catalog: &Catalog,
    twin: &str,
    hash: &str,
) -> Result<Version, wildcity_twin::store::StoreError> {
    let latest = catalog.version(twin, None)?;
    let mut number = latest.number;
    while latest.hash != *hash && number > 1 {
        number -= 1;
        match catalog.version(twin, Some(number)) {
            Ok(version) if version.hash == *hash => return Ok(version),
            Ok(_) => {}
            // Older versions may be gone.
            Err(_) => break,
        }
    }
    Ok(latest)
}

/// Values of a sweep: NAME=VALUE.
fn given_values(given: &[(String, Value)]) -> Values {
    given.iter().map(|(name, value)| (name.clone(), Arc::new(value.clone()))).collect()
}

/// NAME=VALUE, where the value is JSON, or else a text.
fn value(text: &str) -> Result<(String, Value), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE, for example v=8")?;
    let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
    Ok((name.to_owned(), value))
}
