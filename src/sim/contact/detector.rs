//! The contacts of the ego with actors, sub-step by sub-step.

use glam::DVec2;

use wildcity_scene::ActorClass;

use super::body::Body;
use super::fault::{CollisionType, FaultInput, LanePosition, is_ego_at_fault};
use super::sweep::{Moving, overlap_s};
use crate::traffic::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};

/// A faster motion within a sub-step is a teleport, in m/s: it is not swept, and only its end is
/// tested.
pub const MAX_SWEPT_SPEED_MPS: f64 = 60.0;

/// The start of a contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Index of the actor's [`ActorSpec`].
    pub actor: u16,
    /// When it began, in microseconds since the episode's start, rounded up.
    pub time_us: i64,
    /// Whether the boxes overlapped when the episode began, or when the actor appeared. Such a
    /// contact is reported and not judged.
    pub at_start: bool,
    /// The kind of contact.
    pub kind: CollisionType,
    /// Whether the ego is at fault (`wildcity.fault@1`).
    pub ego_at_fault: bool,
    /// Unit vector from the ego to the actor, along the axis on which they met.
    pub normal: DVec2,
    /// Relative speed, in m/s.
    pub impact_mps: f64,
    /// The ego's velocity at the end of the sub-step, in m/s.
    pub ego_velocity_mps: DVec2,
    /// The actor's velocity at the end of the sub-step, in m/s.
    pub actor_velocity_mps: DVec2,
}

/// Finds where contacts begin.
///
/// A contact begins when two boxes touch that did not touch at the end of the previous sub-step.
/// While they stay in contact, nothing more is reported.
#[derive(Clone, Debug, PartialEq)]
pub struct Detector {
    ego_box: EgoBox,
    /// Actors that touch the ego now, by rising index.
    touching: Vec<u16>,
}

/// The ego and one actor over a sub-step.
struct Pair<'a> {
    ego: [Body; 2],
    actor: [Body; 2],
    ego_state: &'a EgoState,
    actor_state: &'a ActorState,
    class: ActorClass,
}

impl Detector {
    /// A detector at the start of an episode, and the contacts of boxes that overlap already.
    pub fn at_start(
        ego_box: EgoBox,
        specs: &[ActorSpec],
        ego: &EgoState,
        actors: &[ActorState],
    ) -> (Self, Vec<Contact>) {
        let mut detector = Self { ego_box, touching: Vec::new() };
        // A sub-step without length, before which nothing touched.
        let instant =
            SubStep { begin_us: 0, end_us: 0, ego: [*ego, *ego], before: actors, after: actors };
        let mut contacts = detector.advance(&instant, specs, None);
        for contact in &mut contacts {
            contact.at_start = true;
        }
        (detector, contacts)
    }

    /// The contacts that begin in a sub-step, in the order of the actors. `lanes` is where the
    /// ego's corners lie at its end, if there is a map.
    ///
    /// Within a sub-step, centres move on straight lines and the headings are those at its end. So
    /// every sub-step is decided by itself, and a finer recording of the same motion gives the same
    /// decisions at the same sub-steps.
    pub fn advance(
        &mut self,
        sub_step: &SubStep<'_>,
        specs: &[ActorSpec],
        lanes: Option<LanePosition>,
    ) -> Vec<Contact> {
        let ego = sub_step
            .ego
            .map(|ego| Body::new(&ego.world_from_rig, &self.ego_box.box_, self.ego_box.center_x_m));
        let mut touching = Vec::new();
        let mut begun = Vec::new();
        // Both lists have the same actors in the same order, so one pass pairs them.
        for (before, after) in sub_step.before.iter().zip(sub_step.after) {
            let Some(spec) = specs.get(usize::from(after.index)) else { continue };
            if !after.present {
                continue;
            }
            // An actor that appears has not moved here from anywhere.
            let appears = !before.present;
            let from = if appears { after } else { before };
            let pair = Pair {
                ego,
                actor: [from, after].map(|s| Body::new(&s.world_from_actor, &spec.box_, 0.0)),
                ego_state: &sub_step.ego[1],
                actor_state: after,
                class: spec.class,
            };
            let touched_before = self.touching.binary_search(&after.index).is_ok();
            let step_s = (sub_step.end_us - sub_step.begin_us) as f64 * 1e-6;
            let touch_s = if appears { pair.touch_at_end_s(step_s) } else { pair.touch_s(step_s) };
            if let Some(after_s) = touch_s
                && !touched_before
            {
                // Rounded up, so that the boxes touch at the recorded time. The bound undoes what
                // rounding adds past the end of the sub-step.
                let time_us = sub_step.begin_us + (after_s * 1e6).ceil() as i64;
                let contact = pair.contact(time_us.min(sub_step.end_us), lanes);
                begun.push(Contact { at_start: appears, ..contact });
            }
            // Remembers the end and not the sweep: a box that only passed through has left, and may
            // touch again later.
            if pair.touches_at_end() {
                touching.push(after.index);
            }
        }
        // `binary_search` in the next sub-step needs a sorted list.
        touching.sort_unstable();
        self.touching = touching;
        begun
    }
}

