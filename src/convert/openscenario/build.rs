//! The actors and the ego of a scenario, after its file is read.

use glam::DVec2;

use wildcity_options::{Dynamics, DynamicsModel};
use wildcity_sim::limits;
use wildcity_sim::scenario::{
    ActionSection, ActorSection, CollideSection, CourseSection, EgoBoxSection, EgoSection,
    PathSection, PoseSection, ProfileSection, ShapeSection, StartSection, TimedPosition,
    TriggerSection,
};

use super::lane_line::LaneLine;
use super::ledger::Ledger;
use super::model::{Act, Context, Draft, Entity, Line, Place};
use super::roads::Spot;
use super::simplify::simplified;

/// A scenario without an end is prepared for this time, in seconds.
const USUAL_S: f64 = 300.0;

/// No line is longer than this, in metres.
const LONGEST_M: f64 = 20_000.0;

/// The shortest line ahead of an actor, in metres.
const SHORTEST_M: f64 = 100.0;

/// The ego, which starts where its entity does.
pub(super) fn ego_section(ego: &Entity, ledger: &Ledger) -> EgoSection {
    // The ego's pose is that of its rear axle.
    let pose = ego.place.map(|place| pose_section(&place.shifted(ego.rear_m, 0.0)));
    let start =
        pose.map(|pose| StartSection { trajectory: None, station_m: None, pose: Some(pose) });
    let dynamics = Dynamics { model: DynamicsModel::Dynamic, speed: ego.begin_mps, reverse: false };
    if ego.center_m[1].abs() > 0.01 {
        let name = &ego.name;
        ledger.note(format!("entity {name:?}: the ego's box is in the middle of its axles"));
    }
    EgoSection {
        start,
        dynamics: Some(dynamics),
        box_: Some(EgoBoxSection { size: ego.size, center_x: ego.center_m[0] - ego.rear_m }),
        ..EgoSection::default()
    }
}

fn pose_section(place: &Place) -> PoseSection {
    PoseSection { xyz: place.xyz_m, yaw_rad: Some(place.yaw_rad), q: None }
}

/// Builds the actors of a scenario.
pub(super) struct Builder<'b, 'a> {
    pub(super) context: &'b Context<'a>,
    pub(super) ledger: &'b Ledger,
    /// When the scenario ends, in seconds, if it does.
    pub(super) end_s: Option<f64>,
}

/// An actor while its script is built.
struct Drive<'e> {
    entity: &'e Entity,
    place: Place,
    length_m: f64,
    /// The lanes on which it drives, and the spot at which they begin.
    lanes: Option<(Spot, LaneLine)>,
}

impl Builder<'_, '_> {
    /// An actor: on its trajectory, through timed positions, standing, along its lane, or straight
    /// on.
    pub(super) fn actor_section(&self, entity: &Entity) -> Result<ActorSection, String> {
        let place = entity
            .place
            .or_else(|| first_place(entity.line.as_ref()?))
            .ok_or("has no position in <Init>; add a <TeleportAction>")?;
        let time_s = self.end_s.unwrap_or(USUAL_S);
        let fastest_mps = entity.fastest_mps.max(entity.begin_mps);
        // As far as the actor can come until the end. Of a standing actor, 100 m are left for its
        // events.
        let length_m = (fastest_mps * time_s + SHORTEST_M).min(LONGEST_M);
        let mut actor = ActorSection {
            name: entity.name.clone(),
            class: Some(entity.class),
            size: Some(entity.size),
            present: (!entity.present).then_some(false),
            ..ActorSection::default()
        };
        let mut drive = Drive { entity, place, length_m, lanes: None };
        let moves = entity.script.iter().flat_map(|draft| &draft.then).any(Act::is_motion);
        match &entity.line {
            Some(Line { points, times_s: Some(times_s), .. }) => {
                if moves {
                    return Err(
                        "has timed positions and events that move it; keep one of them".into()
                    );
                }
                actor.collide = Some(self.timed(entity, &place, points, times_s));
            }
            Some(line) => {
                let (points, _) = self.continued(&mut drive, line)?;
                actor.path = Some(PathSection {
                    points: Some(points),
                    // The reference point follows the line; the box's centre is ahead of it.
                    station_m: entity.center_m[0].max(0.0),
                    offset_m: some_offset(entity.center_m[1]),
                    speed: entity.begin_mps,
                    ..PathSection::default()
                });
            }
            // It never moves, so that a pose is enough.
            None if entity.begin_mps == 0.0 && !moves => {
                let [ahead_m, left_m, _] = entity.center_m;
                actor.stand = Some(pose_section(&place.shifted(ahead_m, left_m)));
            }
            None => actor.path = Some(self.ahead(&mut drive)?),
        }
        let triggers: Result<Vec<TriggerSection>, String> =
            entity.script.iter().map(|draft| self.trigger_section(draft, &mut drive)).collect();
        actor.script = triggers?;
        let count = actor.script.len();
        if count > limits::TRIGGERS {
            return Err(format!("has {count} actions; at most {} are accepted", limits::TRIGGERS));
        }
        Ok(actor)
    }

