//! `wildcity actor show`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context as _;

use wildcity_scene::ActorBox;

use super::picture;
use crate::cli::directories::Twins;
use crate::cli::output;

/// Show an asset: its box, its levels of detail, its source, and a picture of it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity actor show car
  wildcity actor show 9f0c21ab --picture car.png")]
pub(super) struct Show {
    /// The asset: its name if no other has it, or the first digits of its hash.
    #[arg(value_name = "ACTOR")]
    actor: String,

    /// Write a PNG of the actor from ahead on its left, from its right, from behind and from above,
    /// on grey.
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,

    /// Draw the picture as a vehicle's camera sees the actor's right side from this distance, in
    /// metres: 1440 x 928 px, focal length 1800 px.
    #[arg(long, value_name = "M", requires = "picture", value_parser = parse_distance)]
    distance: Option<f64>,

    /// Print the description as JSON.
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    twins: Twins,
}

fn parse_distance(text: &str) -> Result<f64, String> {
    let distance_m: f64 = text.parse().map_err(|e| format!("{e}"))?;
    let accepted = (0.1..=1000.0).contains(&distance_m);
    if accepted { Ok(distance_m) } else { Err("a distance is from 0.1 to 1000 m".to_owned()) }
}

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let found = catalog.find_actor(&self.actor);
        let actor = found.with_context(|| format!("{}", catalog.dir().display()))?;
        if let Some(path) = &self.picture {
            let asset = catalog.actor(&actor.hash)?;
            let png = match self.distance {
                None => picture::draw_all_around(&asset)?,
                Some(distance_m) => picture::draw_side(&asset, distance_m)?,
            };
            output::write(path, &png)?;
        }
        let mut out = output::stdout();
        if self.json {
            let json = serde_json::json!({
                "hash": actor.hash,
                "bytes": actor.bytes,
                "description": actor.description,
                "sh_degree": actor.sh_degree,
                "record": actor.record,
                "levels": actor.levels,
            });
            writeln!(out, "{json:#}")?;
            return Ok(());
        }
        let ActorBox { length_m, width_m, height_m } = actor.description.box_;
        writeln!(
            out,
            "actor       {}, {}",
            actor.description.name,
            actor.description.class.name()
        )?;
        writeln!(out, "hash        {}", actor.hash)?;
        writeln!(
            out,
            "box         {length_m:.2} m long, {width_m:.2} m wide, {height_m:.2} m high"
        )?;
        writeln!(
            out,
            "stored      {} bytes, record {}, SH degree {}",
            actor.bytes, actor.record, actor.sh_degree
        )?;
        writeln!(out, "source      {}", actor.description.provenance.source)?;
        writeln!(out, "options     {}", actor.description.provenance.options.join(" "))?;
        for (index, level) in actor.levels.iter().enumerate() {
            writeln!(
                out,
                "level {index:<5} {:>9} Gaussians, error {:.4} m, {} bytes",
                level.count, level.error_m, level.bytes
            )?;
        }
        Ok(())
    }
}
