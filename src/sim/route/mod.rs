//! The route that the ego should drive: the next points, navigation commands, and progress.

use glam::DVec3;

use wildcity_scene::geometry::Pose;

use crate::limits;
use crate::scenario::NavigationCommand;
use crate::traffic::Course;

/// Distance between two points of the route that an observation shows, in metres: 20 points over 80
/// m, as in AlpaSim.
const POINT_SPACING_M: f64 = 80.0 / 19.0;

/// Time for which a command looks ahead, in seconds, and the least speed for it, in m/s (NeuroNCAP,
/// `model_api.py`).
const COMMAND_AHEAD_S: f64 = 3.0;
const COMMAND_SPEED_MPS: f64 = 2.0;

/// Lateral distance from which on the route ahead counts as a turn, in metres (NeuroNCAP).
const TURN_M: f64 = 2.0;

/// Default distance before its place at which a command is given, in metres.
pub const COMMAND_AHEAD_M: f64 = 50.0;

/// A route with its navigation commands.
#[derive(Clone, Debug, PartialEq)]
pub struct NavigationRoute {
    /// The line to drive.
    pub course: Course,
    /// The commands, by rising station.
    pub commands: Vec<RouteCommand>,
}

/// A command at its place.
#[derive(Clone, Debug, PartialEq)]
pub struct RouteCommand {
    /// Where it must be carried out, in metres along the route.
    pub station_m: f64,
    pub command: NavigationCommand,
    /// Its text; `{m}` stands for the distance in metres.
    pub text: Option<String>,
    /// Distance before its place at which it is given, in metres.
    pub ahead_m: f64,
}

/// The progress of the ego on its route.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RouteProgress {
    /// The nearest place, in metres along the route.
    pub station_m: f64,
    /// Distance from the route, in metres.
    pub off_m: f64,
    /// The largest station that the ego has reached, in metres.
    pub farthest_m: f64,
    /// Where the episode began, in metres.
    pub begin_m: f64,
}

/// The route in an observation.
#[derive(Clone, Debug, PartialEq)]
pub struct RouteView {
    /// Up to 20 points in the rig's frame, in metres: from the route's nearest point to the ego on,
    /// 80/19 m apart.
    pub points_m: Vec<DVec3>,
    pub command: NavigationCommand,
    /// The text of the command, if the route has one.
    pub text: Option<String>,
}

impl NavigationRoute {
    /// The ego's place at the start of an episode.
    pub fn begin(&self, world_from_rig: &Pose) -> RouteProgress {
        let beside = self.course.nearest(world_from_rig.position_m);
        RouteProgress {
            station_m: beside.station_m,
            off_m: beside.distance_m,
            farthest_m: beside.station_m,
            begin_m: beside.station_m,
        }
    }

    /// The ego's place after it moved. The search stays near the previous place, so that no part of
    /// a route that crosses itself is skipped. Only an ego that is far from this part is searched
    /// for on the whole route.
    pub fn after(&self, before: &RouteProgress, world_from_rig: &Pose) -> RouteProgress {
        let point_m = world_from_rig.position_m;
        let [back_m, ahead_m] = limits::ROUTE_SEARCH_M;
        let from_m = before.station_m - back_m;
        let to_m = before.station_m + ahead_m;
        // A bounded part first: where a route crosses itself, the nearest point of all may be on
        // another pass.
        let mut beside = self.course.nearest_between(point_m, from_m, to_m);
        if beside.distance_m > limits::ROUTE_LOST_M {
            beside = self.course.nearest(point_m);
        }
        RouteProgress {
            station_m: beside.station_m,
            off_m: beside.distance_m,
            // Never falls, so that driving back or getting lost takes no progress away.
            farthest_m: before.farthest_m.max(beside.station_m),
            begin_m: before.begin_m,
        }
    }

    /// The route as the ego sees it, at a speed in m/s.
    pub fn view(
        &self,
        progress: &RouteProgress,
        world_from_rig: &Pose,
        speed_mps: f64,
    ) -> RouteView {
        let rig_from_world = world_from_rig.inverse();
        let in_rig_m =
            |station_m: f64| rig_from_world.transform_point(self.course.point_m(station_m));
        let length_m = self.course.length_m();
        let stations_m = (0..limits::ROUTE_POINTS)
            .map(|point| progress.station_m + f64::from(point) * POINT_SPACING_M);
        let points_m =
            stations_m.take_while(|station_m| *station_m <= length_m).map(in_rig_m).collect();
        let (command, text) = match self.next_command(progress.station_m) {
            Some((command, text)) => (command, text),
            // A route without commands derives them from its own shape, as NeuroNCAP does.
            None if self.commands.is_empty() => {
                let ahead_m = COMMAND_AHEAD_S * speed_mps.max(COMMAND_SPEED_MPS);
                let point_m = world_from_rig.transform_point(ahead_m * DVec3::X);
                // The point ahead is on a straight line, and the route to it may be a curve: twice
                // the distance covers an arc of up to 3.8 rad, and the slack an ego that is beside
                // the route.
                let to_m = progress.station_m + 2.0 * ahead_m + limits::ROUTE_SEARCH_M[0];
                let beside = self.course.nearest_between(point_m, progress.station_m, to_m);
                (turn(in_rig_m(beside.station_m).y), None)
            }
            // Commands exist, but none is near enough yet.
            None => (NavigationCommand::Straight, None),
        };
        RouteView { points_m, command, text }
    }