impl Pair<'_> {
    fn touches_at_end(&self) -> bool {
        self.ego[1].touches(&self.actor[1])
    }

    fn touch_at_end_s(&self, step_s: f64) -> Option<f64> {
        self.touches_at_end().then_some(step_s)
    }

    /// When the boxes touch within a sub-step, in seconds since its start; `None` if they do not.
    fn touch_s(&self, step_s: f64) -> Option<f64> {
        let at_end = self.touch_at_end_s(step_s);
        let way_m = |[from, to]: [Body; 2]| to.footprint.center_m - from.footprint.center_m;
        let ego_way_m = way_m(self.ego);
        let actor_way_m = way_m(self.actor);
        // A jump of either body is a teleport. Its speed is compared as a distance, because
        // `step_s` may be 0 at the start.
        let fastest_m = ego_way_m.length().max(actor_way_m.length());
        if step_s <= 0.0 || fastest_m > MAX_SWEPT_SPEED_MPS * step_s {
            return at_end;
        }
        // The sweep is in the plane, so the heights of the whole sub-step decide first whether the
        // bodies can meet.
        if !span(self.ego).is_level_with(&span(self.actor)) {
            return at_end;
        }
        // The sweep counts from the start of the sub-step. So the box at the end, with its heading,
        // is moved back by the whole way.
        let moving = |to: &Body, way_m: DVec2| Moving {
            footprint: to.footprint.shifted(-way_m),
            velocity_mps: way_m / step_s,
        };
        let ego = moving(&self.ego[1], ego_way_m);
        match overlap_s(&ego, &moving(&self.actor[1], actor_way_m)) {
            // The overlap may begin before the sub-step; the contact then begins with it.
            Some([first_s, last_s]) if first_s <= step_s && last_s >= 0.0 => Some(first_s.max(0.0)),
            // The swept boxes miss each other, but rounding may let those at the end touch.
            _ => at_end,
        }
    }

    fn contact(&self, time_us: i64, lanes: Option<LanePosition>) -> Contact {
        let ego_velocity_mps = self.ego_state.velocity_mps.truncate();
        let actor_velocity_mps = self.actor_state.velocity_mps.truncate();
        let ego = self.ego[1].footprint;
        let other = self.actor[1].footprint;
        let input = FaultInput {
            ego,
            ego_origin_m: self.ego_state.world_from_rig.position_m.truncate(),
            ego_velocity_mps,
            other,
            other_velocity_mps: actor_velocity_mps,
            other_is_agent: self.class != ActorClass::Object,
        };
        // In 10 ms boxes get at most 1.2 m into each other, and the axis of least depth is the one
        // on which they met.
        let (_, normal) = ego.widest_axis(&other);
        Contact {
            actor: self.actor_state.index,
            time_us,
            at_start: false,
            kind: CollisionType::classify(&input),
            ego_at_fault: is_ego_at_fault(&input, normal, lanes),
            normal,
            impact_mps: (ego_velocity_mps - actor_velocity_mps).length(),
            ego_velocity_mps,
            actor_velocity_mps,
        }
    }
}

/// The heights that a box reaches over a sub-step.
fn span([from, to]: [Body; 2]) -> Body {
    let bottom_m = from.bottom_m.min(to.bottom_m);
    let top_m = from.top_m.max(to.top_m);
    Body { bottom_m, top_m, ..to }
}
