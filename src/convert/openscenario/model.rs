//! What is known of a scenario while its file is read.

use std::collections::{BTreeMap, BTreeSet};

use wildcity_scene::ActorClass;
use wildcity_sim::scenario::{
    ArriveTogetherSection, ConditionSection, KeepDistanceSection, ProfileSection,
};

use super::catalogs::Catalogs;
use super::roads::{RoadMap, Spot};

/// A place with a heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    pub(super) xyz_m: [f64; 3],
    /// Heading from x towards y, in radians.
    pub(super) yaw_rad: f64,
    /// Where it is on the roads; `None` beside them or across a lane.
    pub(super) spot: Option<Spot>,
}

impl Place {
    /// The place straight ahead, and to the left.
    pub(super) fn shifted(&self, ahead_m: f64, left_m: f64) -> Self {
        // A turn about the vertical: the height stays.
        let (sin, cos) = self.yaw_rad.sin_cos();
        let [x, y, z] = self.xyz_m;
        let xyz_m = [x + ahead_m * cos - left_m * sin, y + ahead_m * sin + left_m * cos, z];
        Self { xyz_m, ..*self }
    }
}

/// An entity while the file is read.
#[derive(Clone, Debug)]
pub(super) struct Entity {
    /// Name in the scenario file.
    pub(super) name: String,
    pub(super) class: ActorClass,
    pub(super) size: [f64; 3],
    /// From the reference point, the middle of the rear axle on the ground, to the box's centre, in
    /// metres forward, to the left and up.
    pub(super) center_m: [f64; 3],
    /// From the reference point forward to the rear axle, in metres.
    pub(super) rear_m: f64,
    pub(super) place: Option<Place>,
    pub(super) begin_mps: f64,
    /// The fastest speed of its actions, in m/s.
    pub(super) fastest_mps: f64,
    /// The lane after the changes that were read so far, as its road numbers it.
    pub(super) lane: Option<i32>,
    /// The trajectory of `Init`.
    pub(super) line: Option<Line>,
    /// The lanes of its route.
    pub(super) route: Vec<xodr::LaneId>,
    pub(super) script: Vec<Draft>,
    pub(super) present: bool,
}

impl Entity {
    /// Whether what was read so far moves it.
    pub(super) fn moves(&self) -> bool {
        let acts = || self.script.iter().flat_map(|draft| &draft.then);
        self.begin_mps > 0.0 || self.line.is_some() || acts().any(Act::is_motion)
    }
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Line {
    pub(super) points: Vec<[f64; 3]>,
    /// Times of the points, in seconds, if they count.
    pub(super) times_s: Option<Vec<f64>>,
    /// Whether it ends where it begins.
    pub(super) is_closed: bool,
}

/// A trigger of an actor before its lines are known.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Draft {
    pub(super) name: String,
    pub(super) when: ConditionSection,
    pub(super) then: Vec<Act>,
}

/// An action of an actor before its lines are known.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Act {
    Speed(ProfileSection),
    /// As fast as an actor, or as the ego.
    Match {
        of: Option<String>,
        factor: f64,
        delta_mps: f64,
    },
    Keep(Box<KeepDistanceSection>),
    Arrive(Box<ArriveTogetherSection>),
    /// To the lane with this id.
    Lane {
        lane: i32,
        offset_m: f64,
        profile: ProfileSection,
    },
    Offset(ProfileSection),
    Trajectory(Line),
    /// At once at another place.
    Place(Place),
    Halt(String),
    Spawn,
    Remove,
}

impl Act {
    /// Whether it moves an actor along its course.
    pub(super) fn is_motion(&self) -> bool {
        !matches!(self, Self::Spawn | Self::Remove | Self::Halt(_))
    }
}

/// The entities, roads and catalogs of a scenario, and the name of the entity that the agent
/// drives.
pub(super) struct Context<'a> {
    pub(super) entities: BTreeMap<String, Entity>,
    pub(super) roads: Option<RoadMap>,
    /// What is added to the x and y of positions in the world, in metres: they are in the frame of
    /// the roads' file, and the roads were moved to the twin's origin.
    pub(super) shift_m: [f64; 2],
    pub(super) catalogs: Catalogs<'a>,
    pub(super) ego: String,
    /// Whether the storyboard's events are read, and not `Init`.
    pub(super) is_in_story: bool,
    /// The entities whose speeds at the start are not read yet.
    pub(super) waiting: Vec<String>,
    /// The entities that others place: trailers, and those of controllers that are left out.
    pub(super) placed_by_others: Vec<(String, super::ledger::Part)>,
    /// The values of variables at the start.
    pub(super) variables: BTreeMap<String, String>,
    /// The parameters and variables that actions set: the name, the value and the event.
    pub(super) sets: Vec<(String, String, String)>,
    /// The minor version of the file: 0 for 1.0.
    pub(super) minor_version: i32,
    /// The entities with controllers of their own.
    pub(super) controlled: BTreeSet<String>,
    /// The line along which the ego goes.
    pub(super) ego_route: Option<Vec<[f64; 3]>>,
    /// Why the roads that the scenario names were not read.
    pub(super) missing_roads: Option<String>,
}

impl Context<'_> {
    /// The name of an entity's actor; `None` for the ego.
    pub(super) fn actor_name(&self, name: &str) -> Option<String> {
        let entity = self.entities.get(name).filter(|_| name != self.ego);
        entity.map(|entity| entity.name.clone())
    }

    /// From the middle of an entity's box forward to its reference point, in metres: the ego's is
    /// its rear axle.
    pub(super) fn ahead_m(&self, name: &str) -> Option<f64> {
        let entity = self.entities.get(name)?;
        Some(-entity.center_m[0])
    }
}
