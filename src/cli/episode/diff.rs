//! `wildcity episode diff`.

use std::io::Write;
use std::path::PathBuf;

use wildcity_episode::{What, diff};

use crate::cli::directories::Episodes;
use crate::cli::exit::Exit;
use crate::cli::output;

/// Compare two episodes: the first step at which command, ego, actor or image differ.
///
/// The exit code is 0 if they are alike, 1 if they differ, 2 if one of them cannot be read. Give
/// records (.jsonl), not their MCAP exports. For two runs of a suite, `wildcity episode compare`
/// says which of their episodes changed.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Diff {
    /// One episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "A")]
    a: PathBuf,

    /// The other.
    #[arg(value_name = "B")]
    b: PathBuf,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode diff agent-1 agent-2
  wildcity episode diff yesterday/episodes/cut-in-0.jsonl today/episodes/cut-in-0.jsonl";

impl Diff {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let a = super::read(&self.a, &self.episodes)?;
        let b = super::read(&self.b, &self.episodes)?;
        if let Some(difference) = diff(&a, &b) {
            let text = match difference.what {
                What::Setup => {
                    format!("the episodes were not set up alike: {}", difference.how)
                }
                _ => format!("the episodes differ at {difference}"),
            };
            return Err(Exit::finding(1, text).into());
        }
        let steps = a.driven().last().map_or(0, |frame| frame.step);
        writeln!(output::stdout(), "alike       {}", output::counted(steps as usize, "step"))?;
        Ok(())
    }
}
