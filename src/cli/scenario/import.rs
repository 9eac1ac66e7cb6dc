//! `wildcity scenario import`.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::cli::output;
use wildcity_convert::openscenario;
use wildcity_sim::scenario::ScenarioFile;
use wildcity_twin::ingest;

/// Read a scenario of OpenSCENARIO XML 1.0 to 1.3.
///
/// The import supports catalogs, parameters with formulas, positions in the world and on roads,
/// changes of speed, lane and offset, trajectories, routes, distances that actors keep,
/// synchronized arrivals, events with conditions, edges, delays and priorities, and stop triggers.
/// A route of the ego becomes the agent's route. The import refuses any other part, with its name
/// and line, because the scenario would be different without it. --leave-out leaves out parts, and
/// lists each of them.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario import cut-in.xosc --twin street --out cut-in.json
  wildcity scenario import cut-in.xosc --twin street --ego Hero --out cut-in.json
  wildcity scenario import cut-in.xosc --twin street --leave-out controllers,stop --out cut-in.json
  wildcity scenario import cut-in.xosc --twin street --parameter Speed=12 --out cut-in-12.json")]
pub(in crate::cli) struct Import {
    /// The OpenSCENARIO file.
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Name of the twin in which the scenario takes place. The positions in the file are in the
    /// axes of this twin, unless --origin is given.
    #[arg(long, value_name = "NAME")]
    twin: String,

    /// Name of the entity that the agent drives.
    #[arg(long, value_name = "NAME", default_value = "Ego")]
    ego: String,

    /// The OpenDRIVE file of the roads, in place of the one that the scenario names.
    #[arg(long, value_name = "FILE")]
    roads: Option<PathBuf>,

    /// A further directory of catalogs; may be given again.
    #[arg(long, value_name = "DIR")]
    catalogs: Vec<PathBuf>,

    /// Easting and northing of the twin's origin; give the same values as to
    /// `wildcity twin map import --origin` for these roads.
    #[arg(long, value_name = "EAST,NORTH", value_parser = crate::cli::twin::map_origin, allow_hyphen_values = true)]
    origin: Option<[f64; 2]>,

    /// Give a parameter that the file declares another value; may be given again.
    #[arg(long = "parameter", value_name = "NAME=VALUE", value_parser = parameter)]
    parameters: Vec<(String, String)>,

    /// Parts to leave out: controllers, ego (actions of the entity that the agent drives, except
    /// its start and its route), environment, appearance, signals, stop (conditions of a stop
    /// trigger that the import does not read), distances, routes, trailers, custom. Each part that
    /// is left out is listed.
    #[arg(long, value_name = "PART,...", value_delimiter = ',', value_parser = part)]
    leave_out: Vec<openscenario::Part>,

    /// Scenario file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let context = || format!("{}", self.file.display());
        let bytes = ingest::read_whole(&self.file, openscenario_bytes()).with_context(context)?;
        let settings = openscenario::Settings {
            name: super::scenario_name(&self.out)?,
            twin: self.twin.clone(),
            ego: self.ego.clone(),
            directory: Some(self.file.parent().unwrap_or(Path::new("")).to_owned()),
            catalogs: self.catalogs.clone(),
            roads: self.roads.clone(),
            origin: self.origin,
            parameters: self.parameters.iter().cloned().collect(),
            leave_out: self.leave_out.iter().copied().collect(),
        };
        let imported = openscenario::read(&bytes, &settings).with_context(context)?;
        let scenario = imported.file;
        let mut text = serde_json::to_vec_pretty(&scenario)?;
        if text.len() > wildcity_sim::limits::SCENARIO_BYTES {
            text = serde_json::to_vec(&scenario)?;
        }
        text.push(b'\n');
        output::write(&self.out, &text)?;
        let mut out = output::stdout();
        for note in &imported.notes {
            writeln!(out, "note: {note}")?;
        }
        for note in missing(&scenario) {
            writeln!(out, "note: {note}")?;
        }
        writeln!(
            out,
            "{}: {}; next: wildcity scenario check {}",
            self.out.display(),
            output::counted(scenario.actors.len(), "actor"),
            self.out.display()
        )?;
        Ok(())
    }
}

/// What an OpenSCENARIO file need not say, and an episode needs.
fn missing(scenario: &ScenarioFile) -> impl Iterator<Item = &'static str> {
    let end = &scenario.end;
    let missing = [
        (scenario.ego.start.is_none(), "the ego has no place at the start: add ego.start"),
        (
            scenario.route.is_none(),
            "there is no route for agents that follow one (idm, log): add \"route\", such as {\"lanes\": [\"0/0/-1\"]}",
        ),
        (
            scenario.map.is_none(),
            "there is no map to judge the road by: add \"map\", a file that wildcity twin map import writes",
        ),
        (end.time_s.is_none() && end.when.is_none(), "nothing ends it: add end.time_s"),
    ];
    missing.into_iter().filter_map(|(is_missing, note)| is_missing.then_some(note))
}

fn openscenario_bytes() -> u64 {
    wildcity_convert::TEXT_BYTES as u64
}

/// Parses a parameter of the scenario, as `NAME=VALUE`.
fn parameter(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE, for example Speed=12")?;
    Ok((name.to_owned(), value.to_owned()))
}

fn part(text: &str) -> Result<openscenario::Part, String> {
    let parts = openscenario::Part::ALL;
    let found = parts.iter().find(|(_, name)| *name == text);
    let known = || parts.map(|(_, name)| name).join(", ");
    found.map(|(part, _)| *part).ok_or_else(|| format!("expected one of {}", known()))
}
