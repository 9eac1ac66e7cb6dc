//! `wildcity episode prune`.

use std::io::Write;
use std::time::{Duration, SystemTime};

use wildcity_episode::{Keep, prune};

use crate::cli::backend_options::{bytes_of_gib, gib};
use crate::cli::directories::Episodes;
use crate::cli::output;
use crate::cli::time::duration;

use super::folder::records;
use super::{bad_input, exit};
use wildcity_suite::ExitCode;

/// Remove old records of episodes, each with its MCAP file.
///
/// A record that is beyond one of the limits is removed. One without an end may belong to a running
/// session, and stays for a day after its last line; every record stays for a minute. The options
/// --keep-records of `wildcity serve` do the same all the time.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity episode prune --older-than 30d --dry-run
  wildcity episode prune --keep 1000 --most-gib 20")]
#[command(group = clap::ArgGroup::new("limit").required(true).multiple(true).args(["keep", "older_than", "most_gib"]))]
pub(super) struct Prune {
    /// Number of records to keep: the newest ones.
    #[arg(long, value_name = "N")]
    keep: Option<usize>,

    /// Remove records whose last line is older, for example 90s, 30m, 24h or 7d.
    #[arg(long, value_name = "TIME", value_parser = duration)]
    older_than: Option<Duration>,

    /// Size of the records to keep, with their MCAP files, in GiB: the newest ones.
    #[arg(long, value_name = "GIB", value_parser = gib)]
    most_gib: Option<f64>,

    /// Only print what would be removed.
    #[arg(long)]
    dry_run: bool,

    #[command(flatten)]
    episodes: Episodes,
}

impl Prune {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        // A job that prunes each night must not fail before the first drive. A folder that was
        // named and is missing is a mistake.
        if self.episodes.is_unused()? {
            writeln!(
                out,
                "nothing to remove: there is no folder {}",
                self.episodes.dir()?.display()
            )?;
            return Ok(());
        }
        let dir = records(&self.episodes)?;
        let keep = Keep {
            records: self.keep,
            age: self.older_than,
            bytes: self.most_gib.map(bytes_of_gib),
        };
        let pruned = prune(&dir, keep, SystemTime::now(), self.dry_run)
            .map_err(|error| bad_input(format!("cannot read {}: {error}", dir.display())))?;
        let removed = if self.dry_run { "would be removed" } else { "removed" };
        for name in &pruned.removed {
            writeln!(out, "{removed} {name}")?;
        }
        writeln!(
            out,
            "{removed} {}, {} bytes",
            output::counted(pruned.removed.len(), "record"),
            pruned.bytes
        )?;
        writeln!(out, "kept {}", output::counted(pruned.kept, "record"))?;
        if pruned.unfinished > 0 {
            writeln!(out, "of these, {} may be in use", pruned.unfinished)?;
        }
        let failed = pruned.failed.len();
        for (path, error) in pruned.failed {
            eprintln!("{} was not removed: {error}", path.display());
        }
        if failed > 0 {
            return Err(exit(
                ExitCode::Driving,
                format!("not removed: {}", output::counted(failed, "record")),
            ));
        }
        Ok(())
    }
}