    fn note(&self, entity: &Entity, message: &str) {
        self.ledger.note(format!("entity {:?}: {message}", entity.name));
    }

    /// Timed positions of the box's middle, which is ahead of the reference point of the file's
    /// points.
    fn timed(
        &self,
        entity: &Entity,
        place: &Place,
        points: &[[f64; 3]],
        times_s: &[f64],
    ) -> CollideSection {
        if self.end_s.is_none_or(|end_s| times_s.last().is_some_and(|last_s| *last_s < end_s)) {
            self.note(entity, "stands at the end of its timed trajectory");
        }
        let [ahead_m, left_m, _] = entity.center_m;
        let mut yaw_rad = place.yaw_rad;
        let last = points.len().saturating_sub(1);
        let positions = points.iter().zip(times_s).enumerate().map(|(index, (xyz, time_s))| {
            // It faces the next point, and at the last one as before. One that stands keeps its
            // heading.
            let next = points[(index + 1).min(last)];
            let way = [next[0] - xyz[0], next[1] - xyz[1]];
            if way[0].hypot(way[1]) > 1e-3 {
                yaw_rad = way[1].atan2(way[0]);
            }
            let at = Place { xyz_m: *xyz, yaw_rad, spot: None };
            TimedPosition { time_s: *time_s, xyz: at.shifted(ahead_m, left_m).xyz_m }
        });
        CollideSection {
            positions: Some(positions.collect()),
            yaw_rad: Some(place.yaw_rad),
            ..CollideSection::default()
        }
    }

    /// The path along the lane, or straight on.
    fn ahead(&self, drive: &mut Drive<'_>) -> Result<PathSection, String> {
        let Drive { entity, place, length_m, .. } = *drive;
        let [ahead_m, left_m, _] = entity.center_m;
        // The path begins at the box's middle, which is this far from the reference point.
        let lanes =
            self.context.roads.as_ref().zip(place.spot).map(|(roads, spot)| {
                (spot, roads.line(spot, length_m + ahead_m.abs(), &entity.route))
            });
        // Less than two points are no line.
        let Some((spot, line)) = lanes.filter(|(_, line)| line.points.len() >= 2) else {
            if let Some(reason) = &self.context.missing_roads {
                return Err(format!("drives on roads that were not read: {reason}"));
            }
            if self.context.roads.is_some() {
                self.note(entity, "is on no lane in its direction: it moves straight on");
            }
            let from = place.shifted(ahead_m, left_m);
            return Ok(PathSection {
                points: Some(vec![from.xyz_m, from.shifted(length_m, 0.0).xyz_m]),
                speed: entity.begin_mps,
                ..PathSection::default()
            });
        };
        self.note_forks(entity, &line);
        // An offset to the left of the road is to the right of an actor that drives against s.
        let offset_m = side(spot) * spot.at.offset + left_m;
        let path = PathSection {
            points: Some(line.points.clone()),
            // The station of a box behind the reference point would be negative, which no path has.
            station_m: ahead_m.max(0.0).min(line_length_m(&line.points)),
            offset_m: some_offset(offset_m),
            speed: entity.begin_mps,
            ..PathSection::default()
        };
        drive.lanes = Some((spot, line));
        Ok(path)
    }

