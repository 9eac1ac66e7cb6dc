//! `wildcity episode show`.

use std::io::{self, Write};
use std::path::PathBuf;

use wildcity_episode::{EpisodeFile, Event};

use crate::cli::directories::Episodes;
use crate::cli::output;

/// Show an episode: its steps, its events, and its end.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Show {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode show agent-1
  wildcity episode show run/episodes/agent-1.jsonl";

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let episode = super::read(&self.episode, &self.episodes)?;
        let mut out = output::stdout();
        head(&mut out, &episode)?;
        for line in &episode.events {
            let seconds = line.time_us as f64 * 1e-6;
            writeln!(out, "{:<11} {seconds:.3} s {}", "event", text(&line.event, &episode))?;
        }
        for (actor, trigger) in episode.unfired_triggers() {
            writeln!(out, "not fired   {actor}: trigger {}", episode.trigger_text(actor, trigger))?;
        }
        match &episode.end {
            Some(end) => writeln!(
                out,
                "end         {} after {}, {:.1} s, {:.1} m",
                end.outcome,
                output::counted(end.steps as usize, "step"),
                end.time_us as f64 * 1e-6,
                end.distance_m
            )?,
            None => {
                writeln!(
                    out,
                    "end         not recorded: the episode still runs, or was interrupted"
                )?;
            }
        }
        if let Some(cut) = &episode.cut {
            writeln!(out, "damaged     line {}: {}", cut.line, cut.reason)?;
        }
        if let Some(result) = &episode.result {
            writeln!(out, "verdict     {}", result.verdict)?;
            for fault in &result.faults {
                writeln!(out, "fault       {}", fault.text(&result.scores))?;
            }
            for reason in &result.not_judged {
                writeln!(out, "not judged  {reason}")?;
            }
        }
        Ok(())
    }
}

fn head(out: &mut impl Write, episode: &EpisodeFile) -> io::Result<()> {
    let header = &episode.header;
    let cameras: Vec<&str> = header.rig.cameras.iter().map(|camera| &*camera.name).collect();
    let driven = episode.driven();
    writeln!(out, "session     {}, seed {}", header.session, header.seed)?;
    writeln!(out, "twin        {} version {}", header.twin, header.version)?;
    writeln!(out, "recorded by {}, backend {}", header.build, header.backend)?;
    writeln!(out, "rig         {}: {}", header.rig.name, cameras.join(", "))?;
    let model = header.dynamics.model.name();
    writeln!(out, "ego         {model}, steps of {:.3} s", header.dt_us as f64 * 1e-6)?;
    writeln!(out, "steps       {}", driven.last().map_or(0, |frame| frame.step))?;
    if let Some(scenario) = &episode.scenario {
        writeln!(out, "scenario    {} {}", scenario.name, scenario.hash)?;
        for actor in &scenario.actors {
            let [length_m, width_m, height_m] = actor.size;
            let class = actor.class.name();
            writeln!(
                out,
                "actor       {}: {class}, {length_m} x {width_m} x {height_m} m",
                actor.name
            )?;
        }
    }
    Ok(())
}

fn text(event: &Event, episode: &EpisodeFile) -> String {
    // An index of a damaged record may be of no actor: then the number is shown.
    let name = |index: u16| {
        let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
        actors.get(usize::from(index)).map_or(index.to_string(), |actor| actor.name.clone())
    };
    match event {
        Event::Contact(contact) => {
            let fault = match (contact.at_start, contact.ego_at_fault) {
                (true, _) => "overlaps at the start",
                (false, true) => "the ego is at fault",
                (false, false) => "the ego is not at fault",
            };
            format!(
                "contact with {} at {:.2} m/s: {fault}",
                name(contact.actor),
                contact.impact_mps
            )
        }
        Event::StaticContact { area_m2, impact_mps } => {
            format!("contact with the twin at {impact_mps:.2} m/s, {area_m2:.3} m²")
        }
        Event::OffModel { trust } => format!("left the trained area: trust {trust:.3}"),
        Event::Triggered { actor, trigger } => {
            let actor = name(*actor);
            format!("{actor} fires trigger {}", episode.trigger_text(&actor, *trigger))
        }
        Event::Appeared { actor } => format!("{} appears", name(*actor)),
        Event::Left { actor } => format!("{} leaves", name(*actor)),
        Event::Ended { rule } => format!("ended by the rule {rule}"),
    }
}
