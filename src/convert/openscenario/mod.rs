//! Scenarios from OpenSCENARIO XML 1.0 to 1.3.
//!
//! | module | what it reads |
//! |---|---|
//! | `element`, `expression` | elements, attributes, and formulas of parameters |
//! | `ledger` | what was read: anything else is refused, or left out on request with a note |
//! | `files`, `catalogs`, `entities` | files beside it, catalogs and parameters; vehicles, pedestrians and objects |
//! | `position`, `roads`, `lane_line`, `simplify`, `route`, `trajectory` | places in the world and on roads, lines along lanes, trajectories |
//! | `init`, `story`, `elements`, `actions`, `distances`, `controllers`, `ego_route`, `conditions`, `stop` | the storyboard |
//! | `model`, `build` | what is known of the scenario, and its actors |
//!
//! Everything else is refused with its name and line: a scenario with a part missing would be
//! another scenario.

mod actions;
mod build;
mod catalogs;
mod conditions;
mod controllers;
mod distances;
mod ego_route;
mod element;
mod elements;
mod entities;
mod expression;
mod files;
mod init;
mod lane_line;
mod ledger;
mod model;
mod position;
mod roads;
mod route;
mod simplify;
mod stop;
mod story;
mod trajectory;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use wildcity_sim::scenario::{EndSection, RouteSection, ScenarioFile, TwinPin, VerdictSection};

pub use ledger::Part;

use crate::{ConvertError, opendrive, utf8_text, xml};
use build::Builder;
use catalogs::Catalogs;
use element::{Element, Source};
use ledger::Ledger;
use model::Context;
use roads::RoadMap;

/// Most elements and texts of a file.
const NODES: u32 = 1_000_000;

/// Values that the file does not have.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Name of the scenario.
    pub name: String,
    /// Name of the twin in which it plays.
    pub twin: String,
    /// Name of the entity that the agent drives.
    pub ego: String,
    /// Directory of the file, from which it names catalogs and roads.
    pub directory: Option<PathBuf>,
    /// More directories of catalogs.
    pub catalogs: Vec<PathBuf>,
    /// The OpenDRIVE file of the roads, in place of the one that the file names.
    pub roads: Option<PathBuf>,
    /// Easting and northing of the twin's origin, as for the map of these roads.
    pub origin: Option<[f64; 2]>,
    /// Parameters with other values than those of the file.
    pub parameters: BTreeMap<String, String>,
    /// Parts that are left out, with a note.
    pub leave_out: BTreeSet<Part>,
}

/// A scenario, and what a person should know about it.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    pub file: ScenarioFile,
    /// What was left out or assumed, with lines.
    pub notes: Vec<String>,
}

/// Reads a scenario.
///
/// # Errors
/// Names the element and the line of the first part that is not read.
pub fn read(bytes: &[u8], settings: &Settings) -> Result<Imported, ConvertError> {
    // Some editors mark UTF-8 in front.
    let text = utf8_text(bytes)?.trim_start_matches('\u{feff}');
    let document = xml::parse(text, NODES)?;
    let ledger = Ledger::new(settings.leave_out.clone());
    let source = Source { index: 0, label: "" };
    let root = Element::new(document.root_element(), Rc::default(), &ledger, source);
    if root.name() != "OpenSCENARIO" {
        return Err(root.wrong("is no <OpenSCENARIO>"));
    }
    if root.find("ParameterValueDistribution")?.is_some() {
        let message = "is a distribution of parameters: import the scenario that it names, with --parameter NAME=VALUE";
        return Err(root.wrong(message));
    }
    // First the values of the file, so that unknown names are refused; then the given ones.
    let root = catalogs::declared(&root)?;
    let root = with_parameters(&root, &settings.parameters)?;
    check_header(&root)?;
    // Elements borrow from the texts and the documents, which therefore live here.
    let texts = catalogs::read_texts(&root, document.root_element(), settings)?;
    let documents = catalogs::parse_documents(&texts);
    let catalogs = Catalogs::new(&documents, &ledger);
    let file = file_from((&root, document.root_element()), catalogs, settings, &ledger)?;
    // Last, when all that was needed has been read.
    root.check_read()?;
    Ok(Imported { file, notes: ledger.notes() })
}

