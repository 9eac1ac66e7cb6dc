//! The table and the invariants of `src/lib.rs`, held against the source.

mod links;
mod scanner;

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

/// Packages that belong to some places alone.
const PACKAGES: &[(&str, &[&str])] = &[
    ("axum", &["server"]),
    ("hyper", &["client", "server"]),
    ("http_body_util", &["client", "server"]),
    ("bytes", &["client"]),
    ("prometheus_client", &["server/metrics.rs"]),
    ("sha2", &["server"]),
    ("tokio_tungstenite", &["client", "server"]),
    ("bincode", &["store/chunk_file.rs"]),
    ("clap", &["cli"]),
    ("anyhow", &["cli"]),
    ("indicatif", &["cli"]),
    ("fearless_simd", &["render/cpu", "scene/sky"]),
    ("wgpu", &["render/gpu"]),
    (
        "rayon",
        &[
            "render",
            "scene/chunk.rs",
            "scene/sky",
            "generate/city.rs",
            "scene/validate.rs",
            "store/pack.rs",
        ],
    ),
    ("tokio", &["server", "client", "session", "cli", "store/remote"]),
    // The catalog is made from one that is open.
    ("object_store", &["store/remote", "store/catalog.rs"]),
    ("rustls", &["store/remote"]),
    ("schemars", &["protocol"]),
    ("flate2", &["ingest"]),
    ("zip", &["ingest/archive.rs"]),
    ("image_webp", &["ingest/sog"]),
    (
        "data_encoding",
        &["ingest/gltf", "report/page.rs", "scene/appearance.rs", "server/uploads.rs"],
    ),
    ("plotters", &["cli/rig/draw.rs", "report/plots.rs"]),
];

/// Who may touch files: those of a twin only `store/local`; the others scenes and settings of the user,
/// episodes (the server makes their directory), uploads, pictures, and how much memory there is.
const FILES: &[&str] = &[
    "store/local",
    "residency/budget.rs",
    "ingest",
    "session/record.rs",
    "session/replay.rs",
    "server/mod.rs",
    "server/spool.rs",
    "client/upload.rs",
    "cli",
];
/// The modules that open files.
const FILE_MODULES: &[&[&str]] = &[&["std", "fs"], &["tokio", "fs"]];

/// Within the server, only the converter knows the wire's types.
const WIRE_IN_SERVER: &str = "server/convert";

/// Rooms, and whom each may name.
type Table = BTreeMap<String, Vec<String>>;

#[test]
fn every_room_names_only_whom_it_may() {
    let found = violations(&table(&lib()), &sources());
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn the_table_has_every_room_and_no_other() {
    let (lib, table) = (lib(), table(&lib()));
    let modules = lib.lines().filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';'));
    let modules: Vec<_> = modules.collect();
    assert!(modules.is_sorted() && modules.len() > 10, "{modules:?}");
    assert_eq!(table.keys().collect::<Vec<_>>(), modules);
    for (room, may_name) in &table {
        for other in may_name {
            assert!(table.contains_key(other), "{room} may name {other}, which is no room");
            assert!(!table[other].contains(room), "{room} and {other} name each other");
        }
    }
}

#[test]
fn a_planted_violation_is_found() {
    let url = r#"let url = "http://here"; axum::serve();"#;
    let many = "use crate::{\n    geometry::Pose,\n    protocol::PROTOCOL,\n};";
    let inline = "mod tests {\n use super::super::super::store::Catalog;\n}";
    for (file, planted, reason) in [
        ("geometry/pose.rs", "use crate::scene::Rig;", "geometry may not name scene"),
        ("render/cpu/bin.rs", "use crate::{protocol::PROTOCOL};", "render may not name protocol"),
        ("render/cpu/bin.rs", many, "render may not name protocol"),
        ("render/cpu/bin.rs", "use super::super::super::server;", "render may not name server"),
        ("render/mod.rs", "use super::cli::main;", "render may not name cli"),
        ("scene/rig.rs", inline, "scene may not name store"),
        ("scene/rig.rs", "let x = crate::store::Catalog::open(dir);", "scene may not name store"),
        ("scene/rig.rs", "let x: Vec<crate::store::Version> = y;", "scene may not name store"),
        ("scene/rig.rs", "use crate::*;", "scene may not name the whole crate"),
        ("scene/rig.rs", "use crate as all;", "scene may not name the whole crate"),
        ("session/episode.rs", "use axum::Router;", "only server may name axum"),
        ("session/episode.rs", "use axum;", "only server may name axum"),
        ("session/episode.rs", "use ::axum as web;", "only server may name axum"),
        ("session/episode.rs", url, "only server may name axum"),
        ("session/episode.rs", "let c = '\"'; axum::serve();", "only server may name axum"),
        (
            "server/router.rs",
            "use crate::protocol::message::Open;",
            "only server/convert may name protocol",
        ),
        (
            "server/router.rs",
            "use super::super::protocol;",
            "only server/convert may name protocol",
        ),
        ("store/catalog.rs", "use bincode::Encode;", "only store/chunk_file.rs may name bincode"),
        ("store/catalog.rs", "use std::{fs, io};", "may name std::fs"),
        ("store/recover.rs", "let f = std::fs::File::open(path);", "may name std::fs"),
        ("store/verify.rs", "use std::fs::OpenOptions;", "may name std::fs"),
        ("residency/cache.rs", "use std::fs::File;", "may name std::fs"),
        ("server/router.rs", "tokio::fs::read(path).await", "may name tokio::fs"),
        ("attic/mod.rs", "", "room attic is not in the table"),
    ] {
        let mut sources = sources();
        sources.entry(file.into()).or_default().push_str(&format!("\n{planted}\n"));
        let found = violations(&table(&lib()), &sources);
        assert!(
            found.iter().any(|violation| violation.contains(reason)),
            "{planted:?} in {file} went unnoticed: {found:?}"
        );
    }
}

