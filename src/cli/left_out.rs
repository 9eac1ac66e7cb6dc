//! Commands that this build leaves out, because it has not all features.

use std::env;

use super::exit::Exit;

/// Commands of a feature: their words, the feature, and whether it is built.
const COMMANDS: [(&str, &str, bool); 16] = [
    ("actor push", "http", cfg!(feature = "http")),
    ("alpasim", "alpasim", cfg!(feature = "alpasim")),
    ("dev bisect", "gpu", cfg!(feature = "gpu")),
    ("dev devices", "gpu", cfg!(feature = "gpu")),
    ("dev stress", "stress", cfg!(feature = "stress")),
    ("episode", "suite", cfg!(feature = "suite")),
    ("eval", "eval", cfg!(feature = "eval")),
    ("log", "log", cfg!(feature = "log")),
    ("push", "http", cfg!(feature = "http")),
    ("report", "report", cfg!(feature = "report")),
    ("scenario check", "suite", cfg!(feature = "suite")),
    ("scenario from-log", "log", cfg!(feature = "log")),
    ("scenario import", "convert", cfg!(feature = "convert")),
    ("train", "train", cfg!(feature = "train")),
    ("twin map import", "convert", cfg!(feature = "convert")),
    ("twin views", "eval", cfg!(feature = "eval")),
];

/// How to build a feature.
pub(super) fn built_without(feature: &str) -> String {
    format!("built without `{feature}`: cargo build --release --features full")
}

/// The error of a command that the parser does not know, if this build leaves it out.
pub(super) fn command() -> Option<anyhow::Error> {
    let words: Vec<String> = env::args().skip(1).collect();
    // clap does not know a command that is not built, and would suggest another one.
    let is_asked = |command: &str| {
        let asked: Vec<&str> = command.split(' ').collect();
        words.len() >= asked.len() && asked.iter().zip(&words).all(|(asked, word)| asked == word)
    };
    let (command, feature, _) =
        COMMANDS.iter().find(|(command, _, is_built)| !is_built && is_asked(command))?;
    let message = format!("wildcity {command}: {}", built_without(feature));
    Some(Exit::error(2, message).into())
}

/// What the help says of the commands that this build leaves out; `None` if it has all.
pub(super) fn help() -> Option<String> {
    let left_out = COMMANDS.iter().filter(|(.., is_built)| !is_built);
    let names: Vec<&str> = left_out.map(|(command, ..)| *command).collect();
    let all = "cargo build --release --features full";
    (!names.is_empty()).then(|| format!("Not in this build ({all}): {}", names.join(", ")))
}