    fn note_forks(&self, entity: &Entity, line: &LaneLine) {
        if !line.forks.is_empty() {
            let roads = line.forks.join("; ");
            self.note(entity, &format!("takes the straightest way at forks: {roads}"));
        }
        // Within 1 m, because a simplified line is a little shorter.
        if line.is_cut && line_length_m(&line.points) + 1.0 >= LONGEST_M {
            self.note(entity, "stands after 20 km");
        }
    }

    /// A trajectory that goes on as the lane does at its end, and the length of the trajectory
    /// itself, in metres.
    fn continued(
        &self,
        drive: &mut Drive<'_>,
        line: &Line,
    ) -> Result<(Vec<[f64; 3]>, f64), String> {
        let mut points = line.points.clone();
        let length_m = line_length_m(&points);
        let [.., before, last] = points.as_slice() else {
            return Err("has a trajectory of less than two points".into());
        };
        // The direction of the last piece decides with which lane it goes on.
        let way = [last[0] - before[0], last[1] - before[1]];
        let last = *last;
        let yaw_rad = way[1].atan2(way[0]);
        let place = Place { xyz_m: last, yaw_rad, spot: None };
        let roads = self.context.roads.as_ref();
        let spot = roads.and_then(|roads| roads.spot(roads.lane_near(last)?, yaw_rad));
        // The lanes from before the trajectory are left in any case.
        drive.lanes = None;
        match roads.zip(spot) {
            Some((roads, spot)) => {
                let lanes = roads.line(spot, drive.length_m, &drive.entity.route);
                self.note_forks(drive.entity, &lanes);
                let left_m = side(spot) * spot.at.offset;
                // The lanes begin where the trajectory ends, so that their first point is there
                // already.
                points.extend(moved_left(&lanes.points, left_m).into_iter().skip(1));
                drive.lanes = Some((spot, lanes));
            }
            None => {
                points.push(place.shifted(drive.length_m, 0.0).xyz_m);
            }
        }
        Ok((points, length_m))
    }

