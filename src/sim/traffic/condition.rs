//! Conditions with parts, edges and delays, and the values that they measure.

use std::collections::VecDeque;

use glam::DVec3;

use super::course::Course;
use super::lead::LeadCandidate;
use super::script::{Body, Condition, Edge, Measure, Other, Quantity};

/// Least speed by which a headway is divided, in m/s.
const HEADWAY_MPS: f64 = 1e-3;

/// The values of a condition and of its parts so far.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct ConditionState {
    /// The last value of the parts.
    last: Option<bool>,
    /// Since when the parts have held, in microseconds.
    since_us: Option<i64>,
    /// The values at the instants at which they changed, oldest first: as far back as the
    /// condition's delay.
    changes: VecDeque<(i64, bool)>,
    parts: Vec<ConditionState>,
}

impl ConditionState {
    /// The value of a condition at a time, with a function that evaluates its own parts without
    /// `all` and `any`.
    ///
    /// Every part is evaluated, because a part with an edge or a delay remembers its values.
    pub(super) fn value(
        &mut self,
        condition: &Condition,
        time_us: i64,
        own: &dyn Fn(&Condition) -> bool,
    ) -> bool {
        let count = condition.all.len() + condition.any.len();
        // States are made at the first evaluation. The list is in the order of `all`, then `any`.
        self.parts.resize_with(count, Self::default);
        let (all, any) = self.parts.split_at_mut(condition.all.len());
        let mut holds = own(condition);
        for (state, part) in all.iter_mut().zip(&condition.all) {
            holds &= state.value(part, time_us, own);
        }
        // An empty `any` is no restriction.
        let mut holds_any = condition.any.is_empty();
        for (state, part) in any.iter_mut().zip(&condition.any) {
            holds_any |= state.value(part, time_us, own);
        }
        // Held, edge and delay apply to the whole: a part has its own.
        self.delayed(condition, time_us, holds && holds_any)
    }

    /// The value after the edge and the delay.
    fn delayed(&mut self, condition: &Condition, time_us: i64, value: bool) -> bool {
        // The time of the first evaluation at which the parts held, as long as they do.
        self.since_us = value.then(|| self.since_us.unwrap_or(time_us));
        let since_us = self.since_us;
        let value = since_us.is_some_and(|since_us| time_us - since_us >= condition.held_us);
        let last = self.last.replace(value);
        let value = match condition.edge {
            None => value,
            // The first evaluation has no last value, so it is no edge.
            Some(Edge::Rising) => value && last == Some(false),
            Some(Edge::Falling) => !value && last == Some(true),
            Some(Edge::Both) => last.is_some_and(|last| last != value),
        };
        if condition.later_us == 0 {
            return value;
        }
        // Only changes are stored. An edge is true for one evaluation, so it is two changes.
        if self.changes.back().is_none_or(|(_, before)| *before != value) {
            self.changes.push_back((time_us, value));
        }
        let then_us = time_us.saturating_sub(condition.later_us);
        // Invariant: the front is the last change at or before the delayed time, or the oldest of
        // all if there is none.
        while self.changes.get(1).is_some_and(|(at_us, _)| *at_us <= then_us) {
            self.changes.pop_front();
        }
        // Before the first change is `later_us` old, the delayed condition does not hold.
        self.changes.front().is_some_and(|(at_us, value)| *at_us <= then_us && *value)
    }
}

/// The bodies of an instant, by which a condition measures.
pub(super) struct Measures<'a> {
    /// The ego first, then all present actors.
    pub(super) bodies: &'a [LeadCandidate],
    /// The distances driven: by the ego, then by each actor, in metres.
    pub(super) travelled_m: &'a [f64],
    /// The course of the actor whose condition it is.
    pub(super) course: Option<&'a Course>,
}

