//! Entities: their classes and boxes.

use wildcity_scene::ActorClass;

use super::catalogs::declared;
use super::element::Element;
use super::ledger::Part;
use super::model::{Context, Entity};
use crate::ConvertError;

/// Most entities: as many as a scenario has actors, and the ego.
const ENTITIES: usize = wildcity_sim::limits::ACTORS + 1;

pub(super) fn read_entities<'a>(
    section: &Element<'a>,
    context: &mut Context<'a>,
) -> Result<(), ConvertError> {
    section.only(&["ScenarioObject"])?;
    for object in section.children() {
        object.only(&[
            "Vehicle",
            "Pedestrian",
            "MiscObject",
            "CatalogReference",
            "ObjectController",
        ])?;
        for controller in object.all("ObjectController") {
            // An empty controller does nothing.
            if controller.children().next().is_none() {
                continue;
            }
            let name = object.text("name")?;
            if name == context.ego {
                controller.mark_left_out();
                controller.note("has no effect: the agent is the ego's controller");
                continue;
            }
            controller.leave_out(Part::Controllers)?;
            context.controlled.insert(name.clone());
            context.placed_by_others.push((name, Part::Controllers));
        }
        let mut described = object.children().filter(|child| child.name() != "ObjectController");
        let what = described.next().ok_or_else(|| object.wrong("has no vehicle or pedestrian"))?;
        let what = match what.name() {
            "CatalogReference" => context.catalogs.entry(&what)?,
            _ => declared(&what)?,
        };
        // Each is compared with all before it, and a scenario can have no more.
        let most = wildcity_sim::limits::ACTORS + 1;
        if context.entities.len() >= most {
            return Err(object.wrong(&format!("is one of more than {most}, the ego included")));
        }
        let name = object.text("name")?;
        let entity = entity_from(&what, &name)?;
        if let Some(trailer) = read_trailer(&what)? {
            context.placed_by_others.push((trailer, Part::Trailers));
        }
        // An actor's name has a smaller alphabet than an entity's, so that two names may become
        // one.
        if context.entities.values().any(|other| other.name == entity.name) {
            return Err(object.wrong(&format!("{name:?} is too like another name; rename it")));
        }
        what.check_read()?;
        context.entities.insert(name, entity);
        if context.entities.len() > ENTITIES {
            return Err(object.wrong(&format!("at most {ENTITIES} entities are read")));
        }
    }
    Ok(())
}

/// The entity that a vehicle tows.
fn read_trailer(what: &Element<'_>) -> Result<Option<String>, ConvertError> {
    let Some(trailer) = what.find("Trailer")? else { return Ok(None) };
    let reference = trailer.only_child()?;
    if reference.name() != "TrailerRef" {
        return trailer.leave_out(Part::Trailers).map(|()| None);
    }
    let name = reference.text("entityRef")?;
    if name.is_empty() {
        return Ok(None);
    }
    trailer.leave_out(Part::Trailers)?;
    Ok(Some(name))
}

/// Properties are a simulator's own: how an entity looks, but for one of esmini that moves its
/// reference point.
fn check_properties(properties: &Element<'_>) -> Result<(), ConvertError> {
    for property in properties.all("Property") {
        let is_offset = property.text("name")? == "refpoint_x_offset";
        let value = property.text("value")?;
        if is_offset && value.parse::<f64>() != Ok(0.0) {
            return Err(
                property.wrong(&format!("value={value:?} is not read; move the box's centre"))
            );
        }
    }
    Ok(())
}

fn entity_from(what: &Element<'_>, name: &str) -> Result<Entity, ConvertError> {
    what.only(&[
        "ParameterDeclarations",
        "BoundingBox",
        "Performance",
        "Axles",
        "Properties",
        "TrailerHitch",
        "TrailerCoupler",
        "Trailer",
    ])?;
    // Looked up only so that they count as read.
    for part in ["TrailerHitch", "TrailerCoupler"] {
        what.find(part)?;
    }
    if let Some(properties) = what.find("Properties")? {
        check_properties(&properties)?;
    }
    let category = what.find_text("vehicleCategory")?;
    let class = match (what.name(), category.as_deref()) {
        ("Vehicle", Some("bicycle")) => ActorClass::Bicycle,
        ("Vehicle", _) => ActorClass::Vehicle,
        ("Pedestrian", _) => ActorClass::Pedestrian,
        ("MiscObject", _) => ActorClass::Object,
        _ => return Err(what.wrong("is no vehicle, pedestrian or object")),
    };
    let bounds = what.need("BoundingBox")?;
    bounds.only(&["Center", "Dimensions"])?;
    let dimensions = bounds.need("Dimensions")?;
    let [length, width, height] = ["length", "width", "height"].map(|name| dimensions.number(name));
    let size = [length?, width?, height?];
    let center = bounds.need("Center")?;
    let [x, y, z] = ["x", "y", "z"].map(|name| center.number(name));
    let center_m = [x?, y?, z?];
    // The bottom of the box should be at the reference point, but for the clearance above the
    // ground.
    if (center_m[2] - 0.5 * size[2]).abs() > 0.5 {
        center.note("z is not used: a box stands on the ground");
    }
    if let Some(performance) = what.find("Performance")? {
        // Limits for drivers; actions have their own dynamics.
        performance.ignore(&["maxSpeed", "maxAcceleration", "maxDeceleration"])?;
    }
    // Without axles, the reference point is taken for the rear axle.
    let mut rear_m = 0.0;
    if let Some(axles) = what.find("Axles")? {
        axles.only(&["FrontAxle", "RearAxle", "AdditionalAxle"])?;
        if let Some(rear) = axles.find("RearAxle")? {
            rear_m = rear.number_or_0("positionX")?;
        }
    }
    Ok(Entity {
        name: super::plain_name(name),
        class,
        size,
        center_m,
        rear_m,
        place: None,
        begin_mps: 0.0,
        fastest_mps: 0.0,
        lane: None,
        line: None,
        route: Vec::new(),
        script: Vec::new(),
        present: true,
    })
}