    fn trigger_section(
        &self,
        draft: &Draft,
        drive: &mut Drive<'_>,
    ) -> Result<TriggerSection, String> {
        let mut then = Vec::new();
        let left_m = drive.entity.center_m[1];
        for act in &draft.then {
            match act {
                Act::Speed(profile) => then.push(ActionSection::SpeedProfile(*profile)),
                Act::Match { of, factor, delta_mps } => then.push(ActionSection::SpeedMatch {
                    of: of.clone(),
                    factor: (*factor != 1.0).then_some(*factor),
                    delta: (*delta_mps != 0.0).then_some(*delta_mps),
                }),
                Act::Keep(section) => then.push(ActionSection::KeepDistance((**section).clone())),
                Act::Arrive(section) => {
                    then.push(ActionSection::ArriveTogether((**section).clone()))
                }
                Act::Offset(profile) => {
                    // A file's offset is to the left of the road, the scenario's to the left of the
                    // actor.
                    let sign = drive.lanes.as_ref().map_or(1.0, |(spot, _)| side(*spot));
                    let to = sign * profile.to + left_m;
                    then.push(ActionSection::OffsetProfile(ProfileSection { to, ..*profile }));
                }
                Act::Lane { lane, offset_m, profile } => {
                    let Some((roads, (spot, line))) =
                        self.context.roads.as_ref().zip(drive.lanes.as_ref())
                    else {
                        return Err(format!("changes to lane {lane}, but is on no lane"));
                    };
                    let target = roads.line_of_lane(
                        line,
                        *spot,
                        *lane,
                        (drive.length_m, &drive.entity.route),
                    )?;
                    let sign = side(*spot);
                    let spot = *spot;
                    let points = target.points.clone();
                    // First the course changes, and then the offset, which is relative to the new
                    // course.
                    then.push(ActionSection::Path(CourseSection {
                        points: Some(points),
                        ..CourseSection::default()
                    }));
                    let to = sign * offset_m + left_m;
                    then.push(ActionSection::OffsetProfile(ProfileSection { to, ..*profile }));
                    self.note_forks(drive.entity, &target);
                    drive.lanes = Some((spot, target));
                }
                Act::Place(place) => {
                    drive.place = *place;
                    let path = self.ahead(drive)?;
                    then.push(ActionSection::Path(CourseSection {
                        points: path.points,
                        at_m: Some(path.station_m),
                        ..CourseSection::default()
                    }));
                    // It is at the new place at once, and does not drive there.
                    then.push(step_aside(path.offset_m.unwrap_or(0.0)));
                }
                Act::Trajectory(Line { times_s: Some(_), .. }) => {
                    let message =
                        "follows a trajectory with times in an event; use <None> as time reference";
                    return Err(message.into());
                }
                Act::Trajectory(line) => {
                    let (points, length_m) = self.continued(drive, line)?;
                    let most_m = line_length_m(&points);
                    // It begins at the first point, wherever the actor is.
                    let ahead_m = drive.entity.center_m[0].max(0.0);
                    then.push(ActionSection::Path(CourseSection {
                        points: Some(points),
                        at_m: Some(ahead_m.min(most_m)),
                        done_m: Some(length_m.min(most_m)),
                        ..CourseSection::default()
                    }));
                    then.push(step_aside(left_m));
                }
                Act::Halt(trigger) => then.push(ActionSection::Halt { trigger: trigger.clone() }),
                Act::Spawn => then.push(ActionSection::Spawn {}),
                Act::Remove => then.push(ActionSection::Remove {}),
            }
        }
        // An act makes two actions at most. More come from the events that it ends.
        if then.len() > limits::ACTIONS {
            let most = limits::ACTIONS;
            return Err(format!(
                "ends more than {most} events by the priority of {:?}",
                draft.name
            ));
        }
        Ok(TriggerSection { name: Some(draft.name.clone()), when: draft.when.clone(), then })
    }
}

/// At once at another offset.
fn step_aside(to: f64) -> ActionSection {
    ActionSection::OffsetProfile(ProfileSection {
        to,
        shape: ShapeSection::Step,
        over_s: None,
        over_m: None,
        rate: None,
        acceleration: None,
    })
}

/// Offsets of a file are to the left of the road; those of an actor are to its own left.
fn side(spot: Spot) -> f64 {
    if spot.is_up { 1.0 } else { -1.0 }
}

fn some_offset(offset_m: f64) -> Option<f64> {
    (offset_m != 0.0).then_some(offset_m)
}

fn first_place(line: &Line) -> Option<Place> {
    let [first, second, ..] = line.points.as_slice() else { return None };
    let yaw_rad = (second[1] - first[1]).atan2(second[0] - first[0]);
    Some(Place { xyz_m: *first, yaw_rad, spot: None })
}

fn line_length_m(points: &[[f64; 3]]) -> f64 {
    let flat = |point: &[f64; 3]| DVec2::new(point[0], point[1]);
    points.windows(2).map(|pair| flat(&pair[0]).distance(flat(&pair[1]))).sum()
}

/// The line so far to the left.
fn moved_left(points: &[[f64; 3]], left_m: f64) -> Vec<[f64; 3]> {
    let last = points.len().saturating_sub(1);
    let moved = (0..points.len()).map(|index| {
        // The direction at a point is that from the point before to the point after.
        let from = points[index.saturating_sub(1)];
        let to = points[(index + 1).min(last)];
        let ahead = DVec2::new(to[0] - from[0], to[1] - from[1]).normalize_or_zero();
        let [x, y, z] = points[index];
        [x - left_m * ahead.y, y + left_m * ahead.x, z]
    });
    simplified(&moved.collect::<Vec<_>>())
}
