//! `wildcity twin gc`.

use std::io::Write;
use std::time::Duration;

use crate::cli::directories::Twins;
use crate::cli::limits;
use crate::cli::output;
use crate::cli::time::duration;
use wildcity_twin::store::Retention;

/// Remove objects of a twin that none of the kept versions refers to.
///
/// This takes two runs: the first one records which objects are garbage, and a run after the grace
/// period removes them. Run the command every day. Versions that running servers use are kept,
/// however old they are.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin gc street --keep 20 --dry-run
  wildcity twin gc street --keep 20 --grace 24h")]
pub(super) struct Gc {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Number of latest versions to keep.
    #[arg(long, value_name = "N", default_value_t = limits::GC_KEEP,
          value_parser = clap::value_parser!(u32).range(1..))]
    keep: u32,

    /// How long an object is kept after it was recorded as garbage, for example 90s, 30m, 24h or
    /// 7d.
    #[arg(long, value_name = "TIME", default_value = limits::GC_GRACE, value_parser = duration)]
    grace: Duration,

    /// Only print the changes that would be made.
    #[arg(long)]
    dry_run: bool,

    #[command(flatten)]
    twins: Twins,
}

impl Gc {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let keep = Retention { versions: self.keep as usize, grace: self.grace };
        let found = catalog.collect(&self.twin, keep, self.dry_run)?;
        let kept: Vec<_> = found.kept.iter().map(u64::to_string).collect();
        let removed = if self.dry_run { "would be removed" } else { "removed" };
        writeln!(
            output::stdout(),
            "kept versions {}\n{removed} {}, {} bytes\nnoted {}, {} bytes",
            kept.join(" "),
            output::counted(found.removed.objects as usize, "object"),
            found.removed.bytes,
            output::counted(found.noted.objects as usize, "object"),
            found.noted.bytes,
        )?;
        if let Some((number, damage)) = found.blocked_by {
            writeln!(
                output::stdout(),
                "nothing can be removed before the manifest of version {number}, which is damaged: {damage}"
            )?;
        }
        Ok(())
    }
}
