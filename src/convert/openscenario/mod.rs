//! Scenarios from OpenSCENARIO XML 1.0 to 1.3.
//!
//! Read are: parameters with formulas; vehicles, pedestrians and objects with their boxes; in `Init`, positions,
//! speeds and trajectories; in the story, events that change a speed, follow a trajectory, add or delete an entity;
//! conditions on time, speed, distance, driven distance and started events; a stop at a time. Positions are in the
//! world or relative to an entity. Everything else is refused with its name and line: a scenario with a part missing
//! would be another scenario.

mod element;
mod expression;
mod position;
mod story;

use std::collections::BTreeMap;

use wildcity_scene::ActorClass;
use wildcity_sim::scenario::{
    ActorSection, CollideSection, DynamicsSection, EgoBoxSection, EgoSection, EndSection,
    ModelSection, PathSection, PoseSection, ScenarioFile, StartSection, TimedPosition,
    TriggerSection, TwinPin, VerdictSection,
};

use crate::{ConvertError, text_of};
use element::Element;
use position::Place;

/// Deepest nesting of elements, so that no stack overflows.
const NODES: u32 = 1_000_000;

/// An actor that has no trajectory drives straight on for this distance, in metres.
const STRAIGHT_M: f64 = 1000.0;

/// Values that the file does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Name of the scenario.
    pub name: String,
    /// Name of the twin in which it plays.
    pub twin: String,
    /// Name of the entity that the agent drives.
    pub ego: String,
}

/// An entity while the file is read.
#[derive(Clone, Debug)]
struct Entity {
    /// Name in the scenario file.
    name: String,
    class: ActorClass,
    size: [f64; 3],
    /// From the reference point, the middle of the rear axle, forward to the box's centre, in metres.
    center_x_m: f64,
    place: Option<Place>,
    /// The speed after the actions that were read so far, in m/s.
    speed_mps: f64,
    begin_mps: f64,
    /// Points of a trajectory, and their times if they count.
    line: Option<Vec<[f64; 3]>>,
    times_s: Option<Vec<f64>>,
    script: Vec<TriggerSection>,
    present: bool,
}

