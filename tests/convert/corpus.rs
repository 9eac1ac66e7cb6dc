//! Public OpenSCENARIO files, of which most must import. They are not in the repository:
//! `$WILDCITY_OPENSCENARIO` is a directory of them with their catalogs and roads.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use wildcity_convert::openscenario::{Part, Settings, read};
use wildcity_sim::scenario::{Document, NoAssets, Scenario, Surroundings};

/// The files below a directory whose names end in `.xosc`.
fn files(dir: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "xosc") {
            found.push(path);
        }
    }
}

/// Directories of catalogs that files take for granted: `$WILDCITY_OPENSCENARIO_CATALOGS`, with `:`
/// between them.
fn catalogs() -> Vec<PathBuf> {
    std::env::var_os("WILDCITY_OPENSCENARIO_CATALOGS")
        .map_or_else(Vec::new, |paths| std::env::split_paths(&paths).collect())
}

/// Imports a file and resolves the scenario.
fn import(path: &Path, parts: &[Part]) -> Result<(), String> {
    let bytes = std::fs::read(path).unwrap();
    let text = String::from_utf8_lossy(&bytes);
    let name_of =
        |object: &str| Some(object.split_once("name=\"")?.1.split_once('"')?.0.to_owned());
    let names: Vec<String> = text.split("<ScenarioObject ").skip(1).filter_map(name_of).collect();
    let ego = names.iter().find(|name| *name == "Ego").or(names.first()).cloned();
    let settings = Settings {
        name: "corpus".into(),
        twin: "street".into(),
        ego: ego.unwrap_or_default(),
        directory: Some(path.parent().unwrap().to_owned()),
        leave_out: parts.iter().copied().collect(),
        catalogs: match parts {
            [] => Vec::new(),
            _ => catalogs(),
        },
        ..Settings::default()
    };
    let imported = read(&bytes, &settings).map_err(|error| error.to_string())?;
    let json = serde_json::to_vec(&imported.file).unwrap();
    let document = Document::parse(&json).map_err(|error| format!("JSON: {error}"))?;
    let file = document.with(&document.first_values()).map_err(|error| format!("JSON: {error}"))?;
    let around = Surroundings { drives: &[], tracks: None, map: None, assets: &NoAssets };
    let resolved = Scenario::resolve(file, 0, &around);
    resolved.map(|_| ()).map_err(|error| format!("resolve: {error}"))
}

/// A reason without the name of a catalog's file and numbers.
fn kind(error: &str) -> String {
    let from = error.find("line ").unwrap_or(0);
    error[from..].chars().filter(|c| !c.is_ascii_digit()).take(120).collect()
}

#[test]
fn most_public_files_import() {
    let mut out = std::io::stderr();
    let Some(root) = std::env::var_os("WILDCITY_OPENSCENARIO") else {
        let line = "NOT RUN: most_public_files_import: WILDCITY_OPENSCENARIO is not set\n";
        out.write_all(line.as_bytes()).unwrap();
        return;
    };
    let mut paths = Vec::new();
    files(Path::new(&root), &mut paths);
    paths.sort();
    let all: Vec<Part> = Part::ALL.iter().map(|(part, _)| *part).collect();
    let mut plain = 0;
    let mut with_parts = 0;
    let mut scenarios = 0;
    let mut counts: BTreeMap<String, [usize; 3]> = BTreeMap::new();
    let mut needed: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut refusals: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for path in &paths {
        // Catalogs and distributions of parameters are no scenarios.
        let text = String::from_utf8_lossy(&std::fs::read(path).unwrap()).into_owned();
        if text.contains("<Catalog ") || text.contains("<ParameterValueDistribution>") {
            continue;
        }
        scenarios += 1;
        let below = path.strip_prefix(&root).unwrap();
        let corpus = below.iter().next().unwrap().to_string_lossy().into_owned();
        let [all_of, plain_of, with_of] = counts.entry(corpus).or_default();
        *all_of += 1;
        let plainly = import(path, &[]);
        plain += usize::from(plainly.is_ok());
        *plain_of += usize::from(plainly.is_ok());
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        match import(path, &all) {
            Ok(()) => {
                with_parts += 1;
                *with_of += 1;
                if let Err(error) = plainly {
                    needed.entry(kind(&error)).or_default().push(format!("{name}: {error}"));
                }
            }
            Err(error) => {
                refusals.entry(kind(&error)).or_default().push(format!("{name}: {error}"));
            }
        }
    }
    let mut lines =
        vec![format!("{scenarios} scenarios, {plain} import, {with_parts} with parts left out")];
    lines.extend(counts.iter().map(|(corpus, counts)| format!("{corpus}: {counts:?}")));
    lines.push("what is refused without options first, and why others do not import:".to_owned());
    for reasons in [needed, refusals] {
        let mut kinds: Vec<_> = reasons.into_values().collect();
        kinds.sort_by_key(|kind| std::cmp::Reverse(kind.len()));
        lines.extend(kinds.iter().map(|kind| format!("{:4}  {}", kind.len(), kind[0])));
        lines.push(String::new());
    }
    out.write_all((lines.join("\n") + "\n").as_bytes()).unwrap();
    assert!(with_parts * 264 >= 200 * scenarios, "{with_parts} of {scenarios}");
    assert!(plain * 264 >= 95 * scenarios, "{plain} of {scenarios} without options");
}
