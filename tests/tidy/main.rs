//! The rooms of `src`, and whom each may name. The table in `src/lib.rs` says the same in prose.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

/// Each room, and the rooms it may name. A room that is missing here fails the test.
const ROOMS: &[(&str, &[&str])] = &[
    ("config", &[]),
    ("geometry", &[]),
    ("scene", &["geometry"]),
    ("generate", &["geometry", "scene"]),
    ("ingest", &["config", "geometry", "scene"]),
    ("store", &["config", "geometry", "scene", "ingest"]),
    ("residency", &["config", "geometry", "scene", "store"]),
    ("render", &["config", "geometry", "scene"]),
    ("session", &["config", "geometry", "scene", "store", "residency", "render"]),
    ("protocol", &[]),
    ("server", &["config", "geometry", "scene", "store", "render", "session", "protocol"]),
    ("client", &["config", "protocol"]),
    (
        "cli",
        &[
            "config",
            "geometry",
            "scene",
            "generate",
            "ingest",
            "store",
            "residency",
            "render",
            "session",
            "protocol",
            "server",
            "client",
        ],
    ),
];

/// Packages that belong to some places alone.
const PACKAGES: &[(&str, &[&str])] = &[
    ("axum", &["server"]),
    ("hyper", &["server"]),
    ("tokio_tungstenite", &["client", "server"]),
    ("bincode", &["store/chunk_file.rs"]),
    ("clap", &["cli", "render/cpu/mod.rs"]),
    ("anyhow", &["cli"]),
    ("indicatif", &["cli"]),
    ("fearless_simd", &["render/cpu"]),
    ("rayon", &["render", "scene/chunk.rs", "ingest/validate.rs", "residency/cache.rs"]),
    ("tokio", &["server", "client", "session", "cli"]),
    ("schemars", &["protocol"]),
];

/// Within the server, only the converter knows the wire's types.
const WIRE_IN_SERVER: &str = "server/convert";

#[test]
fn every_room_names_only_whom_it_may() {
    let found = violations(&sources());
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_planted_violation_is_found() {
    for (file, line, reason) in [
        ("geometry/pose.rs", "use crate::scene::Rig;", "geometry may not name scene"),
        ("render/cpu/bin.rs", "use crate::{protocol::PROTOCOL};", "render may not name protocol"),
        ("scene/rig.rs", "let x = crate::store::Catalog::open(dir);", "scene may not name store"),
        ("session/episode.rs", "use axum::Router;", "only server may name axum"),
        (
            "server/router.rs",
            "use crate::protocol::message::Open;",
            "only server/convert may name protocol",
        ),
        ("store/catalog.rs", "use bincode::Encode;", "only store/chunk_file.rs may name bincode"),
        ("attic/mod.rs", "", "room attic is not in the table"),
    ] {
        let mut sources = sources();
        sources.entry(file.into()).or_default().push_str(&format!("\n{line}\n"));
        let found = violations(&sources);
        assert!(
            found.iter().any(|violation| violation.contains(reason)),
            "{line:?} in {file} went unnoticed: {found:?}"
        );
    }
}

#[test]
fn what_a_comment_says_is_no_violation() {
    let text =
        "//! As in [`crate::server`].\n/// See crate::cli.\n// axum::Router\nuse glam::DVec3;\n";
    let sources = BTreeMap::from([("geometry/pose.rs".to_owned(), text.to_owned())]);
    assert_eq!(violations(&sources), Vec::<String>::new());
}

#[test]
fn the_table_of_rooms_is_the_one_in_the_documentation() {
    let lib = fs::read_to_string(root().join("src/lib.rs")).unwrap();
    for (room, _) in ROOMS {
        assert!(lib.contains(&format!("| [`{room}`] |")), "{room} is missing in src/lib.rs");
        assert!(lib.contains(&format!("pub mod {room};")), "{room} is no module of src/lib.rs");
    }
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
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

fn violations(sources: &BTreeMap<String, String>) -> Vec<String> {
    let mut found = Vec::new();
    for (file, text) in sources {
        let room = file.split(['/', '.']).next().unwrap();
        let Some((_, may_name)) = ROOMS.iter().find(|(name, _)| *name == room) else {
            found.push(format!("{file}: room {room} is not in the table of tests/tidy"));
            continue;
        };
        for (number, line) in text.lines().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            let place = format!("{file}:{}", number + 1);
            for named in rooms_named(code) {
                if named != room && !may_name.contains(&named) {
                    found.push(format!("{place}: {room} may not name {named}"));
                }
                let converts = is_within(file, WIRE_IN_SERVER);
                if room == "server" && named == "protocol" && !converts {
                    found.push(format!("{place}: only {WIRE_IN_SERVER} may name protocol"));
                }
            }
            for (package, places) in PACKAGES {
                let belongs = places.iter().any(|place| is_within(file, place));
                if names_package(code, package) && !belongs {
                    found.push(format!("{place}: only {} may name {package}", places.join(", ")));
                }
            }
        }
    }
    found
}

fn is_within(file: &str, place: &str) -> bool {
    file == place || file.strip_prefix(place).is_some_and(|rest| rest.starts_with(['/', '.']))
}

/// Rooms behind `crate::` in a line, `crate::{a, b}` included. rustfmt keeps a list of rooms on one
/// line, since imports are written one room at a time.
fn rooms_named(code: &str) -> Vec<&str> {
    let after = code.match_indices("crate::").map(|(at, path)| &code[at + path.len()..]);
    after
        .flat_map(|rest| rest.trim_start_matches('{').split([',', '{', '}']))
        .filter_map(|part| {
            let word = part.trim().split(|c: char| !c.is_alphanumeric() && c != '_').next()?;
            ROOMS.iter().find(|(room, _)| *room == word).map(|(room, _)| *room)
        })
        .collect()
}

fn names_package(code: &str, package: &str) -> bool {
    code.match_indices(package).any(|(at, _)| {
        let before = code[..at].chars().next_back();
        let is_word = before.is_none_or(|c| !c.is_alphanumeric() && !"_\".".contains(c));
        is_word && code[at + package.len()..].starts_with("::")
    })
}
