//! Links of the documents to files of the repository and to their headings.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::root;

#[test]
fn every_relative_link_of_a_document_leads_to_a_file_and_a_heading() {
    let documents = documents();
    assert!(documents.len() >= 4, "{documents:?}");
    let broken: Vec<_> = documents
        .iter()
        .flat_map(|path| broken(path, &fs::read_to_string(path).unwrap()))
        .collect();
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn a_planted_link_to_nowhere_is_found() {
    let path = root().join("README.md");
    let text = "# D\n[a](src/lib.rs), [b](https://example.org/x), [c](#d)\n";
    assert_eq!(broken(&path, text), Vec::<String>::new());
    let text = "[e](protocol/README.md#the-observation)\n";
    assert_eq!(broken(&path, text), Vec::<String>::new());
    assert_eq!(broken(&path, "see [that](docs/nowhere.md#top)").len(), 1);
    assert_eq!(broken(&path, "[x]: nowhere.md\n").len(), 1);
    assert_eq!(broken(&path, "[e](protocol/README.md#nothing), [f](#nothing)").len(), 2);
}

#[test]
fn anchors_are_those_of_the_headings() {
    let text = "# One, `two` (3)\n```\n# no heading\n```\n## A\n## A\n";
    let wanted = ["a", "a-1", "one-two-3"].map(str::to_owned);
    assert_eq!(anchors(text), BTreeSet::from(wanted));
}

/// Folders that are not part of the project, or not written by hand.
const ELSEWHERE: &[&str] = &["target", "shared", "node_modules"];

/// Every Markdown file of the project.
pub(crate) fn documents() -> Vec<PathBuf> {
    let (mut documents, mut folders) = (Vec::new(), vec![root()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            if path.is_dir() && !name.starts_with('.') && !ELSEWHERE.contains(&name) {
                folders.push(path);
            } else if name.ends_with(".md") {
                documents.push(path);
            }
        }
    }
    documents
}

/// The targets of inline links and of reference definitions.
pub(crate) fn links(text: &str) -> impl Iterator<Item = &str> {
    let inline = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let defined =
        text.lines().filter_map(|line| Some(line.strip_prefix('[')?.split_once("]: ")?.1));
    inline.chain(defined).filter(|link| !link.contains("://") && !link.starts_with('<'))
}

/// Links that lead to no file, or to no heading of a document.
fn broken(document: &Path, text: &str) -> Vec<String> {
    let mut broken = Vec::new();
    for link in links(text) {
        let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
        let target = match file {
            "" => document.to_owned(),
            file => document.parent().unwrap().join(file),
        };
        if !target.exists() {
            broken.push(format!("{}: {file} is not there", document.display()));
        } else if !anchor.is_empty() && file.is_empty() {
            if !anchors(text).contains(anchor) {
                broken.push(format!("{}: it has no heading #{anchor}", document.display()));
            }
        } else if !anchor.is_empty() && file.ends_with(".md") {
            let there = fs::read_to_string(&target).unwrap();
            if !anchors(&there).contains(anchor) {
                broken.push(format!("{}: {file} has no heading #{anchor}", document.display()));
            }
        }
    }
    broken
}

/// The anchors of a document's headings, as GitHub and mdbook make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut is_code = false;
    for line in text.lines() {
        is_code ^= line.starts_with("```");
        let heading = line.trim_start_matches('#');
        if is_code || heading.len() == line.len() || !heading.starts_with(' ') {
            continue;
        }
        let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
        let anchor: String = heading.trim().to_lowercase().chars().filter(kept).collect();
        let anchor = anchor.replace(' ', "-");
        let again = (1..).map(|number| format!("{anchor}-{number}"));
        let mut names = std::iter::once(anchor.clone()).chain(again);
        found.insert(names.find(|name| !found.contains(name)).unwrap_or(anchor));
    }
    found
}
