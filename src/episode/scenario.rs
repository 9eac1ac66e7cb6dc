//! The line of a scenario, which a record needs to be judged later.

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
    let route = match &start {
        Some(start) => start.route(limit_us),
        None => planned_route(resolved, limit_us),
    };
    let least_progress = resolved.file.verdict.progress;
    let actors = resolved.traffic.actors.iter();
    ScenarioLine {
        name: resolved.file.name.clone(),
        hash: hash.to_owned(),
        // Texts, numbers and lists: this cannot fail.
        scenario: serde_json::to_value(&resolved.file).unwrap_or_default(),
        ego: EgoLine::new(&resolved.traffic.ego_box),
        actors: actors.map(|actor| ActorLine::new(&actor.spec)).collect(),
        lanes: map.map_or(Vec::new(), |map| lanes(map, &route)),
        ground: map.map_or(Vec::new(), |map| ground_lines(map.surface())),
        route,
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
    /// The drive that an episode starts on; `None` if it starts at a pose, or the twin has no
    /// drive.
    pub fn new(resolved: &Scenario, drives: &'a [Trajectory]) -> Option<Self> {
        let (drive, station_m) = match &resolved.start {
            Some(EgoStart::Pose(_)) => return None,
            Some(EgoStart::Station { trajectory, station_m }) => {
                (drives.iter().find(|drive| drive.name == *trajectory)?, *station_m)
            }
            None => (drives.first()?, 0.0),
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

/// A route that was not driven: due evenly over the time of the scenario.
fn planned_route(resolved: &Scenario, limit_us: Option<i64>) -> Vec<RoutePoint> {
    // A point of a route has a time at which it is due. Without a limit there is none.
    let (Some(route), Some(limit_us)) = (&resolved.route, limit_us) else { return Vec::new() };
    let length_m = route.course.length_m();
    // Rounded up, so that points are at most `SPACING_M` apart. `max` keeps both ends of a route of
    // length 0.
    let count = (length_m / SPACING_M).ceil().max(1.0) as i64;
    let point = |k: i64| {
        let share = k as f64 / count as f64;
        let place_m = route.course.point_m(share * length_m);
        RoutePoint((share * limit_us as f64) as i64, place_m.to_array())
    };
    (0..=count).map(point).collect()
}

/// The lanes and areas of a map near a route.
fn lanes(map: &Map, route: &[RoutePoint]) -> Vec<LaneLine> {
    // Each point of an outline against each point of the route, once for an episode.
    let near = |outline: &[[f64; 2]]| {
        outline.iter().any(|[x, y]| {
            route.iter().any(|point| (point.1[0] - x).hypot(point.1[1] - y) < LANES_M)
        })
    };
    let flat = |point: &[f64; 3]| [point[0], point[1]];
    let file = map.file();
    let driving = file.lanes.iter().enumerate().filter(|(_, lane)| lane.kind == LaneKind::Driving);
    let of_lanes = driving.map(|(index, lane)| {
        // One border forward and the other one backward: a ring around the lane.
        let outline = lane.left.iter().chain(lane.right.iter().rev()).map(flat).collect();
        let is_on = |point: &RoutePoint| {
            let place_m = DVec2::new(point.1[0], point.1[1]);
            map.lanes_at(place_m).any(|at| at == index)
        };
        let center = lane.center.iter().map(flat).collect();
        let route = route.iter().any(is_on);
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
    of_lanes.chain(of_areas).filter(|lane| near(&lane.outline)).collect()
}
