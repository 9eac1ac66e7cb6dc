//! An episode as the scores see it.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_score::{
    DriveRecord, EgoSample, EgoShape, Lane, LaneMap, NO_MAP, NO_REFERENCE, Plan, PlannedPose,
    Polyline, ReferenceDrive, StaticContact, Track, TrackSample,
};
use wildcity_sim::contact::Body;
use wildcity_sim::ego::{DynamicsModel, TimedPose};

use crate::file::{EpisodeFile, Frame};
use crate::lines::{ActorsLine, Event, ScenarioLine};

/// The numbers of an episode that scores are made of; `None` if it has no frame, or if a request
/// followed a plan for several steps: the record has no poses of the steps between.
pub fn drive_record(episode: &EpisodeFile) -> Option<DriveRecord> {
    let frames = episode.driven();
    let poses: Vec<Pose> = frames.iter().filter_map(|frame| frame.poses.last().copied()).collect();
    let steps: Vec<u64> = frames.iter().map(|frame| frame.step).collect();
    // Scores divide differences of poses by a constant dt, so that a missing step would look like a
    // jump.
    let is_gapless = steps.windows(2).all(|pair| pair[1] == pair[0] + 1);
    if poses.is_empty() || !is_gapless {
        return None;
    }
    let scenario = episode.scenario.as_ref();
    let contacts = episode.events.iter().filter_map(|line| match &line.event {
        Event::Contact(event) => Some(event.contact(line.time_us)),
        _ => None,
    });
    let with_twin: Vec<StaticContact> = episode
        .events
        .iter()
        .filter_map(|line| match line.event {
            Event::StaticContact { impact_mps, .. } => {
                Some(StaticContact { time_us: line.time_us, impact_mps })
            }
            _ => None,
        })
        .collect();
    // A record without a scenario does not say whether contact with the twin was looked for; a
    // contact says it.
    let checks_static =
        scenario.is_some_and(|scenario| scenario.checks_static) || !with_twin.is_empty();
    Some(DriveRecord {
        dt_us: episode.header.dt_us,
        shape: scenario.map(|scenario| EgoShape {
            length_m: scenario.ego.size[0],
            width_m: scenario.ego.size[1],
            center_x_m: scenario.ego.center_x,
        }),
        ego: ego_samples(&poses, episode.header.dt_us as f64 * 1e-6),
        is_driven: episode.header.dynamics.model != DynamicsModel::Teleport,
        tracks: scenario.map(|scenario| tracks(scenario, &episode.actors, &steps)),
        plans: plans(&frames),
        contacts: contacts.collect(),
        static_contacts: checks_static.then_some(with_twin),
        reference: scenario.and_then(reference),
        no_reference: scenario.map_or(NO_REFERENCE, no_reference),
        limit_us: scenario.and_then(|scenario| scenario.limit_us),
        map: scenario.and_then(lanes),
        no_map: scenario.map_or(NO_MAP, no_map),
        least_progress: scenario
            .map_or(wildcity_score::own::LEAST_PROGRESS, |scenario| scenario.least_progress),
        off_model_us: off_model_us(episode),
    })
}

/// When the ego first left the trained area, in microseconds. A record without events has no time
/// of this, so that the start is returned.
pub fn off_model_us(episode: &EpisodeFile) -> Option<i64> {
    let event = episode.events.iter().find(|line| matches!(line.event, Event::OffModel { .. }));
    let at_end = episode.end.as_ref().is_some_and(|end| end.outcome == "off_model");
    event.map(|line| line.time_us).or(at_end.then_some(0))
}

/// The ego from its poses: velocities and accelerations are differences over two steps, at the ends
/// over one.
pub(crate) fn ego_samples(poses: &[Pose], step_s: f64) -> Vec<EgoSample> {
    let places: Vec<DVec2> = poses.iter().map(|pose| pose.position_m.truncate()).collect();
    // `atan2` jumps by 2π where the yaw passes ±π, and a difference over the jump would be a rate
    // of 2π per step. `turned` counts the jumps, so that neighbours differ by at most π.
    let mut turned = 0.0;
    let mut before: Option<f64> = None;
    let yaws: Vec<f64> = poses
        .iter()
        .map(|pose| {
            let forward = pose.rotation * DVec3::X;
            let yaw = forward.y.atan2(forward.x);
            if let Some(before) = before {
                turned += ((yaw - before) / std::f64::consts::TAU).round_ties_even();
            }
            before = Some(yaw);
            yaw - std::f64::consts::TAU * turned
        })
        .collect();
    // Each derivative is the difference of the one above it: an acceleration depends on poses of up
    // to two steps before and after.
    let velocities = slopes(&places, step_s);
    let accelerations = slopes(&velocities, step_s);
    let rates = slopes(&yaws, step_s);
    let yaw_accelerations = slopes(&rates, step_s);
    (0..poses.len())
        .map(|k| {
            // Scores judge comfort along the axes of the car, x forward.
            let to_car = DVec2::from_angle(-yaws[k]);
            EgoSample {
                origin_m: places[k],
                yaw_rad: yaws[k],
                velocity_mps: to_car.rotate(velocities[k]),
                acceleration_mps2: to_car.rotate(accelerations[k]),
                yaw_rate_radps: rates[k],
                yaw_acceleration_radps2: yaw_accelerations[k],
            }
        })
        .collect()
}

