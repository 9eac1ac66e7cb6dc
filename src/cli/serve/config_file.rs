//! `--config FILE.toml`: the options of `wildcity serve` in a file, and `--print-config`.
//!
//! Every option of the command line is a key of the file: `--memory-gib` is `memory_gib`, and the
//! options under the heading *Limits* are in the table `[limits]`. The file is converted to
//! arguments, which are put before those of the command line. The last value of an option counts,
//! so a flag overrides the file and the file overrides a default. Each option has one description,
//! one check and one default.

use std::borrow::Cow;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Arg, ArgMatches, Args as _, FromArgMatches as _};
use toml::{Table, Value};

use wildcity_twin::ingest;

use crate::cli::limits;

use super::Serve;
use super::limit_options::HEADING;

/// Name of the table of the options under [`HEADING`].
const LIMITS: &str = "limits";

/// Options that cannot be keys of a configuration file.
const NOT_KEYS: [&str; 5] = ["config", "help", "open", "print_config", "twin"];

/// The options of one run.
#[derive(Debug)]
pub(super) struct Resolved {
    pub(super) serve: Serve,
    matches: ArgMatches,
}

/// Parses the arguments after `serve`, and the file of `--config` if there is one.
///
/// # Errors
/// The file cannot be read, has an unknown key or a value that the option refuses.
pub(super) fn resolve(arguments: Vec<OsString>) -> anyhow::Result<Resolved> {
    // Parsed once to find the file, and to report mistakes of the command line before those of the
    // file.
    let flags = command().try_get_matches_from(&arguments)?;
    let matches = match flags.get_one::<PathBuf>("config") {
        Some(path) => {
            let mut all = read(path).with_context(|| format!("--config {}", path.display()))?;
            // After those of the file: of an option that is given twice, the last one holds.
            all.extend(arguments);
            command().try_get_matches_from(all)?
        }
        None => flags,
    };
    Ok(Resolved { serve: Serve::from_arg_matches(&matches)?, matches })
}

/// The command with only its options. An option that is given twice has its last value.
fn command() -> clap::Command {
    Serve::augment_args(clap::Command::new("serve")).args_override_self(true).no_binary_name(true)
}

/// Whether an option is in the table `[limits]`.
fn is_limit(option: &Arg) -> bool {
    option.get_help_heading() == Some(HEADING)
}

/// The key of an option, as `limits.sessions`.
fn option_key(option: &Arg) -> String {
    let name = option.get_id().as_str();
    if is_limit(option) { format!("{LIMITS}.{name}") } else { name.to_owned() }
}

/// The options that are keys of a configuration file.
fn keys(command: &clap::Command) -> impl Iterator<Item = &Arg> {
    let is_key = |option: &&Arg| !NOT_KEYS.contains(&option.get_id().as_str());
    command.get_arguments().filter(is_key)
}

/// Reads a configuration file as arguments.
fn read(path: &Path) -> anyhow::Result<Vec<OsString>> {
    let text = ingest::read_whole(path, limits::SETTINGS_FILE_BYTES)?;
    let table: Table = String::from_utf8(text)?.parse()?;
    let command = command();
    let mut arguments = Vec::new();
    for (key, value) in flattened(table)? {
        let Some(option) = keys(&command).find(|option| option_key(option) == key) else {
            let nearest = nearest(&key, keys(&command).map(option_key));
            anyhow::bail!("there is no key {key}; the nearest is {nearest}");
        };
        let text = match value {
            Value::String(text) => text,
            Value::Integer(number) => number.to_string(),
            Value::Float(number) => number.to_string(),
            Value::Boolean(value) => value.to_string(),
            Value::Array(values)
                if option.get_value_delimiter().is_some()
                    && values.iter().all(Value::is_integer) =>
            {
                values.iter().map(Value::to_string).collect::<Vec<_>>().join(",")
            }
            other => {
                anyhow::bail!("{key} is of type {}; expected a text or a number", other.type_str())
            }
        };
        let flag = option.get_long().with_context(|| format!("{key} has no flag"))?;
        let argument = OsString::from(format!("--{flag}={text}"));
        // Each value is checked by itself, so that the message names the key.
        if let Err(error) = self::command().try_get_matches_from([&argument]) {
            let message = error.to_string();
            let line = message.lines().next().unwrap_or_default();
            anyhow::bail!("{key}: {}", line.strip_prefix("error: ").unwrap_or(line));
        }
        arguments.push(argument);
    }
    Ok(arguments)
}