/// Reads a scenario.
///
/// # Errors
/// Names the element and the line of the first part that is not read.
pub fn read(bytes: &[u8], settings: &Settings) -> Result<ScenarioFile, ConvertError> {
    let text = text_of(bytes)?;
    let options =
        roxmltree::ParsingOptions { allow_dtd: false, nodes_limit: NODES, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(text, options)
        .map_err(|error| ConvertError::new("XML", error.to_string()))?;
    let none = BTreeMap::new();
    let parameters = parameters_of(Element::new(document.root_element(), &none))?;
    let root = Element::new(document.root_element(), &parameters);
    if root.name() != "OpenSCENARIO" {
        return Err(root.wrong("is no <OpenSCENARIO>"));
    }
    root.only(&[
        "FileHeader",
        "ParameterDeclarations",
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
    if let Some(catalogs) = root.find("CatalogLocations")? {
        catalogs.only(&[])?;
    }
    if let Some(roads) = root.find("RoadNetwork")? {
        roads.only(&["LogicFile", "SceneGraphFile"])?;
    }
    let mut entities = entities_of(root.need("Entities")?)?;
    let storyboard = root.need("Storyboard")?;
    storyboard.only(&["Init", "Story", "StopTrigger"])?;
    story::read_init(storyboard.need("Init")?, &mut entities)?;
    for story in storyboard.all("Story") {
        story::read_story(story, &mut entities, &settings.ego)?;
    }
    name_owners(&mut entities)?;
    let end = match storyboard.find("StopTrigger")? {
        None => EndSection::default(),
        Some(stop) => EndSection { time_s: story::stop_time_s(stop)?, ..EndSection::default() },
    };
    let ego = entities.remove(&settings.ego).ok_or_else(|| {
        let message = format!("has no entity {:?}; name the ego with --ego", settings.ego);
        root.wrong(&message)
    })?;
    let mut actors = Vec::new();
    for (name, entity) in &entities {
        actors.push(
            actor_of(entity)
                .map_err(|message| ConvertError::new(format!("entity {name:?}"), message))?,
        );
    }
    if !ego.script.is_empty() {
        let message = "has events, but the agent drives it: name another ego, or remove them";
        return Err(ConvertError::new(format!("entity {:?}", settings.ego), message));
    }
    Ok(ScenarioFile {
        format: ScenarioFile::FORMAT.to_owned(),
        name: settings.name.clone(),
        twin: TwinPin { name: settings.twin.clone(), version_hash: None },
        map: None,
        ego: ego_of(&ego),
        route: None,
        tracks: None,
        actors,
        sweep: None,
        end,
        verdict: VerdictSection::default(),
        seed: None,
    })
}

/// The parameters, whose values may use earlier parameters.
fn parameters_of(root: Element<'_>) -> Result<BTreeMap<String, String>, ConvertError> {
    let mut parameters = BTreeMap::new();
    let Some(section) = root.find("ParameterDeclarations")? else { return Ok(parameters) };
    section.only(&["ParameterDeclaration"])?;
    for declaration in section.children() {
        declaration.only(&[])?;
        let name = declaration.text("name")?;
        let value = declaration.text("value")?;
        parameters.insert(name.trim_start_matches('$').to_owned(), value);
    }
    Ok(parameters)
}

fn entities_of(section: Element<'_>) -> Result<BTreeMap<String, Entity>, ConvertError> {
    section.only(&["ScenarioObject"])?;
    let mut entities: BTreeMap<String, Entity> = BTreeMap::new();
    for object in section.children() {
        object.only(&["Vehicle", "Pedestrian", "MiscObject", "ObjectController"])?;
        if let Some(controller) = object.find("ObjectController")? {
            controller.only(&[])?;
        }
        let mut described = object.children().filter(|child| child.name() != "ObjectController");
        let what = described.next().ok_or_else(|| object.wrong("has no vehicle or pedestrian"))?;
        let category = what.find_text("vehicleCategory")?;
        let class = match (what.name(), category.as_deref()) {
            ("Vehicle", Some("bicycle")) => ActorClass::Bicycle,
            ("Vehicle", _) => ActorClass::Vehicle,
            ("Pedestrian", _) => ActorClass::Pedestrian,
            _ => ActorClass::Object,
        };
        let bounds = what.need("BoundingBox")?;
        bounds.only(&["Center", "Dimensions"])?;
        let dimensions = bounds.need("Dimensions")?;
        let size = [
            dimensions.number("length")?,
            dimensions.number("width")?,
            dimensions.number("height")?,
        ];
        let center_x_m = bounds.need("Center")?.number("x")?;
        let name = object.text("name")?;
        let plain = plain_name(&name);
        if entities.values().any(|other| other.name == plain) {
            return Err(object.wrong(&format!("{name:?} is too like another name; rename it")));
        }
        let entity = Entity {
            name: plain,
            class,
            size,
            center_x_m,
            place: None,
            speed_mps: 0.0,
            begin_mps: 0.0,
            line: None,
            times_s: None,
            script: Vec::new(),
            present: true,
        };
        entities.insert(name, entity);
    }
    Ok(entities)
}

/// Puts the actor in front of each trigger that a condition names, because OpenSCENARIO names only events.
fn name_owners(entities: &mut BTreeMap<String, Entity>) -> Result<(), ConvertError> {
    let mut owners: BTreeMap<String, String> = BTreeMap::new();
    for entity in entities.values() {
        for trigger in entity.script.iter().filter_map(|trigger| trigger.name.clone()) {
            owners.insert(trigger, entity.name.clone());
        }
    }
    for (name, entity) in entities {
        for trigger in &mut entity.script {
            let Some(after) = &mut trigger.when.after else { continue };
            let Some(owner) = owners.get(after) else {
                let message = format!("an event waits for {after:?}, which there is not");
                return Err(ConvertError::new(format!("entity {name:?}"), message));
            };
            *after = format!("{owner}/{after}");
        }
    }
    Ok(())
}

/// A name of `[a-z0-9._-]+`.
fn plain_name(name: &str) -> String {
    let plain = |c: char| match c.to_ascii_lowercase() {
        c @ ('a'..='z' | '0'..='9' | '_' | '-' | '.') => c,
        _ => '-',
    };
    let plain: String = name.chars().map(plain).collect();
    plain.trim_start_matches('.').chars().take(64).collect()
}

fn ego_of(ego: &Entity) -> EgoSection {
    let pose = ego.place.map(|place| section_of(&place));
    let start =
        pose.map(|pose| StartSection { trajectory: None, station_m: None, pose: Some(pose) });
    let dynamics =
        DynamicsSection { model: ModelSection::Dynamic, speed: ego.begin_mps, reverse: false };
    EgoSection {
        start,
        dynamics: Some(dynamics),
        box_: Some(EgoBoxSection { size: ego.size, center_x: ego.center_x_m }),
        ..EgoSection::default()
    }
}

fn section_of(place: &Place) -> PoseSection {
    PoseSection { xyz: place.xyz_m, yaw_rad: Some(place.yaw_rad), q: None }
}

/// An actor: on its trajectory, through timed positions, standing, or straight on.
fn actor_of(entity: &Entity) -> Result<ActorSection, String> {
    let place = entity.place.ok_or("has no position in <Init>; add a <TeleportAction>")?;
    let mut actor = ActorSection {
        name: entity.name.clone(),
        class: Some(entity.class),
        size: Some(entity.size),
        present: (!entity.present).then_some(false),
        script: entity.script.clone(),
        ..ActorSection::default()
    };
    let center = place.ahead(entity.center_x_m);
    let moves = entity.script.iter().any(|trigger| story::is_motion(&trigger.then));
    match (&entity.line, &entity.times_s) {
        (Some(line), Some(times_s)) => {
            if moves {
                return Err("has timed positions and events that move it; keep one of them".into());
            }
            let positions = line.iter().zip(times_s);
            let positions =
                positions.map(|(xyz, time_s)| TimedPosition { time_s: *time_s, xyz: *xyz });
            actor.collide = Some(CollideSection {
                positions: Some(positions.collect()),
                yaw_rad: Some(place.yaw_rad),
                ..CollideSection::default()
            });
        }
        (Some(line), None) => {
            actor.path = Some(PathSection {
                points: Some(line.clone()),
                // The reference point follows the line; the box's centre is ahead of it.
                station_m: entity.center_x_m.max(0.0),
                speed: entity.begin_mps,
                ..PathSection::default()
            });
        }
        (None, _) if entity.begin_mps == 0.0 && !moves => {
            actor.stand = Some(section_of(&center));
        }
        (None, _) => {
            actor.path = Some(PathSection {
                points: Some(vec![center.xyz_m, center.ahead(STRAIGHT_M).xyz_m]),
                speed: entity.begin_mps,
                ..PathSection::default()
            });
        }
    }
    Ok(actor)
}
