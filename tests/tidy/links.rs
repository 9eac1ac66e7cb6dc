//! Links of the documents to files of the repository.

use std::fs;
use std::path::{Path, PathBuf};

use crate::root;

#[test]
fn every_relative_link_of_a_document_leads_to_a_file() {
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
    let text = "[a](src/lib.rs), [b](https://example.org/x), [c](#d), [e](protocol/README.md#f)\n";
    assert_eq!(broken(&path, text), Vec::<String>::new());
    assert_eq!(broken(&path, "see [that](docs/nowhere.md#top)").len(), 1);
    assert_eq!(broken(&path, "[x]: nowhere.md\n").len(), 1);
}

/// Folders that are not part of the project, or not written by hand.
const ELSEWHERE: &[&str] = &["target", "shared", "node_modules"];

fn documents() -> Vec<PathBuf> {
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

/// Inline links and reference definitions that lead to no file.
fn broken(document: &Path, text: &str) -> Vec<String> {
    let inline = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let defined =
        text.lines().filter_map(|line| Some(line.strip_prefix('[')?.split_once("]: ")?.1));
    inline
        .chain(defined)
        .filter(|link| !link.contains("://") && !link.starts_with(['#', '<']))
        .map(|link| link.split('#').next().unwrap())
        .filter(|file| !document.parent().unwrap().join(file).exists())
        .map(|file| format!("{}: {file} is not there", document.display()))
        .collect()
}
