//! One version: that of the workspace. The changelog has a section for it.

use std::fs;

use crate::root;

#[test]
fn every_file_that_has_the_version_has_the_same() {
    let version = version();
    let mut wrong = Vec::new();
    for (file, text) in [
        ("clients/python/pyproject.toml", format!("\nversion = \"{version}\"\n")),
        ("clients/kubernetes/kustomization.yaml", format!("\n    newTag: {version}\n")),
        ("protocol/openapi.json", format!("\n    \"version\": \"{version}\"\n")),
        ("README.md", format!("\nVersion {version} ")),
        ("CHANGELOG.md", format!("\n## {version} - 2")),
    ] {
        if !fs::read_to_string(root().join(file)).unwrap().contains(&text) {
            wrong.push(format!("{file} has no line {:?}", text.trim()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Packages of the workspace that name others name them by this version, too.
#[test]
fn packages_name_each_other_by_the_version() {
    let text = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let wanted = format!("version = \"{}\"", version());
    let own = text.lines().filter(|line| line.starts_with("wildcity-") && line.contains("path = "));
    let others: Vec<&str> = own.filter(|line| !line.contains(&wanted)).collect();
    assert!(others.is_empty(), "{}", others.join("\n"));
}

/// Its first section is Unreleased, and the sections of versions have dates.
#[test]
fn the_changelog_has_the_form_of_keep_a_changelog() {
    let text = fs::read_to_string(root().join("CHANGELOG.md")).unwrap();
    let sections: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("## ")).collect();
    assert_eq!(sections.first(), Some(&"Unreleased"));
    for section in &sections[1..] {
        let date = section.split_once(" - ").map(|(_, date)| date);
        let is_date = date.is_some_and(|date| date.len() == 10 && date.matches('-').count() == 2);
        assert!(is_date, "{section} is not VERSION - YYYY-MM-DD");
    }
    let kinds = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"];
    for kind in text.lines().filter_map(|line| line.strip_prefix("### ")) {
        assert!(kinds.contains(&kind), "{kind} is none of {}", kinds.join(", "));
    }
}

fn version() -> String {
    let text = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Value = toml::from_str(&text).unwrap();
    manifest["workspace"]["package"]["version"].as_str().unwrap().to_owned()
}
