//! `wildcity scenario check`.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;

use super::opened;
use crate::cli::directories::Twins;
use crate::cli::exit::{Exit, chain};
use crate::cli::output;
use wildcity_episode::DriveStart;
use wildcity_scene::{ActorBox, Trajectory};
use wildcity_session::StoredAssets;
use wildcity_sim::scenario::{Assets as _, Scenario};
use wildcity_sim::traffic::{Action, Actor, ActorSpec, Behaviour, Condition, Trigger};
use wildcity_suite::BuiltIn;
use wildcity_twin::store::Catalog;

/// Check scenarios against their twins, with every combination of their sweeps.
///
/// Prints one line for each scenario. Warns of actors that no image shows, of actors that look
/// larger or smaller than their boxes, and of triggers that can never fire. Notes say what a
/// scenario lacks for a built-in agent (log, idm). The first mistake ends the command with exit
/// code 2, as it ends `wildcity episode run`. The error names the place in the file and the
/// accepted values.
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
    /// report the difference.
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
            let drawn = size(&own);
            let real = size(box_);
            format!("actor {name:?} looks as if it had {drawn}, and has {real}: set its asset")
        })
    };
    scenario.traffic.actors.iter().filter_map(told).collect()
}

/// Triggers that can never fire, one text for each.
fn never_fire(scenario: &Scenario) -> Vec<String> {
    let mut texts = Vec::new();
    for (index, actor) in scenario.traffic.actors.iter().enumerate() {
        // The longest line that the actor may be on; none for an actor on no line.
        let line_m = match &actor.behaviour {
            Behaviour::Follow(follow) => {
                follow.courses.iter().map(|course| course.length_m()).fold(0.0, f64::max)
            }
            Behaviour::Track(_) | Behaviour::Attack { .. } => f64::NEG_INFINITY,
        };
        let names = scenario.trigger_names.get(index);
        for (at, trigger) in actor.script.iter().enumerate() {
            let Some(why) = never_holds(&trigger.when, line_m, scenario.end.time_us) else {
                continue;
            };
            let name = names
                .and_then(|names| names.get(at))
                .filter(|name| !name.is_empty())
                .map_or(at.to_string(), |name| format!("{name:?}"));
            let actor = &actor.spec.name;
            texts.push(format!("trigger {name} of actor {actor:?} never fires: {why}"));
        }
    }
    texts
}

/// Why a condition never holds; `None` if it may.
fn never_holds(when: &Condition, line_m: f64, end_us: Option<i64>) -> Option<String> {
    let stations = [("ego_station_m", when.ego_station_m), ("station_m", when.station_m)];
    let beyond = stations.into_iter().find_map(|(field, station_m)| {
        let station_m = station_m.filter(|station_m| *station_m > line_m)?;
        let line = if line_m < 0.0 {
            "the actor is on no line".to_owned()
        } else {
            format!("the actor's line has {line_m:.1} m")
        };
        let text = format!("{field} is {station_m} m, and {line}");
        Some(format!("{text}; write within_m or time_s for an actor that crosses"))
    });
    let times_us = when.time_us.zip(end_us).filter(|(time_us, end_us)| time_us > end_us);
    let late = times_us.map(|(time_us, end_us)| {
        let [time_s, end_s] = [time_us, end_us].map(|us| us as f64 * 1e-6);
        format!("time_s is {time_s}, and the scenario ends at {end_s} s")
    });
    let part = |part: &Condition| never_holds(part, line_m, end_us);
    let all = || when.all.iter().find_map(part);
    let any = || {
        let whys: Option<Vec<String>> = when.any.iter().map(part).collect();
        whys.and_then(|whys| whys.into_iter().next())
    };
    beyond.or(late).or_else(all).or_else(any)
}

/// What a scenario lacks for the built-in agents that follow a route, one text for each.
fn lacks(scenario: &Scenario, drives: &[Trajectory]) -> Vec<String> {
    let start = DriveStart::new(scenario, drives);
    let drive = start.as_ref().map(|start| start.drive);
    let agents = [BuiltIn::Idm, BuiltIn::Log].into_iter();
    agents.filter_map(|agent| Some(agent.check(scenario, drive).err()?.to_string())).collect()
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        self.check(&catalog).map_err(|error| Exit::error(BAD_INPUT, chain(&error)).into())
    }

    fn check(&self, catalog: &Catalog) -> anyhow::Result<()> {
        let mut out = output::stdout();
        for path in &self.files {
            let context = || format!("{}", path.display());
            let opened = opened(path, catalog)?;
            let cases = opened.document.cases();
            let mut actors = 0;
            let mut unpinned = Vec::new();
            let mut unseen = BTreeSet::new();
            let mut lacking = BTreeSet::new();
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
                unseen.extend(never_fire(&loaded.scenario));
                lacking.extend(lacks(&loaded.scenario, &version.0.trajectories));
            }
            writeln!(
                out,
                "{}: {} in {}@{}, {}",
                path.display(),
                output::counted(cases.len(), "episode"),
                opened.version.manifest.twin,
                opened.version.number,
                output::counted(actors, "actor"),
            )?;
            for line in unpinned {
                writeln!(out, "  not pinned: {line}")?;
            }
            for line in unseen {
                writeln!(out, "  warning: {line}")?;
            }
            for line in lacking {
                writeln!(out, "  note: {line}")?;
            }
        }
        Ok(())
    }
}
