//! Where actors were: at the ends of past steps, and between them.

use std::collections::VecDeque;
use std::sync::Arc;

use wildcity_scene::geometry::Pose;
use wildcity_sim::traffic::ActorState;

/// The actors at the ends of past steps, by rising time in microseconds; the last is now. Copies
/// share the states.
#[derive(Clone, Debug, Default)]
pub(crate) struct ActorPast(VecDeque<(i64, Arc<[ActorState]>)>);

impl ActorPast {
    /// Adds the actors at a time, in microseconds, later than those before.
    pub(crate) fn push(&mut self, time_us: i64, states: &[ActorState]) {
        self.0.push_back((time_us, states.into()));
    }

    /// Drops the states that no time from `time_us` on needs.
    pub(crate) fn drop_before(&mut self, time_us: i64) {
        // The first state is needed until the second one is early enough to interpolate from.
        while self.0.len() > 1 && self.0[1].0 <= time_us {
            self.0.pop_front();
        }
    }

    /// The last `count` of them, or as many as there are, by rising time.
    pub(crate) fn last(&self, count: usize) -> impl Iterator<Item = (i64, &[ActorState])> {
        let first = self.0.len().saturating_sub(count);
        self.0.range(first..).map(|(time_us, states)| (*time_us, &**states))
    }

    /// The pose of each actor at a time, by its index; `None` for one that is absent. Between two
    /// steps an actor is present if it is present at both ends. Before the first time and after the
    /// last one, its pose is that at this time.
    pub(crate) fn poses_at(&self, time_us: i64) -> Vec<Option<Pose>> {
        let after = self.0.partition_point(|(past_us, _)| *past_us < time_us);
        // After the last time, the last states. Without any states there is no actor.
        let Some((to_us, to)) = self.0.get(after).or(self.0.back()) else { return Vec::new() };
        let before = after.checked_sub(1).map(|before| &self.0[before]);
        // Exact at the end of a step: interpolation could round.
        let Some((from_us, from)) = before.filter(|_| *to_us > time_us) else {
            return poses(to);
        };
        // Here from < time < to.
        let t = (time_us - from_us) as f64 / (to_us - from_us) as f64;
        let between = from.iter().zip(to.iter()).map(|(from, to)| {
            let from = pose(from)?;
            let to = pose(to)?;
            // An actor that stands stays exactly where it is.
            Some(if from == to { to } else { from.interpolate(&to, t) })
        });
        between.collect()
    }
}

/// The pose of each actor, by its index.
pub(crate) fn poses(states: &[ActorState]) -> Vec<Option<Pose>> {
    states.iter().map(pose).collect()
}

fn pose(state: &ActorState) -> Option<Pose> {
    state.present.then_some(state.world_from_actor)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn states(x_m: Option<f64>) -> Vec<ActorState> {
        vec![ActorState {
            index: 0,
            world_from_actor: Pose { position_m: DVec3::X * x_m.unwrap_or(0.0), ..Pose::IDENTITY },
            velocity_mps: DVec3::ZERO,
            yaw_rate_radps: 0.0,
            present: x_m.is_some(),
        }]
    }

    #[test]
    fn actors_are_where_they_were() {
        let mut past = ActorPast::default();
        assert_eq!(past.poses_at(0), []);
        for (time_us, x_m) in [(0, Some(1.0)), (100, Some(3.0)), (200, None), (300, Some(7.0))] {
            past.push(time_us, &states(x_m));
        }
        let x_m = |past: &ActorPast, time_us| past.poses_at(time_us)[0].map(|p| p.position_m.x);
        let all = [-5, 0, 25, 100, 150, 200, 250, 300, 999].map(|time_us| x_m(&past, time_us));
        // 25 is a quarter of the way from 1 m to 3 m. At 150 and 250 the actor is absent at one
        // end.
        let wanted =
            [Some(1.0), Some(1.0), Some(1.5), Some(3.0), None, None, None, Some(7.0), Some(7.0)];
        assert_eq!(all, wanted);
        past.drop_before(99);
        assert_eq!(x_m(&past, 50), Some(2.0), "the step before is still needed");
        past.drop_before(100);
        assert_eq!(x_m(&past, 50), Some(3.0));
        past.drop_before(5_000);
        assert_eq!(x_m(&past, 0), Some(7.0), "the last is never dropped");
    }
}
