//! `wildcity completions`.

use std::io::Write as _;

use clap_complete::Shell;

use super::{help_all, output};

/// Print the completions of a shell.
///
/// They also complete the options that only --help-all shows.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Completions {
    /// The shell that reads them.
    #[arg(value_name = "SHELL", value_enum)]
    shell: Shell,
}

const EXAMPLES: &str = "\
Examples:
  source <(wildcity completions bash)
  wildcity completions bash > ~/.local/share/bash-completion/completions/wildcity
  wildcity completions zsh > ~/.zfunc/_wildcity          (a folder of $fpath)
  wildcity completions fish > ~/.config/fish/completions/wildcity.fish";

impl Completions {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut program = help_all::program(super::program(), true);
        // Written at once: a closed pipe ends `output::stdout` quietly, and clap_complete with a
        // panic.
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut program, "wildcity", &mut script);
        output::stdout().write_all(&script)?;
        Ok(())
    }
}
