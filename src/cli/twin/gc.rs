//! `wildcity twin gc`.

use std::io::Write;
use std::time::Duration;

use crate::cli::directories::Twins;
use crate::cli::limits;
use crate::cli::output;
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
            "kept versions {}\n{removed} {} objects, {} bytes\nnoted {} objects, {} bytes",
            kept.join(" "),
            found.removed.objects,
            found.removed.bytes,
            found.noted.objects,
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

fn duration(text: &str) -> Result<Duration, String> {
    let wrong = || "expected a whole number and s, m, h or d, for example 24h".to_owned();
    let unit = text.chars().last().ok_or_else(wrong)?;
    let seconds = match unit {
        's' => 1,
        'm' => 60,
        'h' => 3_600,
        'd' => 86_400,
        _ => return Err(wrong()),
    };
    let number: u64 = text[..text.len() - 1].parse().map_err(|_| wrong())?;
    number.checked_mul(seconds).map(Duration::from_secs).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_a_unit() {
        for (text, seconds) in [("0s", 0), ("90s", 90), ("30m", 1_800), ("24h", 86_400)] {
            assert_eq!(duration(text).unwrap().as_secs(), seconds);
        }
        assert_eq!(duration("7d").unwrap().as_secs(), 7 * 86_400);
        for text in ["", "24", "h", "-1h", "1.5h", "99999999999999999999d", "1 h", "1µ"] {
            assert!(duration(text).unwrap_err().contains("for example 24h"), "{text}");
        }
    }
}