/// The values of a file by their keys, as `limits.sessions`.
fn flattened(table: Table) -> anyhow::Result<Vec<(String, Value)>> {
    let mut values = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(limits) if key == LIMITS => {
                values.extend(
                    limits.into_iter().map(|(key, value)| (format!("{LIMITS}.{key}"), value)),
                );
            }
            _ if key == LIMITS => anyhow::bail!("{LIMITS} is a table: write [{LIMITS}]"),
            value => values.push((key, value)),
        }
    }
    Ok(values)
}

/// The key that is most similar to a wrong one: the one with the fewest edits of the name, and of
/// several such keys the one in the right table.
fn nearest(wrong: &str, keys: impl Iterator<Item = String>) -> String {
    let name = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let wrong_name = name(wrong);
    let distance = |key: &String| {
        let edits = strsim::damerau_levenshtein(&wrong_name, &name(key));
        // Of two names that are equally near, the one in the same table.
        let is_other_table = key.contains('.') != wrong.contains('.');
        (edits, is_other_table)
    };
    keys.min_by_key(distance).unwrap_or_default()
}

impl Resolved {
    /// Every value that is in effect, with its description: a file that `--config` reads, with the
    /// same effect.
    ///
    /// # Errors
    /// A default directory is not known, because HOME is not set.
    pub(super) fn to_toml(&self) -> anyhow::Result<String> {
        let command = command();
        let mut text = String::from("# Effective configuration of `wildcity serve`.\n");
        let is_value = |option: &&Arg| !is_limit(option);
        for option in keys(&command).filter(is_value) {
            self.write_value(&mut text, option)?;
        }
        let _ = writeln!(text, "\n[{LIMITS}]");
        for option in keys(&command).filter(|option| is_limit(option)) {
            self.write_value(&mut text, option)?;
        }
        Ok(text)
    }

    fn write_value(&self, text: &mut String, option: &Arg) -> anyhow::Result<()> {
        let id = option.get_id().as_str();
        let help = option
            .get_long_help()
            .or(option.get_help())
            .map(ToString::to_string)
            .unwrap_or_default();
        // Writing to a String does not fail.
        let _ = writeln!(text);
        for line in help.lines().flat_map(wrapped) {
            let _ = writeln!(text, "{}", format!("# {line}").trim_end());
        }
        match self.value(id)? {
            Some(value) => {
                let _ = writeln!(text, "{id} = {}", literal(&value));
            }
            None => {
                let _ = writeln!(text, "# {id} is not set.");
            }
        }
        Ok(())
    }

    /// The text of an option that is in effect: given, or a default.
    fn value(&self, id: &str) -> anyhow::Result<Option<String>> {
        let texts = self.matches.get_raw(id).map(|values| {
            values.map(|value| value.to_string_lossy().into_owned()).collect::<Vec<_>>()
        });
        let is_list =
            |option: &Arg| option.get_id() == id && option.get_value_delimiter().is_some();
        // Of an option with one value the last one counts; a list is one text.
        let given = texts.and_then(|mut texts| {
            if command().get_arguments().any(is_list) { Some(texts.join(",")) } else { texts.pop() }
        });
        match given {
            Some(given) => Ok(Some(given)),
            None => self.serve.default_value(id),
        }
    }
}

/// A text as a TOML value: a number or a Boolean if it parses as one, otherwise a string.
fn literal(text: &str) -> Value {
    let parsed = format!("x = {text}").parse::<Table>().ok().and_then(|mut one| one.remove("x"));
    match parsed {
        // Written as it was: a folder named 1_000 or 1e3 is no number.
        Some(scalar @ (Value::Integer(_) | Value::Float(_) | Value::Boolean(_)))
            if scalar.to_string() == text =>
        {
            scalar
        }
        // What is not a number or a boolean of TOML is a text, also a date.
        _ => Value::String(text.to_owned()),
    }
}

