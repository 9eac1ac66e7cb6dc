//! The line of a scenario, which a record needs to be judged later.

use std::collections::BTreeSet;

use glam::{DVec2, DVec3};

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_sim::map::{AreaKind, LaneKind, LaneSurface, Map, SurfacePoint};
use wildcity_sim::scenario::{EgoStart, Scenario};

use crate::lines::{ActorLine, EgoLine, GroundPoint, LaneLine, RoutePoint, ScenarioLine};

/// Distance between two points of a route that was not driven, in metres.
const SPACING_M: f64 = 2.0;
/// Lanes farther than this from every point of the route are left out, in metres.
const LANES_M: f64 = 60.0;

/// The line of a resolved scenario. `hash` is its identity, `drives` are those of the twin.
pub fn scenario_line(
    resolved: &Scenario,
    map: Option<&Map>,
    hash: &str,
    drives: &[Trajectory],
) -> ScenarioLine {
    let start = DriveStart::new(resolved, drives);
    // The scenario's own limit, or else the time that the recorded car took from there.
    let limit_us = resolved.end.time_us.or(start.as_ref().map(DriveStart::left_us));
    let mut way = Vec::new();
    let route = match (&start, limit_us) {
        (Some(start), _) => start.route(limit_us),
        (None, Some(limit_us)) => {
            let share_us = |share: f64| (share * limit_us as f64) as i64;
            let points = planned_route(resolved).into_iter();
            points.map(|(share, place_m)| RoutePoint(share_us(share), place_m)).collect()
        }
        (None, None) => {
            way = planned_route(resolved).into_iter().map(|(_, place_m)| place_m).collect();
            Vec::new()
        }
    };
    let places_m: Vec<[f64; 3]> =
        route.iter().map(|point: &RoutePoint| point.1).chain(way.iter().copied()).collect();
    let least_progress = resolved.file.verdict.progress;
    let actors = resolved.traffic.actors.iter();
    ScenarioLine {
        name: resolved.file.name.clone(),
        hash: hash.to_owned(),
        // Texts, numbers and lists: this cannot fail.
        scenario: serde_json::to_value(&resolved.file).unwrap_or_default(),
        ego: EgoLine::new(&resolved.traffic.ego_box),
        actors: actors.map(|actor| ActorLine::new(&actor.spec)).collect(),
        lanes: map.map_or(Vec::new(), |map| lanes(map, &places_m)),
        ground: map.map_or(Vec::new(), |map| ground_lines(map.surface())),
        route,
        way,
        limit_us,
        least_progress: least_progress.unwrap_or(wildcity_score::own::LEAST_PROGRESS),
        // A scenario that does not say it has the contact looked for.
        checks_static: resolved.file.verdict.twin_contact != Some(false),
    }
}

fn ground_lines(surface: &LaneSurface) -> Vec<Vec<GroundPoint>> {
    let point = |point: &SurfacePoint| GroundPoint {
        at: point.position_m.to_array(),
        up: point.up.to_array(),
    };
    surface.lines().map(|line| line.iter().map(point).collect()).collect()
}

/// The road of a line of a scenario; `None` without a map.
pub fn ground_surface(line: &ScenarioLine) -> Option<LaneSurface> {
    let point = |point: &GroundPoint| SurfacePoint {
        position_m: DVec3::from_array(point.at),
        up: DVec3::from_array(point.up),
    };
    let lines = line.ground.iter().map(|line| line.iter().map(point).collect());
    (!line.ground.is_empty()).then(|| LaneSurface::from_lines(lines))
}

/// The place on a recorded drive where an episode starts.
#[derive(Clone, Debug)]
pub struct DriveStart<'a> {
    pub drive: &'a Trajectory,
    /// Its time at the start of the episode, in microseconds.
    pub start_us: i64,
}

impl<'a> DriveStart<'a> {
    /// The drive that an episode starts on, or for a start at a pose the drive that is the route,
    /// from the place nearest to this pose on. `None` if the route of such a start is no drive, or
    /// the twin has no drive.
    pub fn new(resolved: &Scenario, drives: &'a [Trajectory]) -> Option<Self> {
        let named = |name: &str| drives.iter().find(|drive| drive.name == name);
        let (drive, station_m) = match &resolved.start {
            Some(EgoStart::Pose(pose)) => {
                let section = resolved.file.route.as_ref()?;
                let course = &resolved.route.as_ref()?.course;
                let drive = named(section.trajectory.as_deref()?)?;
                (drive, course.nearest(pose.position_m).station_m)
            }
            Some(EgoStart::Station { trajectory, station_m }) => (named(trajectory)?, *station_m),
            None => {
                // The warm-up is the part of the drive before the start.
                let drive = drives.first()?;
                let first_us = drive.keyframes.first()?.time_us;
                let start_us = first_us.saturating_add(resolved.warm_up_us.unwrap_or(0));
                return Some(Self { drive, start_us });
            }
        };
        let start_us = Route::new(drive).ok()?.at(station_m).time_us;
        Some(Self { drive, start_us })
    }

