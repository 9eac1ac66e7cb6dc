//! `--help-all`: the options that `--help` leaves out.
//!
//! An option that few persons need (threads, caches, time-outs) is declared with `hide`: it works
//! as every other one, and a configuration file may have it. Every command has `--help-all`, which
//! shows these options, too; `--help` of a command that has some mentions it.

use clap::{Arg, ArgAction, Command};

const NAME: &str = "help-all";

/// Whether the arguments of this process ask for the whole help.
pub fn is_asked() -> bool {
    std::env::args_os().any(|argument| argument.to_str() == Some("--help-all"))
}

/// The program with `--help-all`; if `is_whole`, its help has every option.
pub fn program(command: Command, is_whole: bool) -> Command {
    let has_rare = command.get_arguments().any(Arg::is_hide_set);
    let option = Arg::new(NAME)
        .long(NAME)
        .action(ArgAction::HelpLong)
        .help("Print help with the options that few need: threads, caches, limits")
        // Not that of the last options.
        .help_heading(None)
        .hide(!has_rare);
    let shown = if is_whole { command.mut_args(|argument| argument.hide(false)) } else { command };
    shown.mut_subcommands(|subcommand| program(subcommand, is_whole)).arg(option)
}
