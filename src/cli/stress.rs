//! `wildcity stress`.

use std::io::{self, Write};

use anyhow::ensure;

use wildcity_render::reference::Reference;
use wildcity_stress::table::{self, Candidate};
use wildcity_stress::{CASES, Case, Verdict};

use super::backend_options::HardwareOptions;
use super::progress;

/// Draw stiff and extreme scenes on every backend, and hold each against its bound.
///
/// Needles of 10,000 px, depths from a centimetre to ten kilometres, 4,500 km from the origin, NaN, 70
/// million keys: each has broken a published renderer. Prints one table, and fails if a bound is missed.
/// What cannot be run is named, with the reason; so is what a device refuses, with how much fits.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Stress {
    /// Cases, as T1,T26 [default: all]
    #[arg(long = "case", value_name = "T..", value_delimiter = ',', value_parser = case)]
    cases: Vec<&'static Case>,

    /// Backends.
    #[arg(
        long = "backend",
        value_name = "NAME",
        value_delimiter = ',',
        value_enum,
        default_values_t = Name::ALL
    )]
    backends: Vec<Name>,

    /// Run the cases that take gigabytes and minutes, too.
    #[arg(long)]
    heavy: bool,

    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity stress
  wildcity stress --case T1,T26 --backend cpu
  wildcity stress --backend gpu --device 0 --heavy --json > stress.json";

/// The backends by their own names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Name {
    Reference,
    Cpu,
    Gpu,
}

impl Name {
    /// All of them, the definition first.
    pub(super) const ALL: [Self; 3] = [Self::Reference, Self::Cpu, Self::Gpu];
}

impl Stress {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let backends = self.backends.iter().map(|name| candidate(*name, &self.hardware));
        let backends = backends.collect::<anyhow::Result<Vec<Candidate>>>()?;
        let all = || CASES.iter().collect();
        let cases = if self.cases.is_empty() { all() } else { self.cases };
        let bar = progress::state();
        bar.set_length((cases.len() * backends.len()) as u64);
        let table = table::run(&cases, &backends, self.heavy, &mut |done, case| {
            bar.set_position(done as u64);
            bar.set_message(case.to_owned());
        });
        bar.finish_and_clear();
        let mut out = io::stdout().lock();
        match self.json {
            true => writeln!(out, "{}", serde_json::to_string(&table)?)?,
            false => write!(out, "{table}")?,
        }
        let missed = table.count(Verdict::Missed);
        ensure!(missed == 0, "{missed} bounds are missed");
        Ok(())
    }
}

/// A backend, or why this machine has none of the kind.
pub(super) fn candidate(name: Name, hardware: &HardwareOptions) -> anyhow::Result<Candidate> {
    Ok(match name {
        Name::Reference => Ok(Box::new(Reference)),
        Name::Cpu => Ok(Box::new(hardware.cpu()?)),
        Name::Gpu => match hardware.gpu() {
            Ok(gpu) => Ok(Box::new(gpu)),
            Err(error) => Err(("gpu", error.to_string())),
        },
    })
}

fn case(text: &str) -> Result<&'static Case, String> {
    CASES
        .iter()
        .find(|case| case.number.eq_ignore_ascii_case(text))
        .ok_or_else(|| format!("there is no case {text:?}; they are T1 to T{}", CASES.len()))
}
