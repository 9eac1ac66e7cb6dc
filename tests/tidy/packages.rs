//! The table of packages in `src/lib.rs` equals the manifests, and crates that belong to one place
//! are named only there.

use std::collections::BTreeMap;
use std::fs;

use crate::root;
use crate::source::{Package, packages, paths};

/// Crates that only some files may name, by their path from the root of the repository.
const CRATES: &[(&str, &[&str])] = &[
    ("axum", &["src/server"]),
    ("prost", &["src/alpasim", "src/episode/export"]),
    ("tonic", &["src/alpasim"]),
    ("tonic_prost", &["src/alpasim"]),
    ("prometheus_client", &["src/server/metrics.rs", "src/server/process.rs"]),
    ("bincode", &["src/twin/store/chunk_file.rs", "src/train/checkpoint.rs"]),
    (
        "fearless_simd",
        &[
            "src/render/cpu",
            "src/scene/lod",
            "src/scene/record",
            "src/scene/sky",
            "src/repair/reference/warp.rs",
            "src/train/loss/ssim.rs",
            "src/train/model",
        ],
    ),
    ("wgpu", &["src/render/gpu"]),
    ("libc", &["src/heap"]),
    ("ort", &["src/repair/onnx.rs"]),
    ("object_store", &["src/twin/store/remote", "src/twin/store/catalog.rs"]),
    (
        "rustls",
        &["src/twin/store/remote", "src/server/tls", "src/cli/serve/log.rs", "clients/rust"],
    ),
    ("opentelemetry", &["src/cli/serve/log.rs"]),
    ("opentelemetry_otlp", &["src/cli/serve/log.rs"]),
    ("opentelemetry_sdk", &["src/cli/serve/log.rs"]),
    ("tracing_opentelemetry", &["src/cli/serve/log.rs"]),
    ("flate2", &["src/twin/ingest"]),
    ("zip", &["src/twin/ingest/archive.rs", "src/cli/alpasim", "src/cli/packed_folder.rs"]),
    ("image_webp", &["src/twin/ingest/sog"]),
];

/// Files that may open files: those of a twin only `store/local`; the others scenes and settings of
/// the user, training data, logs, episodes, uploads, scenarios, their catalogs and roads, pictures, and
/// how much memory and processor time there is.
const FILES: &[&str] = &[
    "src/twin/store/local",
    "src/twin/residency/budget.rs",
    "src/twin/ingest",
    "src/augment/folder.rs",
    "src/session/polls.rs",
    "src/session/record",
    "src/session/scenario/load.rs",
    "src/episode",
    "src/suite",
    "src/server/audit.rs",
    "src/server/memory.rs",
    "src/server/process.rs",
    "src/server/start.rs",
    "src/server/spool",
    "clients/rust/src/memory.rs",
    "clients/rust/src/upload.rs",
    "src/repair/files.rs",
    "src/convert/openscenario/files.rs",
    "src/bench",
    "src/train/examples",
    "src/log",
    "src/cli",
];

/// The modules that open files.
const FILE_MODULES: &[&[&str]] = &[&["std", "fs"], &["tokio", "fs"]];

/// Within the server, only the converter and the table of faults use the messages of the
/// wire; its limits apply everywhere.
const WIRE_IN_SERVER: &[&str] = &["src/server/convert", "src/server/fault"];

#[test]
fn the_table_of_packages_is_that_of_the_manifests() {
    let lib = fs::read_to_string(root().join("src/lib.rs")).unwrap();
    let wanted: BTreeMap<String, Vec<String>> = packages()
        .into_iter()
        .filter(|package| package.name != "wildcity")
        .map(|package| (package.name, package.depends_on))
        .collect();
    assert_eq!(table(&lib), wanted);
}

#[test]
fn crates_are_named_where_they_belong() {
    let found: Vec<String> = packages().iter().flat_map(violations).collect();
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_planted_violation_is_found() {
    for (folder, file, planted, reason) in [
        ("src/session", "episode.rs", "use axum::Router;", "only src/server may name axum"),
        (
            "src/render",
            "cpu/sort.rs",
            "fn f() { wgpu::init(); }",
            "only src/render/gpu may name wgpu",
        ),
        ("src/twin", "store/log.rs", "use bincode::Encode;", "checkpoint.rs may name bincode"),
        ("src/twin", "store/log.rs", "use std::{fs, io};", "may name std::fs"),
        (
            "src/server",
            "router.rs",
            "use wildcity_protocol::message;",
            "may name wildcity_protocol",
        ),
    ] {
        let package = Package {
            name: "planted".to_owned(),
            depends_on: Vec::new(),
            files: BTreeMap::from([(file.to_owned(), planted.to_owned())]),
            folder: folder.to_owned(),
            inherits_lints: true,
        };
        let found = violations(&package);
        assert!(found.iter().any(|text| text.contains(reason)), "{planted:?}: {found:?}");
    }
}

#[test]
fn only_heap_may_have_unsafe() {
    let own = |package: &Package| !package.inherits_lints;
    let found: Vec<String> = packages().into_iter().filter(own).map(|it| it.name).collect();
    assert_eq!(found, ["wildcity-heap"]);
}

/// The rows ``//! | `wildcity-render` | what it is | scene |`` of the documentation.
fn table(lib: &str) -> BTreeMap<String, Vec<String>> {
    let rows = lib.lines().filter_map(|line| line.strip_prefix("//! | [`wildcity_"));
    rows.map(|row| {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [name, _, depends_on, ""] = cells[..] else { panic!("{row}") };
        let name = format!("wildcity-{}", name.trim_end_matches("`]"));
        let depends_on = depends_on.split(", ").filter(|other| *other != "nothing of ours");
        let mut depends_on: Vec<String> =
            depends_on.map(|other| format!("wildcity-{other}")).collect();
        depends_on.sort();
        (name, depends_on)
    })
    .collect()
}

fn violations(package: &Package) -> Vec<String> {
    let mut found = Vec::new();
    for (file, text) in &package.files {
        let place = format!("{}/{file}", package.folder);
        for named in paths(file, text) {
            let path: Vec<&str> = named.path.iter().map(String::as_str).collect();
            if let Some(wrong) = wrong(&place, &path) {
                found.push(format!("{place}:{}: {wrong}", named.line));
            }
        }
    }
    found
}

fn wrong(place: &str, path: &[&str]) -> Option<String> {
    let only = |places: &[&str], what: &str| {
        let is_within = places.iter().any(|allowed| {
            place.strip_prefix(allowed).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        });
        (!is_within).then(|| format!("only {} may name {what}", places.join(", ")))
    };
    if FILE_MODULES.iter().any(|module| path.starts_with(module)) {
        return only(FILES, &path[..2].join("::"));
    }
    let is_wire = path[0] == "wildcity_protocol" && path.get(1) != Some(&"limits");
    if place.starts_with("src/server") && is_wire {
        return only(WIRE_IN_SERVER, path[0]);
    }
    let (_, places) = CRATES.iter().find(|(name, _)| *name == path[0])?;
    only(places, path[0])
}
