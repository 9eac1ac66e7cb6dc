//! No two files of a package import each other, directly or through others. A file and the `mod.rs` or
//! `lib.rs` above it are not counted: the one declares the other.

use std::collections::{BTreeMap, BTreeSet};

use crate::source::{module, packages, paths};

type Edges = BTreeMap<String, BTreeSet<String>>;

#[test]
fn no_files_import_each_other() {
    let mut cycles = Vec::new();
    for package in packages() {
        for cycle in cycles_of(&edges(&package.files)) {
            cycles.push(format!("{}: {}", package.folder, cycle.join(", ")));
        }
    }
    assert!(cycles.is_empty(), "{}", cycles.join("\n"));
}

#[test]
fn a_planted_cycle_is_found() {
    let file = |name: &str, text: &str| (name.to_owned(), text.to_owned());
    let files = BTreeMap::from([
        file("lib.rs", "mod a; mod b; mod c; pub use a::A;"),
        file("a.rs", "use crate::b::B; pub struct A;"),
        file("b/mod.rs", "mod d; pub struct B; use self::d::D;"),
        file("b/d.rs", "use super::B; use crate::c;"),
        file("c.rs", "fn f() { crate::a::g(); }"),
    ]);
    // a -> b is not part of it: b/mod.rs names only its own child.
    assert!(cycles_of(&edges(&files)).is_empty());
    let mut files = files;
    files.insert("b/mod.rs".to_owned(), "mod d; use crate::c; pub struct B;".to_owned());
    assert_eq!(cycles_of(&edges(&files)), [["a.rs", "b/mod.rs", "c.rs"]]);
}

/// Which file names an item of which other.
fn edges(files: &BTreeMap<String, String>) -> Edges {
    let by_module: BTreeMap<Vec<String>, &String> =
        files.keys().map(|file| (module(file), file)).collect();
    let mut edges = Edges::new();
    for (file, text) in files {
        let own = module(file);
        for named in paths(file, text) {
            let Some(("crate", path)) = named.path.split_first().map(|(a, b)| (a.as_str(), b))
            else {
                continue;
            };
            // The longest start of the path that is a file.
            let target = (0..=path.len()).rev().find(|&n| by_module.contains_key(&path[..n]));
            let Some(target) = target.map(|n| &path[..n]) else { continue };
            let is_family = own.starts_with(target) || target.starts_with(&own);
            if !is_family {
                let to = by_module[target].clone();
                edges.entry(file.clone()).or_default().insert(to);
            }
        }
    }
    edges
}

/// Groups of files that all reach each other, sorted.
fn cycles_of(edges: &Edges) -> Vec<Vec<String>> {
    let reached: BTreeMap<&String, BTreeSet<&String>> =
        edges.keys().map(|file| (file, reached_from(edges, file))).collect();
    let mut cycles = BTreeSet::new();
    for (file, others) in &reached {
        let back = |other: &&&String| reached.get(**other).is_some_and(|own| own.contains(file));
        let mut cycle: Vec<String> = others.iter().filter(back).map(|&file| file.clone()).collect();
        if cycle.len() > 1 {
            cycle.sort();
            cycles.insert(cycle);
        }
    }
    cycles.into_iter().collect()
}

fn reached_from<'a>(edges: &'a Edges, file: &'a String) -> BTreeSet<&'a String> {
    let mut reached = BTreeSet::new();
    let mut next = vec![file];
    while let Some(file) = next.pop() {
        for other in edges.get(file).into_iter().flatten() {
            if reached.insert(other) {
                next.push(other);
            }
        }
    }
    reached
}