    /// The share of the route that was driven since the start, 0 to 1.
    pub fn share(&self, progress: &RouteProgress) -> f64 {
        // An episode that begins in the middle of a route is measured against the rest of it.
        let whole_m = self.course.length_m() - progress.begin_m;
        let driven_m = progress.farthest_m - progress.begin_m;
        // Without a rest there is nothing left to drive. The division would give NaN.
        if whole_m <= 0.0 { 1.0 } else { (driven_m / whole_m).clamp(0.0, 1.0) }
    }

    /// Whether the ego has arrived: more than 99 % of the route driven, and less than 10 m from its
    /// end.
    pub fn is_done(&self, progress: &RouteProgress, world_from_rig: &Pose) -> bool {
        let end_m = self.course.point_m(self.course.length_m());
        self.share(progress) > limits::ROUTE_DONE
            && end_m.distance(world_from_rig.position_m) < limits::ROUTE_END_M
    }

    /// The next command from a station on, if it is near enough, with its text.
    fn next_command(&self, station_m: f64) -> Option<(NavigationCommand, Option<String>)> {
        let next = self.commands.iter().find(|command| command.station_m >= station_m)?;
        let distance_m = next.station_m - station_m;
        if distance_m > next.ahead_m {
            return None;
        }
        let metres = format!("{distance_m:.0}");
        Some((next.command, next.text.as_ref().map(|text| text.replace("{m}", &metres))))
    }
}

/// The command of a route that is `left_m` to the left some way ahead.
pub fn turn(left_m: f64) -> NavigationCommand {
    if left_m > TURN_M {
        NavigationCommand::Left
    } else if left_m < -TURN_M {
        NavigationCommand::Right
    } else {
        NavigationCommand::Straight
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Ground;
    use glam::DQuat;

    /// 100 m to the east, then 100 m to the north.
    fn corner(commands: Vec<RouteCommand>) -> NavigationRoute {
        let points = [DVec3::ZERO, DVec3::X * 100.0, DVec3::new(100.0, 100.0, 0.0)];
        let course = Course::from_points(&points, &Ground::from_drives(&[])).unwrap();
        NavigationRoute { course, commands }
    }

    fn at(x_m: f64, y_m: f64, yaw_rad: f64) -> Pose {
        Pose { position_m: DVec3::new(x_m, y_m, 0.0), rotation: DQuat::from_rotation_z(yaw_rad) }
    }

    #[test]
    fn points_begin_beside_the_ego_and_end_with_the_route() {
        let route = corner(Vec::new());
        let pose = at(40.0, 1.0, 0.0);
        let progress = route.begin(&pose);
        assert_eq!((progress.station_m, progress.off_m), (40.0, 1.0));
        let view = route.view(&progress, &pose, 8.0);
        assert_eq!(view.points_m.len(), 20);
        assert!((view.points_m[0] - DVec3::new(0.0, -1.0, 0.0)).length() < 1e-9);
        // The route has 60 m left to the corner. Of 80 m, 20 m go north, and the ego is 1 m north
        // of the line.
        assert!((view.points_m[19].y - 19.0).abs() < 1e-9, "80 m on: {}", view.points_m[19]);
        let near_end = at(100.0, 90.0, 1.57);
        let progress = route.after(&progress, &near_end);
        assert_eq!(progress.station_m, 190.0);
        // 190 m, 194.2 m and 198.4 m; the route ends at 200 m.
        assert_eq!(route.view(&progress, &near_end, 8.0).points_m.len(), 3);
        assert!(!route.is_done(&progress, &near_end));
        // 99.5 m of 100 m northwards, so 159.5 m of 160 m from the start: more than 99 %.
        let end = at(100.0, 99.5, 1.57);
        assert!(route.is_done(&route.after(&progress, &end), &end));
    }

    #[test]
    fn commands_are_given_before_their_place() {
        let route = corner(Vec::new());
        // 2.1 m off the route, and on it: the lateral offset of the point 15 m ahead decides.
        for (y_m, command) in [
            (-2.1, NavigationCommand::Left),
            (0.0, NavigationCommand::Straight),
            (2.1, NavigationCommand::Right),
        ] {
            let pose = at(20.0, y_m, 0.0);
            assert_eq!(route.view(&route.begin(&pose), &pose, 5.0).command, command);
        }
        let route = corner(vec![RouteCommand {
            station_m: 100.0,
            command: NavigationCommand::Left,
            text: Some("Turn left in {m} m".into()),
            ahead_m: 50.0,
        }]);
        let told = |x_m: f64| {
            let pose = at(x_m, 0.0, 0.0);
            let view = route.view(&route.begin(&pose), &pose, 5.0);
            (view.command, view.text)
        };
        // At 49 m the corner is 51 m away: more than the 50 m at which the command is given.
        assert_eq!(told(49.0), (NavigationCommand::Straight, None));
        let text = Some("Turn left in 30 m".to_owned());
        assert_eq!(told(70.0), (NavigationCommand::Left, text));
    }
}
