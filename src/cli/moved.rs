//! Commands that have moved. For one version, their old names say what to run instead.

use std::ffi::OsString;

use super::exit::Exit;

/// Exit code of a command line that cannot be parsed.
const USAGE_EXIT_CODE: u8 = 2;

/// A command that has moved.
struct Moved {
    old: &'static str,
    /// The command line that replaces `wildcity OLD`.
    new: &'static str,
    /// An option that the new command does not need.
    without: &'static str,
}

const fn moved(old: &'static str, new: &'static str) -> Moved {
    Moved { old, new, without: "" }
}

/// The commands of version 0.2.0 that are elsewhere now. To be removed after the next version.
const MOVED: [Moved; 14] = [
    moved("augment", "wildcity train augment"),
    moved("bench", "cargo run --release -p wildcity-bench --"),
    moved("bisect", "wildcity dev bisect"),
    moved("devices", "wildcity dev devices"),
    moved("drive", "wildcity alpasim drive"),
    moved("inspect", "wildcity twin show"),
    moved("lod", "wildcity dev lod"),
    moved("map", "wildcity twin map"),
    Moved { old: "repair", new: "wildcity dev repair", without: "check" },
    Moved { old: "replay", new: "wildcity episode show", without: "" },
    moved("rig", "wildcity twin rig"),
    moved("route", "wildcity twin route"),
    moved("stress", "wildcity dev stress"),
    moved("view", "wildcity serve --listen 127.0.0.1:0 --open"),
];

/// The error of an old command: where it went, and the new command line. None for other arguments
/// (those after the name of the program).
pub(super) fn command(arguments: impl Iterator<Item = OsString>) -> Option<Exit> {
    let words: Vec<String> = arguments.map(|word| word.to_string_lossy().into_owned()).collect();
    let is_help = words.first().is_some_and(|word| word == "help");
    let (name, rest) = words[usize::from(is_help)..].split_first()?;
    let Moved { old, new, without } = MOVED.iter().find(|moved| moved.old == *name)?;
    let is_verified = rest.iter().any(|word| word == "--verify" || word.starts_with("--out"));
    let [new, without] = match *old {
        "replay" if is_verified => ["wildcity episode verify", "--verify"],
        _ => [*new, *without],
    };
    let mut line = new.to_owned();
    let left_out = rest.iter().position(|word| word == without);
    for (at, word) in rest.iter().enumerate() {
        if left_out != Some(at) {
            line = format!("{line} {}", quoted(word));
        }
    }
    if is_help {
        line += " --help";
    }
    Some(Exit::error(USAGE_EXIT_CODE, format!("`wildcity {old}` has moved; run\n  {line}")))
}

/// A word as a shell reads it.
pub(super) fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "_-./:=@,+%~".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    fn said(line: &[&str]) -> Option<(u8, String)> {
        let exit = command(line.iter().map(OsString::from))?;
        Some((exit.code, exit.message.lines().last().unwrap_or_default().trim().to_owned()))
    }

    #[test]
    fn an_old_name_gives_the_new_command_line() {
        for (line, new) in [
            (&["lod", "street", "--tau", "1,4"][..], "wildcity dev lod street --tau 1,4"),
            (&["replay", "a b.jsonl", "--verify"], "wildcity episode verify 'a b.jsonl'"),
            (&["replay", "a.jsonl"], "wildcity episode show a.jsonl"),
            (&["view", "street"], "wildcity serve --listen 127.0.0.1:0 --open street"),
            (&["repair", "check", "check"], "wildcity dev repair check"),
            (&["repair", "check", "it's.json"], r"wildcity dev repair 'it'\''s.json'"),
            (&["bench", "step", "--json"], "cargo run --release -p wildcity-bench -- step --json"),
            (&["help", "drive"], "wildcity alpasim drive --help"),
        ] {
            assert_eq!(said(line), Some((2, new.to_owned())), "{line:?}");
        }
        for line in [&[][..], &["help"], &["twin", "rig"], &["episode", "replay"], &["--help"]] {
            assert_eq!(said(line), None, "{line:?}");
        }
    }

    /// Every new name is a command of this build, and no old one is.
    #[test]
    fn what_has_moved_is_where_it_says() {
        let program = crate::cli::Arguments::command();
        for Moved { old, new, .. } in &MOVED {
            assert!(program.find_subcommand(old).is_none(), "{old} is still there");
            let Some(words) = new.strip_prefix("wildcity ") else { continue };
            let mut names = words.split(' ').take_while(|word| !word.starts_with("--"));
            let found = names.try_fold(&program, |command, name| command.find_subcommand(name));
            assert!(found.is_some() || !cfg!(feature = "full"), "{new} is no command");
        }
    }
}
