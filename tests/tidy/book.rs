//! docs/ is a book: its table of contents has every page once, and the pages that a program writes
//! are as it writes them.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use crate::links::{documents, links};
use crate::root;

#[test]
fn the_table_of_contents_has_every_page_once() {
    let docs = root().join("docs");
    let summary = fs::read_to_string(docs.join("SUMMARY.md")).unwrap();
    let mut listed: BTreeMap<PathBuf, usize> = BTreeMap::new();
    for link in links(&summary) {
        *listed.entry(docs.join(link)).or_default() += 1;
    }
    let wanted: BTreeMap<PathBuf, usize> = documents()
        .into_iter()
        .filter(|path| path.starts_with(&docs) && !path.ends_with("SUMMARY.md"))
        .map(|path| (path, 1))
        .collect();
    let differ = |a: &BTreeMap<PathBuf, usize>, b: &BTreeMap<PathBuf, usize>| -> Vec<PathBuf> {
        a.iter()
            .filter(|(path, count)| b.get(*path) != Some(*count))
            .map(|(path, _)| path.clone())
            .collect()
    };
    let lacks = differ(&wanted, &listed);
    let wrong = differ(&listed, &wanted);
    assert!(
        lacks.is_empty() && wrong.is_empty(),
        "docs/SUMMARY.md does not list once: {lacks:#?}; lists twice, or is no page: {wrong:#?}"
    );
}

/// `clients/python/tests/test_reference.py` does the same with the pages that need the program.
#[test]
fn generated_pages_are_as_generated() {
    let generate = root().join("docs/generate.py");
    let output = Command::new("python3")
        .arg("-B")
        .arg(generate)
        .arg("--check")
        .output()
        .expect("python3 is installed");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
