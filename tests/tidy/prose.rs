//! Readable text: words for persons only where a person is meant.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::root;

/// Words that mean persons. In this project something else is meant nearly always; then "what",
/// "which", "that" or the name of the thing is right.
const PERSONS: &[&str] = &["who", "whom", "whoever", "nobody", "somebody", "everybody", "anybody"];

/// Folders and files that people read.
const READ: &[&str] = &[
    "src",
    "clients",
    "protocol",
    "shaders",
    "scenes",
    "tests",
    "docs",
    ".ci",
    ".github",
    "README.md",
    "ARCHITECTURE.md",
    "BENCHMARKS.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
];

const EXTENSIONS: &[&str] = &["rs", "md", "py", "wgsl", "toml", "yml"];

/// Files that contain these words on purpose.
const MEANT: &[&str] = &["tests/tidy/prose.rs"];

#[test]
fn words_for_persons_mean_persons() {
    let found: Vec<String> = texts().iter().flat_map(|(file, text)| persons(file, text)).collect();
    assert!(found.is_empty(), "{} lines:\n{}", found.len(), found.join("\n"));
}

#[test]
fn a_planted_word_is_found() {
    let text = "the thread\n/// Who loses tries again.\nwhole whom_i = 1;\n";
    assert_eq!(persons("a.rs", text).len(), 1);
}

fn persons(file: &str, text: &str) -> Vec<String> {
    let lines = text.lines().enumerate();
    let is_person = |line: &str| {
        let words = line.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '-'));
        words.map(str::to_lowercase).any(|word| PERSONS.contains(&&*word))
    };
    lines
        .filter(|(_, line)| is_person(line))
        .map(|(at, line)| format!("{file}:{}: {}", at + 1, line.trim()))
        .collect()
}

fn texts() -> BTreeMap<String, String> {
    let mut texts = BTreeMap::new();
    let mut next: Vec<_> = READ.iter().map(|name| root().join(name)).collect();
    while let Some(path) = next.pop() {
        let name = path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
        let is_built = ["target", "node_modules", ".venv", "build"]
            .contains(&path.file_name().unwrap().to_str().unwrap());
        if path.is_dir() && !is_built {
            next.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if is_text(&path) && !MEANT.contains(&&*name) {
            texts.insert(name, fs::read_to_string(&path).unwrap());
        }
    }
    assert!(texts.len() > 300, "only {} files", texts.len());
    texts
}

fn is_text(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str());
    extension.is_some_and(|extension| EXTENSIONS.contains(&extension))
}