    /// Time from the start to the end of the drive, in microseconds.
    pub fn left_us(&self) -> i64 {
        self.drive.keyframes.last().map_or(0, |last| last.time_us - self.start_us)
    }

    /// The pose of the drive at a time of the episode; constant beyond the ends of the drive.
    pub fn pose_at(&self, time_us: i64) -> Pose {
        pose_at(self.drive, self.start_us.saturating_add(time_us))
    }

    /// The drive from the start on, as long as the episode may take.
    fn route(&self, limit_us: Option<i64>) -> Vec<RoutePoint> {
        let end_us = limit_us.unwrap_or(i64::MAX).min(self.left_us()).max(0);
        let at = |time_us: i64| RoutePoint(time_us, self.pose_at(time_us).position_m.to_array());
        // Both ends are interpolated poses, and the keyframes lie strictly between them, so that
        // times rise strictly.
        let times_us = self.drive.keyframes.iter().map(|key| key.time_us - self.start_us);
        let between = times_us.filter(|time_us| (1..end_us).contains(time_us));
        let mut route: Vec<RoutePoint> = std::iter::once(0).chain(between).map(at).collect();
        if end_us > 0 {
            route.push(at(end_us));
        }
        route
    }
}

/// The pose of a drive at one of its times; constant beyond its ends.
pub fn pose_at(drive: &Trajectory, time_us: i64) -> Pose {
    let keys = &drive.keyframes;
    // Keyframes below `after` are earlier than the time; the one at `after` is not.
    let after = keys.partition_point(|key| key.time_us < time_us);
    match (after.checked_sub(1).map(|before| &keys[before]), keys.get(after)) {
        (None, Some(first)) => first.world_from_rig,
        (Some(last), None) => last.world_from_rig,
        // An exact keyframe is returned as it is, because an interpolation may round its last
        // digits.
        (Some(_), Some(to)) if to.time_us == time_us => to.world_from_rig,
        (Some(from), Some(to)) => {
            // Here from < time < to, so that the divisor is positive and t is between 0 and 1.
            let t = (time_us - from.time_us) as f64 / (to.time_us - from.time_us) as f64;
            from.world_from_rig.interpolate(&to.world_from_rig, t)
        }
        (None, None) => Pose::IDENTITY,
    }
}

/// A route that was not driven, from where the episode starts: the share of the way to each point,
/// by which it is due evenly over the time of the scenario, and its place in metres.
fn planned_route(resolved: &Scenario) -> Vec<(f64, [f64; 3])> {
    let Some(route) = &resolved.route else { return Vec::new() };
    let course = &route.course;
    let begin_m = match &resolved.start {
        Some(EgoStart::Pose(pose)) => course.nearest(pose.position_m).station_m,
        // A start along a drive has the drive in place of a planned route.
        Some(EgoStart::Station { .. }) | None => 0.0,
    };
    let way_m = course.length_m() - begin_m;
    let count = (way_m / SPACING_M).ceil().max(1.0) as i64;
    let point = |k: i64| {
        let share = k as f64 / count as f64;
        (share, course.point_m(begin_m + share * way_m).to_array())
    };
    (0..=count).map(point).collect()
}

/// The lanes and areas of a map near the places of a route, in metres.
fn lanes(map: &Map, route: &[[f64; 3]]) -> Vec<LaneLine> {
    let places_m: Vec<DVec2> = route.iter().map(|[x, y, _]| DVec2::new(*x, *y)).collect();
    // Most points of a large map are outside of these bounds.
    let least_m = places_m.iter().copied().fold(DVec2::INFINITY, DVec2::min) - LANES_M;
    let most_m = places_m.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max) + LANES_M;
    let is_near = |point: &[f64; 2]| {
        let point_m = DVec2::from_array(*point);
        point_m.cmpge(least_m).all()
            && point_m.cmple(most_m).all()
            && places_m.iter().any(|place_m| place_m.distance(point_m) < LANES_M)
    };
    let on_route: BTreeSet<usize> =
        places_m.iter().flat_map(|place_m| map.lanes_at(*place_m)).collect();
    let flat = |point: &[f64; 3]| [point[0], point[1]];
    let file = map.file();
    let driving = file.lanes.iter().enumerate().filter(|(_, lane)| lane.kind == LaneKind::Driving);
    let of_lanes = driving.map(|(index, lane)| {
        // One border forward and the other one backward: a ring around the lane.
        let outline = lane.left.iter().chain(lane.right.iter().rev()).map(flat).collect();
        let center = lane.center.iter().map(flat).collect();
        let route = on_route.contains(&index);
        LaneLine { outline, center, route, intersection: lane.intersection }
    });
    let of_areas = file.areas.iter().filter_map(|area| {
        let intersection = match area.kind {
            AreaKind::Drivable => false,
            AreaKind::Intersection => true,
            // Other areas are not for cars.
            _ => return None,
        };
        let outline = area.outline.iter().map(flat).collect();
        Some(LaneLine { outline, center: Vec::new(), route: false, intersection })
    });
    of_lanes.chain(of_areas).filter(|lane| lane.outline.iter().any(is_near)).collect()
}