#[test]
fn a_row_that_allows_less_forbids_more() {
    let lib = lib().replacen("| geometry, scene |", "| geometry |", 1);
    let found = violations(&table(&lib), &sources());
    assert!(found.iter().all(|violation| violation.contains("generate may not name scene")));
    assert!(!found.is_empty());
}

#[test]
fn what_a_comment_or_a_text_says_is_no_violation() {
    let text = r##"//! As in [`crate::server`].
/// See crate::cli.
// axum::Router
/* axum::Router /* and */ crate::store */
use glam::DVec3;
const A: &str = "crate::server \" crate::cli";
const B: &str = r#"" crate::server"#;
fn c<'a>(d: &'a str) -> char { d.fs(); '"' }
mod tests {
    use super::super::camera;
}
use super::camera;
"##;
    let sources = BTreeMap::from([("geometry/pose.rs".to_owned(), text.to_owned())]);
    assert_eq!(violations(&table(&lib()), &sources), Vec::<String>::new());
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn lib() -> String {
    fs::read_to_string(root().join("src/lib.rs")).unwrap()
}

/// The table of the documentation: ``//! | [`room`] | what it is | may name |``.
fn table(lib: &str) -> Table {
    let rows = lib.lines().filter_map(|line| line.strip_prefix("//! | [`"));
    rows.map(|row| {
        let cells: Vec<_> = row.split('|').map(str::trim).collect();
        let [room, _, may_name, ""] = cells[..] else { panic!("{row}") };
        let may_name = may_name.split(", ").filter(|room| *room != "nothing");
        (room.trim_end_matches("`]").to_owned(), may_name.map(str::to_owned).collect())
    })
    .collect()
}

/// Text of every file of every room, by its path within `src`.
fn sources() -> BTreeMap<String, String> {
    let src = root().join("src");
    let mut sources = BTreeMap::new();
    let mut folders = vec![src.clone()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if !["lib.rs", "main.rs"].map(|f| src.join(f)).contains(&path) {
                let name = path.strip_prefix(&src).unwrap().to_str().unwrap().to_owned();
                sources.insert(name, fs::read_to_string(&path).unwrap());
            }
        }
    }
    assert!(sources.len() > 50, "the sources are elsewhere");
    sources
}

fn violations(table: &Table, sources: &BTreeMap<String, String>) -> Vec<String> {
    let mut found = Vec::new();
    for (file, text) in sources {
        let room = file.split(['/', '.']).next().unwrap();
        let Some(may_name) = table.get(room) else {
            found.push(format!("{file}: room {room} is not in the table of src/lib.rs"));
            continue;
        };
        for scanner::Named { path, line } in scanner::paths(file, text) {
            let path: Vec<&str> = path.iter().map(String::as_str).collect();
            found.extend(
                wrong_room(table, room, may_name, file, &path)
                    .or_else(|| wrong_package(file, &path))
                    .map(|wrong| format!("{file}:{line}: {wrong}")),
            );
        }
    }
    found
}

fn wrong_room(
    table: &Table,
    room: &str,
    may_name: &[String],
    file: &str,
    path: &[&str],
) -> Option<String> {
    let named = match path {
        ["crate"] | ["crate", "*", ..] => {
            return Some(format!("{room} may not name the whole crate"));
        }
        ["crate", named, ..] if table.contains_key(*named) => *named,
        _ => return None,
    };
    if named != room && !may_name.iter().any(|other| other == named) {
        return Some(format!("{room} may not name {named}"));
    }
    let converts = is_within(file, WIRE_IN_SERVER);
    (room == "server" && named == "protocol" && !converts)
        .then(|| format!("only {WIRE_IN_SERVER} may name protocol"))
}

fn wrong_package(file: &str, path: &[&str]) -> Option<String> {
    let elsewhere = |places: &[&str]| !places.iter().any(|place| is_within(file, place));
    let only = |places: &[&str], what: &str| format!("only {} may name {what}", places.join(", "));
    if FILE_MODULES.iter().any(|module| path.starts_with(module)) && elsewhere(FILES) {
        return Some(only(FILES, &path[..2].join("::")));
    }
    let (package, places) = PACKAGES.iter().find(|(package, _)| path.first() == Some(package))?;
    elsewhere(places).then(|| only(places, package))
}

fn is_within(file: &str, place: &str) -> bool {
    file == place || file.strip_prefix(place).is_some_and(|rest| rest.starts_with(['/', '.']))
}
