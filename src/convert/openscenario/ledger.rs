//! What the importer has read: whatever it has not read is refused at the end, so that nothing is
//! ignored in silence.

use std::cell::RefCell;
use std::collections::{BTreeSet, HashSet};

use roxmltree::{Node, NodeId};

use crate::ConvertError;

/// Parts that an import may leave out on request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// Controllers of entities but the ego, and what activates or overrides them.
    Controllers,
    /// Actions of the entity that the agent drives, but for its start and its route.
    Ego,
    /// Weather, time of day and the state of the road.
    Environment,
    /// Lights, animations and visibility.
    Appearance,
    Signals,
    /// Conditions of the stop trigger that are not read.
    Stop,
    /// Distances across, and other distances and arrivals that are not read.
    Distances,
    /// Routes that are not read: actors take the straightest way.
    Routes,
    /// Trailers, and what tows them.
    Trailers,
    /// Actions of a simulator's own.
    Custom,
}

impl Part {
    /// All parts, with their names.
    pub const ALL: [(Self, &str); 10] = [
        (Self::Controllers, "controllers"),
        (Self::Ego, "ego"),
        (Self::Environment, "environment"),
        (Self::Appearance, "appearance"),
        (Self::Signals, "signals"),
        (Self::Stop, "stop"),
        (Self::Distances, "distances"),
        (Self::Routes, "routes"),
        (Self::Trailers, "trailers"),
        (Self::Custom, "custom"),
    ];

    /// The name of the part, as messages have it.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(part, _)| *part == self).map_or("", |(_, name)| name)
    }
}

/// Attributes that cannot matter, by the elements that have them.
const HARMLESS: [(&str, &[&str]); 27] = [
    ("*", &["name"]),
    ("OpenSCENARIO", &["noNamespaceSchemaLocation", "schemaLocation"]),
    ("FileHeader", &["author", "date", "description"]),
    ("License", &["name", "resource", "spdxId"]),
    ("ParameterDeclaration", &["parameterType"]),
    ("VariableDeclaration", &["parameterType", "variableType", "value"]),
    ("SceneGraphFile", &["filepath"]),
    // How a vehicle looks, and its mass: nothing here pushes.
    ("Vehicle", &["model3d", "mass", "role"]),
    ("Pedestrian", &["model", "model3d", "mass", "pedestrianCategory", "role"]),
    ("MiscObject", &["model3d", "mass", "miscObjectCategory", "role"]),
    // Every vehicle is a rigid box on the ground.
    ("FrontAxle", &["maxSteering", "wheelDiameter", "trackWidth", "positionX", "positionZ"]),
    ("RearAxle", &["maxSteering", "wheelDiameter", "trackWidth", "positionZ"]),
    ("AdditionalAxle", &["maxSteering", "wheelDiameter", "trackWidth", "positionX", "positionZ"]),
    // Where a trailer would be: none is read.
    ("TrailerHitch", &["dx", "dz"]),
    ("TrailerCoupler", &["dx", "dz"]),
    ("Property", &["name", "value"]),
    ("File", &["filepath"]),
    ("Directory", &["path"]),
    ("VehicleCatalog", &[]),
    ("Trajectory", &["name"]),
    ("Route", &["name"]),
    // Limits for controllers; actions have their own dynamics.
    ("Performance", &["maxAccelerationRate", "maxDecelerationRate"]),
    // A hint for a driver; a route is followed on lanes.
    ("Waypoint", &[]),
    ("Catalog", &["name"]),
    ("ParameterAssignment", &["parameterRef", "value"]),
    ("UsedArea", &[]),
    ("RoadNetwork", &[]),
];

/// Elements whose content cannot matter.
const HARMLESS_ELEMENTS: [&str; 7] = [
    "License",
    "Properties",
    "SceneGraphFile",
    "Axles",
    "FileHeader",
    "VariableDeclarations",
    "CatalogLocations",
];

/// What has been read of all files.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    elements: RefCell<HashSet<(usize, NodeId)>>,
    attributes: RefCell<HashSet<(usize, NodeId, usize)>>,
    left_out: RefCell<HashSet<(usize, NodeId)>>,
    notes: RefCell<Vec<String>>,
    /// The parts that are left out.
    pub(super) leave_out: BTreeSet<Part>,
}

impl Ledger {
    pub(super) fn new(leave_out: BTreeSet<Part>) -> Self {
        Self { leave_out, ..Self::default() }
    }

    pub(super) fn element(&self, file: usize, node: Node<'_, '_>) {
        self.elements.borrow_mut().insert((file, node.id()));
    }

    pub(super) fn attribute(&self, file: usize, node: Node<'_, '_>, index: usize) {
        self.attributes.borrow_mut().insert((file, node.id(), index));
    }

    pub(super) fn leave_out(&self, file: usize, node: Node<'_, '_>) {
        self.left_out.borrow_mut().insert((file, node.id()));
    }

    /// Tells something that a person should know.
    pub(super) fn note(&self, note: String) {
        let mut notes = self.notes.borrow_mut();
        // An element that is read for each actor of a group tells the same several times.
        if !notes.contains(&note) {
            notes.push(note);
        }
    }

    pub(super) fn notes(&self) -> Vec<String> {
        self.notes.borrow().clone()
    }

    /// Refuses the first element below a node, or the first attribute, that was not read.
    pub(super) fn check(
        &self,
        file: (usize, &str),
        node: Node<'_, '_>,
    ) -> Result<(), ConvertError> {
        let key = (file.0, node.id());
        // With all that is below it.
        if self.left_out.borrow().contains(&key) {
            return Ok(());
        }
        let name = node.tag_name().name();
        let place = || {
            let line = node.document().text_pos_at(node.range().start).row;
            ConvertError::new(format!("{}line {line}, <{name}>", file.1), String::new())
        };
        if !self.elements.borrow().contains(&key) {
            let message = "is not read here; remove it".to_owned();
            return Err(ConvertError { message, ..place() });
        }
        for (index, attribute) in node.attributes().enumerate() {
            let is_read = self.attributes.borrow().contains(&(file.0, node.id(), index));
            if !is_read && !is_harmless(name, attribute.name()) {
                let key = attribute.name();
                let value = attribute.value();
                let message = format!("{key}={value:?} is not read here; remove the attribute");
                return Err(ConvertError { message, ..place() });
            }
        }
        // Its own attributes were checked; what is below it does not matter.
        if HARMLESS_ELEMENTS.contains(&name) {
            return Ok(());
        }
        node.children().filter(Node::is_element).try_for_each(|child| self.check(file, child))
    }
}

fn is_harmless(element: &str, attribute: &str) -> bool {
    HARMLESS.iter().any(|(name, attributes)| {
        (*name == "*" || *name == element) && attributes.contains(&attribute)
    })
}