/// The parameters of the file with other values.
fn with_parameters<'a>(
    root: &Element<'a>,
    given: &BTreeMap<String, String>,
) -> Result<Element<'a>, ConvertError> {
    if let Some(unknown) = given.keys().find(|name| !root.parameters().contains_key(*name)) {
        let known: Vec<&str> = root.parameters().keys().map(String::as_str).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        return Err(root.wrong(&format!("declares no parameter {unknown:?}; it declares {known}")));
    }
    if given.is_empty() {
        return Ok(root.clone());
    }
    // Declared again, because others may use them.
    catalogs::declared_with(root, given)
}

fn check_header(root: &Element<'_>) -> Result<(), ConvertError> {
    root.only(&[
        "FileHeader",
        "ParameterDeclarations",
        "VariableDeclarations",
        "CatalogLocations",
        "RoadNetwork",
        "Entities",
        "Storyboard",
    ])?;
    let header = root.need("FileHeader")?;
    let version = (header.text("revMajor")?, header.text("revMinor")?);
    if !matches!((version.0.as_str(), version.1.as_str()), ("1", "0" | "1" | "2" | "3")) {
        let message = format!("version {}.{} is not read; 1.0 to 1.3 are", version.0, version.1);
        return Err(header.wrong(&message));
    }
    root.find("VariableDeclarations")?;
    Ok(())
}

/// The values that actions set: the name, the value, and the event; without an event, an empty
/// text.
fn read_sets(node: roxmltree::Node<'_, '_>) -> Vec<(String, String, String)> {
    let actions = node.descendants().filter_map(|node| {
        let name = match node.tag_name().name() {
            "ParameterAction" => node.attribute("parameterRef"),
            "VariableAction" => node.attribute("variableRef"),
            _ => None,
        };
        let set = node.children().find(|child| child.has_tag_name("SetAction"));
        let value = set.and_then(|set| set.attribute("value")).unwrap_or_default();
        // There is no event around an action of `Init`.
        let event = node
            .ancestors()
            .find(|node| node.has_tag_name("Event"))
            .and_then(|event| event.attribute("name"))
            .unwrap_or_default();
        name.map(|name| (catalogs::plain_parameter(name), value.to_owned(), event.to_owned()))
    });
    actions.collect()
}

/// The values of variables at the start.
fn read_variables(root: &Element<'_>) -> Result<BTreeMap<String, String>, ConvertError> {
    let mut variables = BTreeMap::new();
    if let Some(section) = root.find("VariableDeclarations")? {
        section.only(&["VariableDeclaration"])?;
        for declaration in section.children() {
            variables.insert(declaration.raw("name")?, declaration.text("value")?);
        }
    }
    Ok(variables)
}

fn file_from<'a>(
    (root, node): (&Element<'a>, roxmltree::Node<'_, '_>),
    catalogs: Catalogs<'a>,
    settings: &Settings,
    ledger: &'a Ledger,
) -> Result<ScenarioFile, ConvertError> {
    let roads = read_roads(root, settings)?;
    roads.notes.into_iter().for_each(|note| ledger.note(note));
    let mut context = Context {
        entities: BTreeMap::new(),
        roads: roads.map,
        shift_m: roads.shift_m,
        catalogs,
        ego: settings.ego.clone(),
        is_in_story: false,
        waiting: Vec::new(),
        placed_by_others: Vec::new(),
        variables: read_variables(root)?,
        sets: read_sets(node),
        missing_roads: roads.missing,
        minor_version: root.need("FileHeader")?.whole("revMinor")?,
        controlled: controllers::assigned(node).into_iter().collect(),
        ego_route: None,
    };
    // In this order: events refer to where `Init` has put entities, and `Init` to entities.
    entities::read_entities(&root.need("Entities")?, &mut context)?;
    if !context.entities.contains_key(&settings.ego) {
        let known: Vec<&str> = context.entities.keys().map(String::as_str).collect();
        let known = known.join(", ");
        let message = format!("has no entity {:?}; name the ego with --ego: {known}", settings.ego);
        return Err(root.wrong(&message));
    }
    let storyboard = root.need("Storyboard")?;
    storyboard.only(&["Init", "Story", "StopTrigger"])?;
    init::read_init(&storyboard.need("Init")?, &mut context)?;
    context.is_in_story = true;
    let mut states = elements::Elements::default();
    for story in storyboard.all("Story") {
        story::read_story(&story, &mut context, &mut states)?;
    }
    let stop = storyboard
        .find("StopTrigger")?
        .map(|stop| stop::read_stop(&stop, &context))
        .transpose()?
        .unwrap_or_default();
    let end_s = stop.time_s;
    let ends = elements::resolve(states, stop.groups, &mut context)?;
    // Without a condition, only the time ends the scenario.
    let when = (!ends.is_empty()).then(|| conditions::join_any(ends));
    let builder = Builder { context: &context, ledger, end_s };
    let mut actors = Vec::new();
    for (name, entity) in context.entities.iter().filter(|(name, _)| **name != settings.ego) {
        // A trailer, or an entity of a controller that is left out, need not have a place.
        let by = context.placed_by_others.iter().find(|(other, _)| other == name);
        if let Some((_, part)) = by.filter(|_| entity.place.is_none()) {
            ledger.note(format!("entity {name:?}: is left out ({})", part.name()));
            continue;
        }
        let actor = builder.actor_section(entity);
        actors
            .push(actor.map_err(|message| ConvertError::new(format!("entity {name:?}"), message))?);
    }
    let ego = &context.entities[&settings.ego];
    let points = context.ego_route.clone();
    let route = points.map(|points| RouteSection { points: Some(points), ..Default::default() });
    // The file's own trigger ends the scenario, and not the route.
    let route_done = route.is_some().then_some(false);
    Ok(ScenarioFile {
        format: ScenarioFile::FORMAT.to_owned(),
        name: settings.name.clone(),
        twin: TwinPin { name: settings.twin.clone(), version_hash: None },
        map: None,
        ego: build::ego_section(ego, ledger),
        route,
        tracks: None,
        actors,
        sweep: None,
        end: EndSection { time_s: end_s, when, route_done, ..EndSection::default() },
        verdict: VerdictSection::default(),
        seed: None,
    })
}

