//! `wildcity dev stress`.
//!
//! The stress table is part of the program and not of its tests, so that a faulty driver is found
//! on the machine that has it. The reference is not compared with itself: its images must be
//! finite, and have the values that a case states. For each check, `tests/stress/mutations.rs`
//! applies a mutation to the cpu backend and to the reference that the check must detect.

use std::io::Write;

use anyhow::ensure;

use wildcity_render::reference::Reference;
use wildcity_stress::table::{self, Candidate};
use wildcity_stress::{CASES, Case, Verdict};

use crate::cli::backend_options::HardwareOptions;
use crate::cli::output;
use crate::cli::progress;

/// Render extreme scenes on every backend, and compare each with its bound.
///
/// The scenes have needles of 10,000 px, depths from a centimetre to ten kilometres, places 4,500
/// km from the origin, NaN, or 70 million sort keys: each has broken a published renderer. Prints
/// one table, and fails if a bound is exceeded. For a case that cannot run here, the table says
/// why; for a case that exceeds a limit of the device, it says how much fits.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Stress {
    /// Cases to run, for example T1,T26 [default: all]
    #[arg(long = "case", value_name = "T..", value_delimiter = ',', value_parser = case)]
    cases: Vec<&'static Case>,

    /// Backends to run them on.
    #[arg(
        long = "backend",
        value_name = "NAME",
        value_delimiter = ',',
        value_enum,
        default_values_t = BackendName::ALL
    )]
    backends: Vec<BackendName>,

    /// Also run the cases that need gigabytes of memory and take minutes.
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
  wildcity dev stress
  wildcity dev stress --case T1,T26 --backend cpu
  wildcity dev stress --backend gpu --device 0 --heavy --json > stress.json";

/// The backends that a case can run on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(in crate::cli) enum BackendName {
    Reference,
    Cpu,
    Gpu,
}

impl BackendName {
    /// All of them; the reference is the first.
    pub(in crate::cli) const ALL: [Self; 3] = [Self::Reference, Self::Cpu, Self::Gpu];
}

impl Stress {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let backends = self
            .backends
            .iter()
            .map(|name| candidate(*name, &self.hardware))
            .collect::<anyhow::Result<Vec<Candidate>>>()?;
        let all = || CASES.iter().collect();
        let cases = if self.cases.is_empty() { all() } else { self.cases };
        let bar = progress::state();
        bar.set_length((cases.len() * backends.len()) as u64);
        let table = table::run(&cases, &backends, self.heavy, &mut |done, case| {
            bar.set_position(done as u64);
            bar.set_message(case.to_owned());
        });
        bar.finish_and_clear();
        let mut out = output::stdout();
        if self.json {
            writeln!(out, "{}", serde_json::to_string(&table)?)?
        } else {
            write!(out, "{table}")?
        }
        let missed = table.count(Verdict::Missed);
        ensure!(missed == 0, "{missed} bounds are missed");
        Ok(())
    }
}

/// A backend, or the reason why this machine does not have it.
pub(in crate::cli) fn candidate(
    name: BackendName,
    hardware: &HardwareOptions,
) -> anyhow::Result<Candidate> {
    Ok(match name {
        BackendName::Reference => Ok(Box::new(Reference)),
        BackendName::Cpu => Ok(Box::new(hardware.cpu()?)),
        BackendName::Gpu => match hardware.gpu() {
            Ok(gpu) => Ok(Box::new(gpu)),
            // A machine without a GPU still tests the other backends: the table names what is
            // missing.
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