/// The lines of a comment.
fn wrapped(line: &str) -> Vec<Cow<'_, str>> {
    let options = textwrap::Options::new(98)
        .break_words(false)
        .word_splitter(textwrap::WordSplitter::NoHyphenation);
    textwrap::wrap(line, options.word_separator(textwrap::WordSeparator::AsciiSpace))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Options that name all directories, so that no test depends on HOME.
    const DIRECTORIES: [&str; 5] =
        ["--twins=/t", "--episodes=/e", "--scenarios=/s", "--uploads=/u", "--cache-dir=/c"];

    fn resolve_with(file: &str, flags: &[&str]) -> anyhow::Result<Resolved> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("serve.toml");
        std::fs::write(&path, file).unwrap();
        let config = format!("--config={}", path.display());
        let arguments = DIRECTORIES.iter().chain(flags).copied().chain([config.as_str()]);
        resolve(arguments.map(OsString::from).collect())
    }

    #[test]
    fn a_flag_overrides_the_file_and_the_file_a_default() {
        let file = "memory_gib = 2\nthreads = 3\n[limits]\nsessions = 7\nidle_timeout_s = 1.5\n";
        let resolved = resolve_with(file, &["--threads=5", "--sessions", "9"]).unwrap();
        let value = |id: &str| resolved.value(id).unwrap().unwrap();
        assert_eq!(value("memory_gib"), "2", "of the file");
        assert_eq!(value("threads"), "5", "of the flag");
        assert_eq!(value("connections"), "1024", "the default");
        let limits = resolved.serve.limits.limits(None);
        assert_eq!(limits.sessions, 9);
        assert_eq!(limits.idle, std::time::Duration::from_millis(1500));
        assert_eq!(limits.send, wildcity_server::Limits::default().send);
    }

    #[test]
    fn without_options_the_limits_are_the_defaults() {
        let resolved = resolve_with("", &[]).unwrap();
        assert_eq!(resolved.serve.limits.limits(None), wildcity_server::Limits::default());
    }

    #[test]
    fn mistakes_in_the_file_name_the_key() {
        for (file, message) in [
            ("memory_gb = 2", "there is no key memory_gb; the nearest is memory_gib"),
            ("memory-gib = 2", "there is no key memory-gib; the nearest is memory_gib"),
            ("sessions = 2", "there is no key sessions; the nearest is limits.sessions"),
            (
                "[limits]\nsesions = 2",
                "there is no key limits.sesions; the nearest is limits.sessions",
            ),
            ("config = \"x\"", "there is no key config"),
            ("limits = 3", "limits is a table"),
            ("[limits]\nsessions = 0", "limits.sessions: invalid value '0'"),
            ("[limits]\nstep_timeout_s = 61", "limits.step_timeout_s: invalid value '61'"),
            ("listen = \"here\"", "listen: invalid value 'here'"),
            ("listen = [1]", "listen is of type array"),
            ("listen = ", "expected"),
        ] {
            let error = format!("{:#}", resolve_with(file, &[]).unwrap_err());
            assert!(error.contains(message), "{file:?}: {error}");
            assert!(error.starts_with("--config"), "{error}");
        }
    }

    #[test]
    fn what_is_printed_can_be_fed_back() {
        let flags = [
            "--memory-gib=0.1",
            "--listen=127.0.0.1:0",
            "--device",
            "a \"b\" \\ c",
            "--audit-log=1e3",
        ];
        let first = resolve_with("[limits]\nsessions = 7\n", &flags).unwrap().to_toml().unwrap();
        assert!(first.contains("\n[limits]\n") && first.contains("\nsessions = 7\n"), "{first}");
        assert!(first.contains("\nmemory_gib = 0.1\n"), "{first}");
        assert!(first.contains("\n# tokens is not set.\n"), "{first}");
        let table: Table = first.parse().unwrap();
        assert_eq!(table["device"].as_str(), Some("a \"b\" \\ c"));
        assert_eq!(table["audit_log"].as_str(), Some("1e3"), "a file, and no number");
        let second = resolve_with(&first, &[]).unwrap().to_toml().unwrap();
        assert_eq!(first, second);
        let several = resolve_with("", &["--devices=0,1"]).unwrap().to_toml().unwrap();
        assert!(several.contains("\ndevices = \"0,1\"\n"), "{several}");
        assert_eq!(resolve_with(&several, &[]).unwrap().to_toml().unwrap(), several);
        assert_eq!(resolve_with("devices = [0, 1]", &[]).unwrap().to_toml().unwrap(), several);
    }

    #[test]
    fn every_key_is_described() {
        let command = command();
        assert!(keys(&command).count() > 25);
        for option in keys(&command) {
            assert!(option.get_help().is_some(), "{} has no description", option_key(option));
            assert!(option.get_long().is_some(), "{} has no flag", option_key(option));
        }
    }
}