/// The roads of a scenario.
#[derive(Default)]
struct ScenarioRoads {
    map: Option<RoadMap>,
    /// What is added to coordinates in the world, in metres.
    shift_m: [f64; 2],
    /// By how much the roads were moved, and why.
    notes: Vec<String>,
    /// Why the roads that the scenario names were not read.
    missing: Option<String>,
}

/// The roads that the file or the settings name, or why they were not read.
fn read_roads(root: &Element<'_>, settings: &Settings) -> Result<ScenarioRoads, ConvertError> {
    // Without roads, the origin is a place in the frame of the positions themselves.
    let shift_m = settings.origin.map_or([0.0; 2], |[east, north]| [-east, -north]);
    let without = ScenarioRoads { shift_m, ..ScenarioRoads::default() };
    let section = root.find("RoadNetwork")?;
    let mut named = None;
    if let Some(section) = &section {
        section.only(&["LogicFile", "SceneGraphFile", "TrafficSignals"])?;
        if let Some(signals) = section.find("TrafficSignals")? {
            signals.leave_out(Part::Signals)?;
        }
        if let Some(file) = section.find("LogicFile")? {
            named = Some(file.text("filepath")?).filter(|path| !path.is_empty());
        }
    }
    let path = match (&settings.roads, named) {
        (Some(path), _) => path.clone(),
        (None, None) => return Ok(without),
        (None, Some(named)) => {
            let path = Path::new(&named.replace('\\', "/")).to_owned();
            let path = settings.directory.as_ref().map(|dir| dir.join(&path)).unwrap_or(path);
            // No error yet: whatever needs the roads gives this reason.
            if !path.is_file() {
                let reason = format!("there is no file {}; name it with --roads", path.display());
                return Ok(ScenarioRoads { missing: Some(reason), ..without });
            }
            path
        }
    };
    let bytes = files::read_bytes(&path)?;
    let roads = opendrive::roads_from(&bytes, settings.origin).map_err(|error| {
        ConvertError::new(format!("{}, {}", path.display(), error.place), error.message)
    })?;
    let opendrive::Roads { network, shift_m, notes, .. } = roads;
    let map = Some(RoadMap::new(network));
    Ok(ScenarioRoads { map, shift_m, notes, missing: None })
}

/// A name of `[a-z0-9._-]+`.
fn plain_name(name: &str) -> String {
    let plain = |c: char| match c.to_ascii_lowercase() {
        c @ ('a'..='z' | '0'..='9' | '_' | '-' | '.') => c,
        _ => '-',
    };
    // Two names may become one, which `read_entities` refuses.
    let plain: String = name.chars().map(plain).collect();
    plain.trim_start_matches('.').chars().take(64).collect()
}