/// Central differences per second, one-sided at both ends.
fn slopes<T>(values: &[T], step_s: f64) -> Vec<T>
where
    T: Copy + std::ops::Sub<Output = T> + std::ops::Div<f64, Output = T>,
{
    // The callers refuse an empty list, so that this does not underflow.
    let last = values.len() - 1;
    let slope = |k: usize| {
        // Two steps apart inside, one step at the ends. A single value is its own neighbour: the
        // difference is 0, and `max` keeps the divisor from being 0 as well.
        let from = k.saturating_sub(1);
        let to = (k + 1).min(last);
        (values[to] - values[from]) / ((to - from).max(1) as f64 * step_s)
    };
    (0..values.len()).map(slope).collect()
}

/// The plans of the agent, each decided at the frame before the last frame of its step.
fn plans(frames: &[&Frame]) -> Vec<Plan> {
    let Some(begin_us) = frames.first().map(|first| first.time_us) else { return Vec::new() };
    let of_pair = |pair: &[&Frame]| {
        // The command of a frame was decided on what the frame before it showed. Time and place of
        // the plan are therefore those of the first of the pair.
        let decided_us = pair[0].time_us - begin_us;
        let world_from_start = pair[0].poses.last()?;
        // An agent sends only the poses to come. The present one is put in front, so that the plan
        // begins where the ego is.
        let now = TimedPose { time_us: 0, start_from_rig: Pose::IDENTITY };
        let own = std::iter::once(now).chain(pair[1].plan()?);
        let poses = own.map(|TimedPose { time_us, start_from_rig }| {
            let world_from_rig = *world_from_start * start_from_rig;
            let forward = world_from_rig.rotation * DVec3::X;
            PlannedPose {
                // An agent may send any time; an overflow must not panic.
                time_us: decided_us.saturating_add(time_us),
                origin_m: world_from_rig.position_m.truncate(),
                yaw_rad: forward.y.atan2(forward.x),
            }
        });
        Plan::new(poses.collect())
    };
    frames.windows(2).filter_map(of_pair).collect()
}

fn tracks(scenario: &ScenarioLine, lines: &[ActorsLine], steps: &[u64]) -> Vec<Track> {
    // If a session returned to an earlier state, and in a warm-up, a step has several lines: use
    // the last one.
    let of_step: BTreeMap<u64, &ActorsLine> = lines.iter().map(|line| (line.step, line)).collect();
    let mut tracks: Vec<Track> = scenario
        .actors
        .iter()
        .map(|actor| Track {
            name: actor.name.clone(),
            class: actor.class,
            samples: vec![None; steps.len()],
        })
        .collect();
    // A sample stays `None` where the actor is absent at that step.
    for (k, step) in steps.iter().enumerate() {
        let Some(line) = of_step.get(step) else { continue };
        for state in line.actors.iter().filter_map(|state| state.state()) {
            let index = usize::from(state.index);
            let found = tracks.get_mut(index).zip(scenario.actors.get(index));
            let Some((track, actor)) = found else { continue };
            track.samples[k] = Some(TrackSample {
                footprint: Body::new(&state.world_from_actor, &actor.actor_box(), 0.0).footprint,
                velocity_mps: state.velocity_mps.truncate(),
            });
        }
    }
    tracks
}

fn reference(scenario: &ScenarioLine) -> Option<ReferenceDrive> {
    let points = scenario.route.iter().map(|point| DVec2::new(point.1[0], point.1[1]));
    let line = Polyline::new(points.collect())?;
    Some(ReferenceDrive { line, times_us: scenario.route.iter().map(|point| point.0).collect() })
}

/// Why a scenario without a drive to follow has none.
fn no_reference(scenario: &ScenarioLine) -> &'static str {
    if scenario.way.is_empty() {
        NO_REFERENCE
    } else {
        "nothing says when the ego is due on the route: add end.time_s"
    }
}

/// Why a scenario without lanes in its record has none.
fn no_map(scenario: &ScenarioLine) -> &'static str {
    let has_map = scenario.scenario.get("map").is_some_and(|map| !map.is_null());
    let has_route = !scenario.route.is_empty() || !scenario.way.is_empty();
    match (has_map, has_route) {
        (false, _) => NO_MAP,
        (true, false) => "no route says which lanes of the map are near: add route",
        (true, true) => "no lane of the map is near the route",
    }
}

fn lanes(scenario: &ScenarioLine) -> Option<LaneMap> {
    if scenario.lanes.is_empty() {
        return None;
    }
    let centerline = match reference(scenario) {
        Some(reference) => reference.line,
        None => Polyline::new(
            scenario.way.iter().map(|point| DVec2::new(point[0], point[1])).collect(),
        )?,
    };
    let lanes = scenario.lanes.iter().map(|lane| Lane {
        center: Polyline::new(lane.center.iter().map(|&point| DVec2::from_array(point)).collect()),
        outline_m: lane.outline.iter().map(|&point| DVec2::from_array(point)).collect(),
        is_on_route: lane.route,
        is_intersection: lane.intersection,
    });
    // The lines of a record have no traffic lights.
    Some(LaneMap { lanes: lanes.collect(), centerline, red: Vec::new() })
}
