//! The help of a program: each command and option has a text, and each command an example.

/// The commands without subcommands, each with the words that select it.
pub(crate) fn leaf_commands(command: &clap::Command) -> Vec<(String, clap::Command)> {
    let mut leaves = Vec::new();
    let mut waiting = vec![(command.get_name().to_owned(), command.clone())];
    while let Some((path, command)) = waiting.pop() {
        let subcommands = command.get_subcommands().filter(|sub| !sub.is_hide_set());
        waiting.extend(subcommands.map(|sub| (format!("{path} {}", sub.get_name()), sub.clone())));
        if !command.has_subcommands() {
            leaves.push((path, command));
        }
    }
    leaves
}

/// Checks the help of every command.
pub(crate) fn check(program: &clap::Command, at_least: usize) {
    program.clone().debug_assert();
    let leaves = leaf_commands(program);
    assert!(leaves.len() >= at_least, "{} commands", leaves.len());
    for (path, command) in leaves {
        let after = command.get_after_long_help().map(ToString::to_string).unwrap_or_default();
        assert!(command.get_about().is_some(), "{path} has no description");
        assert!(after.contains(&path) && after.contains("Example"), "{path} has no example");
        for argument in command.get_arguments() {
            assert!(argument.get_help().is_some(), "{path}: {} has no help", argument.get_id());
        }
    }
}
