//! The contacts of the ego with actors, sub-step by sub-step.

use glam::DVec2;

use super::body::Body;
use super::fault::{FaultInput, LanePosition, is_ego_at_fault};
use super::sweep::{Moving, overlap_s};
use super::CollisionType;

/// A faster motion within a sub-step is a teleport, in m/s: it is not swept, only its end is looked at.
pub const MAX_SWEPT_SPEED_MPS: f64 = 60.0;

/// The ego over a sub-step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoMotion {
    /// Its box at the begin.
    pub from: Body,
    /// Its box at the end.
    pub to: Body,
    /// Its reference point at the end, the rear axle, in metres.
    pub origin_m: DVec2,
    /// Its velocity at the end, in m/s.
    pub velocity_mps: DVec2,
}

/// An actor over a sub-step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActorMotion {
    /// Its index in the scenario.
    pub index: u16,
    /// Its box at the begin.
    pub from: Body,
    /// Its box at the end.
    pub to: Body,
    /// Its velocity at the end, in m/s.
    pub velocity_mps: DVec2,
    /// Whether it moves by itself: a vehicle, a bicycle or a pedestrian.
    pub is_agent: bool,
}

/// The begin of a contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// The actor.
    pub actor: u16,
    /// When it began, in seconds since the begin of the sub-step.
    pub after_s: f64,
    /// Whether the boxes overlapped when the episode began. Such a contact is reported and not judged.
    pub at_start: bool,
    /// The kind of contact.
    pub kind: CollisionType,
    /// Whether the ego is at fault (`wildcity.fault@1`).
    pub ego_at_fault: bool,
    /// Unit vector from the ego to the actor, along the axis on which they touched last.
    pub normal: DVec2,
    /// Speed against each other, in m/s.
    pub impact_mps: f64,
    /// The ego's velocity, in m/s.
    pub ego_velocity_mps: DVec2,
    /// The actor's velocity, in m/s.
    pub actor_velocity_mps: DVec2,
}

/// Finds where contacts begin.
///
/// A contact begins when two boxes touch that did not touch in the sub-step before. While they stay in contact,
/// nothing more is reported.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Detector {
    /// Actors that touch the ego now, by rising index.
    touching: Vec<u16>,
}

impl Detector {
    /// A detector at the begin of an episode, and the contacts of boxes that overlap already.
    pub fn at_start(ego: &EgoMotion, actors: &[ActorMotion]) -> (Self, Vec<Contact>) {
        let touches = |actor: &&ActorMotion| ego.to.touches(&actor.to);
        let contacts: Vec<Contact> = actors
            .iter()
            .filter(touches)
            .map(|actor| Contact { at_start: true, ..contact(ego, actor, 0.0, None) })
            .collect();
        let mut touching: Vec<u16> = contacts.iter().map(|contact| contact.actor).collect();
        touching.sort_unstable();
        (Self { touching }, contacts)
    }

    /// The contacts that begin in a sub-step of `step_s` seconds, in the order of the actors.
    ///
    /// Between the begin and the end of a sub-step centres move straight; the headings are those of the end.
    pub fn advance(
        &mut self,
        ego: &EgoMotion,
        actors: &[ActorMotion],
        step_s: f64,
        lanes: Option<LanePosition>,
    ) -> Vec<Contact> {
        let mut touching = Vec::new();
        let mut begun = Vec::new();
        for actor in actors {
            let touched_before = self.touching.binary_search(&actor.index).is_ok();
            if let Some(after_s) = touch_s(ego, actor, step_s)
                && !touched_before
            {
                begun.push(contact(ego, actor, after_s, lanes));
            }
            if ego.to.touches(&actor.to) {
                touching.push(actor.index);
            }
        }
        touching.sort_unstable();
        self.touching = touching;
        begun
    }
}

/// When two boxes touch within a sub-step, in seconds since its begin; `None` if they do not.
fn touch_s(ego: &EgoMotion, actor: &ActorMotion, step_s: f64) -> Option<f64> {
    let at_end = ego.to.touches(&actor.to).then_some(step_s);
    let ego_way_m = ego.to.footprint.center_m - ego.from.footprint.center_m;
    let actor_way_m = actor.to.footprint.center_m - actor.from.footprint.center_m;
    let fastest_m = ego_way_m.length().max(actor_way_m.length());
    if step_s <= 0.0 || fastest_m > MAX_SWEPT_SPEED_MPS * step_s {
        return at_end;
    }
    // Heights change little in 10 ms: the ranges over the sub-step are compared.
    let spans = |from: &Body, to: &Body| Body {
        bottom_m: from.bottom_m.min(to.bottom_m),
        top_m: from.top_m.max(to.top_m),
        ..*to
    };
    if !spans(&ego.from, &ego.to).is_level_with(&spans(&actor.from, &actor.to)) {
        return at_end;
    }
    let moving = |to: &Body, way_m: DVec2| Moving {
        footprint: to.footprint.shifted(-way_m),
        velocity_mps: way_m / step_s,
    };
    let overlap = overlap_s(&moving(&ego.to, ego_way_m), &moving(&actor.to, actor_way_m));
    match overlap {
        Some([first_s, last_s]) if first_s <= step_s && last_s >= 0.0 => Some(first_s.max(0.0)),
        _ => at_end,
    }
}

fn contact(
    ego: &EgoMotion,
    actor: &ActorMotion,
    after_s: f64,
    lanes: Option<LanePosition>,
) -> Contact {
    let input = FaultInput {
        ego: ego.to.footprint,
        ego_origin_m: ego.origin_m,
        ego_velocity_mps: ego.velocity_mps,
        other: actor.to.footprint,
        other_velocity_mps: actor.velocity_mps,
        other_is_agent: actor.is_agent,
    };
    // Of the end: in 10 ms boxes get at most 1.2 m into each other, and the axis of least depth is the one on
    // which they met.
    let (_, normal) = ego.to.footprint.widest_axis(&actor.to.footprint);
    Contact {
        actor: actor.index,
        after_s,
        at_start: false,
        kind: CollisionType::of(&input),
        ego_at_fault: is_ego_at_fault(&input, normal, lanes),
        normal,
        impact_mps: (ego.velocity_mps - actor.velocity_mps).length(),
        ego_velocity_mps: ego.velocity_mps,
        actor_velocity_mps: actor.velocity_mps,
    }
}