impl Measures<'_> {
    /// Whether a value is within its bounds; a body that is absent has no values.
    pub(super) fn holds(&self, measure: &Measure) -> bool {
        self.value(measure).is_some_and(|value| {
            measure.above.is_none_or(|least| value >= least)
                && measure.below.is_none_or(|most| value <= most)
        })
    }

    fn value(&self, measure: &Measure) -> Option<f64> {
        let of = &measure.of;
        // An absent body ends the measure: no bound holds then, neither `above` nor `below`.
        let body = self.body(of)?;
        match measure.quantity {
            Quantity::Speed => Some(body.velocity_mps.length()),
            Quantity::Travelled => {
                // The ego has index 0, so the actors are shifted by one.
                self.travelled_m.get(of.actor.map_or(0, |actor| actor + 1)).copied()
            }
            Quantity::Point(point_m) => Some(reference_m(body, of).distance(point_m)),
            Quantity::Distance(other) => self.distance_m(body, of, other),
            Quantity::Longitudinal(other) => self.along_m(body, of, other, true),
            Quantity::Lateral(other) => self.along_m(body, of, other, false),
            Quantity::TimeToCollision(other) => self.time_to_collision_s(body, of, other),
            Quantity::Headway(other) => {
                let way_m = if other.is_straight {
                    self.distance_m(body, of, other)?
                } else {
                    self.along_m(body, of, other, true)?
                };
                // A body that stands has a very large headway and not an infinite one.
                Some(way_m / body.velocity_mps.length().max(HEADWAY_MPS))
            }
        }
    }

    fn body(&self, body: &Body) -> Option<&LeadCandidate> {
        LeadCandidate::find(self.bodies, body.actor)
    }

    /// The distance by the rate at which it becomes less, in seconds.
    fn time_to_collision_s(&self, body: &LeadCandidate, of: &Body, other: Other) -> Option<f64> {
        let to = self.body(&other.to)?;
        // Between the middles, also where the distance is between reference points.
        let way_m = to.center_m - body.center_m;
        let (distance_m, direction) = if other.is_straight {
            (self.distance_m(body, of, other)?, way_m.normalize_or_zero())
        } else {
            let forward = body.forward();
            // Closing is along the heading, forwards or backwards, depending on where the other is.
            let sign = if way_m.dot(forward) < 0.0 { -1.0 } else { 1.0 };
            (self.along_m(body, of, other, true)?, sign * forward)
        };
        let closing_mps = (body.velocity_mps - to.velocity_mps).dot(direction);
        // Infinite and not absent: `above` then holds for bodies that separate.
        Some(if closing_mps > 0.0 { distance_m / closing_mps } else { f64::INFINITY })
    }

    /// The straight distance, in metres.
    fn distance_m(&self, body: &LeadCandidate, of: &Body, other: Other) -> Option<f64> {
        let to = self.body(&other.to)?;
        Some(if other.is_free {
            body.gap_m(to)
        } else {
            reference_m(body, of).distance(reference_m(to, &other.to))
        })
    }

    /// The distance along, or across, in metres without a sign.
    fn along_m(
        &self,
        body: &LeadCandidate,
        of: &Body,
        other: Other,
        is_along: bool,
    ) -> Option<f64> {
        let to = self.body(&other.to)?;
        let from_m = reference_m(body, of);
        let to_m = reference_m(to, &other.to);
        // The course is used only if it was asked for. An actor without one falls back to the
        // heading.
        let (forward, way_m) = match self.course.filter(|_| other.is_on_course) {
            Some(course) => {
                let from = course.nearest(from_m);
                let to = course.nearest(to_m);
                let forward = course.at(from.station_m).rotation * DVec3::X;
                let way_m =
                    if is_along { to.station_m - from.station_m } else { to.left_m - from.left_m };
                (forward, way_m)
            }
            None => {
                let forward = body.forward();
                let axis = if is_along { forward } else { DVec3::Z.cross(forward) };
                (forward, (to_m - from_m).dot(axis))
            }
        };
        if !other.is_free {
            return Some(way_m.abs());
        }
        // Boxes: the distance of the middles on this axis, less half the extent of both.
        let axis = if is_along { forward } else { DVec3::Z.cross(forward) };
        // The middles of the boxes are not at the reference points.
        let shift_m = (to.center_m - to_m - (body.center_m - from_m)).dot(axis);
        let half_m = body.half_extent_m(axis) + to.half_extent_m(axis);
        Some(((way_m + shift_m).abs() - half_m).max(0.0))
    }
}

