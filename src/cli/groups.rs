//! The commands in the help of the program, in groups by the task of the user.
//!
//! clap has headings for options and none for commands, so that the list of each group is that of a
//! program of its own, put together by a template.

use std::fmt::Write as _;

use clap::Command;

/// Headings, and the commands below each. Commands that this build leaves out are not listed.
const GROUPS: [(&str, &[&str]); 5] = [
    ("To start", &["demo", "serve", "doctor"]),
    ("Twins", &["import", "push", "twin", "actor", "log", "train"]),
    ("Drives", &["scenario", "episode", "alpasim"]),
    ("Images and their errors", &["render", "eval", "report"]),
    ("The program itself", &["dev", "completions", HELP]),
];

/// The command that clap adds.
const HELP: &str = "help";

/// The program, with its commands in groups in its help.
pub(super) fn grouped(program: Command) -> Command {
    let style = *program.get_styles().get_header();
    let mut lists = String::new();
    for (heading, names) in GROUPS {
        let of_group = names.iter().filter_map(|name| listed(&program, name));
        let list = Command::new("group")
            .help_template("{subcommands}")
            .disable_help_flag(true)
            .disable_help_subcommand(true)
            .subcommands(of_group)
            .render_help();
        // Writing into a text cannot fail.
        let _ = writeln!(lists, "{style}{heading}:{style:#}\n{}", list.ansi());
    }
    program.help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{lists}\
         {style}Options:{style:#}\n{{options}}{{after-help}}"
    ))
}

/// A command with its name and description alone.
fn listed(program: &Command, name: &'static str) -> Option<Command> {
    let about = match program.find_subcommand(name) {
        Some(command) => command.get_about().cloned().unwrap_or_default(),
        None if name == HELP => "Print the help of a command".into(),
        None => return None,
    };
    Some(Command::new(name).about(about))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::program;

    #[test]
    fn every_command_is_in_one_group_and_in_the_help() {
        let program = program();
        let mut grouped: Vec<&str> =
            GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let help = program.clone().render_long_help().to_string();
        let names = program.get_subcommands().map(Command::get_name);
        for name in names.filter(|name| *name != HELP) {
            let places = grouped.iter().filter(|place| **place == name).count();
            assert_eq!(places, 1, "{name} is in {places} groups");
            assert!(help.contains(&format!("\n  {name} ")), "{name} is not in the help:\n{help}");
            grouped.retain(|place| *place != name);
        }
        if cfg!(feature = "full") {
            assert_eq!(grouped, [HELP], "commands that there are not");
        }
        let start = "Usage: wildcity <COMMAND>\n\nTo start:\n  demo    Build";
        assert!(help.contains(start), "{help}");
        assert!(help.contains("\n\nTwins:\n  import  Make a twin"), "{help}");
        assert!(help.contains("\n\nOptions:\n  -h, --help"), "{help}");
    }
}