fn reference_m(body: &LeadCandidate, of: &Body) -> DVec3 {
    body.center_m + of.ahead_m * body.forward()
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::Pose;

    use super::*;
    use crate::traffic::{ActorSpec, ActorState};

    fn part(edge: Option<Edge>, later_us: i64) -> Condition {
        Condition { edge, later_us, ..Condition::default() }
    }

    /// The values of a condition whose parts have these values, one each second.
    fn values<const N: usize>(condition: &Condition, parts: [bool; N]) -> [bool; N] {
        let mut state = ConditionState::default();
        let mut time_us = -1_000_000;
        parts.map(|value| {
            time_us += 1_000_000;
            state.value(condition, time_us, &|_| value)
        })
    }

    #[test]
    fn edges_are_instants_and_the_first_evaluation_is_none() {
        let parts = [true, true, false, true, true, false];
        let rising = values(&part(Some(Edge::Rising), 0), parts);
        assert_eq!(rising, [false, false, false, true, false, false]);
        let falling = values(&part(Some(Edge::Falling), 0), parts);
        assert_eq!(falling, [false, false, true, false, false, true]);
        let both = values(&part(Some(Edge::Both), 0), parts);
        assert_eq!(both, [false, false, true, true, false, true]);
    }

    #[test]
    fn a_delay_repeats_the_values_later() {
        let parts = [true, false, true, true, false, false, false];
        let later = values(&part(None, 2_000_000), parts);
        assert_eq!(later, [false, false, true, false, true, true, false]);
        let rising = values(&part(Some(Edge::Rising), 1_000_000), parts);
        assert_eq!(rising, [false, false, false, true, false, false, false]);
    }

    #[test]
    fn a_break_starts_the_time_again() {
        let held = Condition { held_us: 2_000_000, ..Condition::default() };
        let parts = [true, true, false, true, true, true, true];
        // Two seconds after 0 s would be at 2 s, but the break there starts again at 3 s.
        assert_eq!(values(&held, parts), [false, false, false, false, false, true, true]);
    }

    #[test]
    fn parts_hold_all_or_any() {
        let leaf = |time_us| Condition { time_us: Some(time_us), ..Condition::default() };
        let value = |condition: &Condition| {
            let own = |part: &Condition| part.time_us.is_none_or(|time_us| time_us <= 5);
            ConditionState::default().value(condition, 0, &own)
        };
        let all = |parts: Vec<Condition>| Condition { all: parts, ..Condition::default() };
        let any = |parts: Vec<Condition>| Condition { any: parts, ..Condition::default() };
        assert!(value(&all(vec![leaf(1), leaf(5)])) && !value(&all(vec![leaf(1), leaf(6)])));
        assert!(value(&any(vec![leaf(1), leaf(6)])) && !value(&any(vec![leaf(6), leaf(7)])));
        assert!(value(&any(vec![all(vec![leaf(6)]), all(vec![leaf(2)])])));
    }

    /// A body of 4 m x 2 m along x, at a place and a speed.
    fn car(actor: u16, [x, y]: [f64; 2], speed_mps: f64) -> LeadCandidate {
        let spec = ActorSpec {
            name: "car".into(),
            class: wildcity_scene::ActorClass::Vehicle,
            box_: wildcity_scene::ActorBox { length_m: 4.0, width_m: 2.0, height_m: 1.5 },
            asset: None,
        };
        let state = ActorState {
            index: actor,
            world_from_actor: Pose { position_m: DVec3::new(x, y, 0.0), ..Pose::IDENTITY },
            velocity_mps: speed_mps * DVec3::X,
            yaw_rate_radps: 0.0,
            present: true,
        };
        LeadCandidate::from_actor(&spec, &state)
    }

    #[test]
    fn measures_are_between_reference_points_or_boxes() {
        let bodies = [car(0, [0.0, 0.0], 10.0), car(1, [30.0, 4.0], 6.0)];
        let measures = Measures { bodies: &bodies, travelled_m: &[1.0, 2.0, 3.0], course: None };
        // The reference points are 1 m and 2 m behind the middles.
        let [of, to] =
            [(0, -1.0), (1, -2.0)].map(|(actor, ahead_m)| Body { actor: Some(actor), ahead_m });
        let value = |quantity: Quantity| {
            measures.value(&Measure { quantity, of, above: None, below: None }).unwrap()
        };
        let other = |is_free, is_straight| Other { to, is_free, is_on_course: false, is_straight };
        let near =
            |found: f64, wanted: f64| assert!((found - wanted).abs() < 1e-9, "{found} {wanted}");
        near(value(Quantity::Speed), 10.0);
        near(value(Quantity::Travelled), 2.0);
        near(value(Quantity::Point(DVec3::new(-1.0, 3.0, 0.0))), 3.0);
        // Between -1 and 28 along x, and from box to box between 2 and 28.
        near(value(Quantity::Distance(other(false, false))), 29.0_f64.hypot(4.0));
        near(value(Quantity::Distance(other(true, false))), 26.0_f64.hypot(2.0));
        near(value(Quantity::Longitudinal(other(false, false))), 29.0);
        near(value(Quantity::Longitudinal(other(true, false))), 26.0);
        near(value(Quantity::Lateral(other(false, false))), 4.0);
        near(value(Quantity::Lateral(other(true, false))), 2.0);
        // 26 m at 10 m/s.
        near(value(Quantity::Headway(other(true, false))), 2.6);
        // 26 m at 10 - 6 m/s.
        near(value(Quantity::TimeToCollision(other(true, false))), 6.5);
        // There is no actor 7, so even a bound that every speed meets does not hold.
        let absent = Body { actor: Some(7), ahead_m: 0.0 };
        let speed =
            Measure { quantity: Quantity::Speed, of: absent, above: Some(0.0), below: None };
        assert!(!measures.holds(&speed));
    }
}
