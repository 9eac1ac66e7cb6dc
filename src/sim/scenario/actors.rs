//! The actors of a scenario, from their sections.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::{ActorBox, ActorClass};

use super::around::{AssetInfo, EgoStart, Surroundings, drive_named, points_of};
use super::error::{FileError, in_range, listed, named};
use super::file::{
    ActionSection, ActorSection, AttackSection, CollideSection, ConditionSection, IdmModel,
    IdmSection, JitterDraw, PathSection, ScenarioFile,
};
use super::jitter::{displaced, displacement_m, drawn, heading_rad};
use super::pose::pose_of;
use super::tracks::{TrackSection, box_of};
use crate::traffic::{
    Action, Actor, ActorSpec, After, Attack, Behaviour, Condition, Course, Follow, Idm, Near,
    Track, TrackKeyframe, Trigger,
};
use crate::{Ground, limits};

/// Time between two ticks of HUGSIM, in microseconds, and the number of ticks between two plans.
const TICK_US: i64 = 250_000;
const PLAN_TICKS: u32 = 3;

/// The lines of a scenario; each recorded drive is one course, which its actors share.
pub(super) struct Courses<'a> {
    around: &'a Surroundings<'a>,
    drives: BTreeMap<(String, bool), Arc<Course>>,
}

impl<'a> Courses<'a> {
    pub(super) fn new(around: &'a Surroundings<'a>) -> Self {
        Self { around, drives: BTreeMap::new() }
    }

    /// The line of a recorded drive, points or lanes, of which exactly one is given. `field` names the drive's field.
    pub(super) fn line(
        &mut self,
        field: &str,
        along: Option<&str>,
        points: Option<&[[f64; 3]]>,
        lanes: Option<&[String]>,
        reverse: bool,
    ) -> Result<Arc<Course>, FileError> {
        let none = || "leads nowhere: it needs two places at least 1 cm apart";
        let course = match (along, points, lanes) {
            (Some(name), None, None) => {
                let key = (name.to_owned(), reverse);
                if let Some(course) = self.drives.get(&key) {
                    return Ok(course.clone());
                }
                let drive = drive_named(field, name, self.around.drives)?;
                let course = Course::from_drive(drive);
                let course = course.ok_or_else(|| FileError::new(field, none()))?;
                let course = Arc::new(if reverse { course.reversed() } else { course });
                self.drives.insert(key, course.clone());
                return Ok(course);
            }
            (None, Some(points), None) => {
                let points_m = points_of("points", points)?;
                let ground = Ground::from_drives(self.around.drives);
                Course::from_points(&points_m, &ground)
                    .ok_or_else(|| FileError::new("points", none()))?
            }
            (None, None, Some(ids)) => {
                let map = self.around.map.ok_or_else(|| {
                    FileError::new("lanes", "need a map: write \"map\": {\"file\": ..}")
                })?;
                let points_m = map.center_of(ids).map_err(|(index, message)| {
                    FileError::new(format!("lanes[{index}]"), message)
                })?;
                // The lanes have heights; the ground of recorded drives may be of another level.
                Course::from_points(&points_m, &Ground::from_drives(&[]))
                    .ok_or_else(|| FileError::new("lanes", none()))?
            }
            _ => {
                let message = format!("write exactly one of {field}, points and lanes");
                return Err(FileError::new(field, message));
            }
        };
        Ok(Arc::new(if reverse { course.reversed() } else { course }))
    }
}

/// All actors, first the recorded ones and then those of the scenario, with the names of their triggers.
pub(super) fn actors_of(
    file: &mut ScenarioFile,
    seed: u64,
    around: &Surroundings<'_>,
    start: Option<&EgoStart>,
    courses: &mut Courses<'_>,
) -> Result<(Vec<Actor>, Vec<Vec<String>>), FileError> {
    let tracks = recorded(file, around, start)?;
    let count = tracks.len() + file.actors.len();
    if count > limits::ACTORS {
        let message = format!("{count} with those of the tracks; at most {}", limits::ACTORS);
        return Err(FileError::new("actors", message));
    }
    let mut actors: Vec<Actor> = Vec::with_capacity(count);
    for (section, track) in tracks {
        let asset = section.asset.as_deref().map(|hash| asset_of("tracks", hash, around));
        let asset = asset.transpose()?;
        actors.push(Actor {
            spec: ActorSpec {
                name: section.id.clone(),
                class: section.class,
                box_: box_of("tracks", section.size)?,
                asset: asset.map(|asset| asset.hash),
            },
            behaviour: Behaviour::Track(track),
            script: Vec::new(),
            present: true,
        });
    }

    // Names first: a script may name an actor that comes later.
    let recorded_count = actors.len();
    let mut indices: BTreeMap<String, usize> = BTreeMap::new();
    let names = actors.iter().map(|actor| actor.spec.name.clone());
    indices.extend(names.enumerate().map(|(index, name)| (name, index)));
    for (index, section) in file.actors.iter().enumerate() {
        let path = format!("actors[{index}].name");
        named(&path, &section.name)?;
        if indices.insert(section.name.clone(), recorded_count + index).is_some() {
            let message =
                format!("{:?} is there twice; give each actor its own name", section.name);
            return Err(FileError::new(path, message));
        }
    }
    let trigger_names = file.actors.iter().map(|section| {
        section.script.iter().map(|trigger| trigger.name.clone().unwrap_or_default()).collect()
    });
    let none = std::iter::repeat_n(Vec::new(), recorded_count);
    let trigger_names: Vec<Vec<String>> = none.chain(trigger_names).collect();

    let references = References { indices: &indices, triggers: &trigger_names };
    for (index, section) in file.actors.iter_mut().enumerate() {
        let own = recorded_count + index;
        let actor = actor_of(section, own, seed, around, start, courses, &references)
            .map_err(|error| error.within(&format!("actors[{index}]")))?;
        actors.push(actor);
    }
    Ok((actors, trigger_names))
}

/// What scripts may refer to.
struct References<'a> {
    indices: &'a BTreeMap<String, usize>,
    triggers: &'a [Vec<String>],
}

/// The tracks of the scenario's tracks file, on the episode's clock.
fn recorded<'a>(
    file: &mut ScenarioFile,
    around: &Surroundings<'a>,
    start: Option<&EgoStart>,
) -> Result<Vec<(&'a TrackSection, Track)>, FileError> {
    let Some(section) = &mut file.tracks else { return Ok(Vec::new()) };
    let Some(tracks) = around.tracks else {
        return Err(FileError::new("tracks.file", format!("{:?} was not read", section.file)));
    };
    for (index, id) in section.without.iter().enumerate() {
        if !tracks.tracks.iter().any(|track| track.id == *id) {
            let known = listed(tracks.tracks.iter().map(|track| track.id.as_str()));
            let message = format!("there is no track {id:?}; there is {known}");
            return Err(FileError::new(format!("tracks.without[{index}]"), message));
        }
    }
    let start_us = section.start_us.unwrap_or(start_time_us(around, start));
    section.start_us = Some(start_us);
    let kept = tracks.tracks.iter().filter(|track| !section.without.contains(&track.id));
    kept.map(|track| {
        let shifted = track.shifted(start_us);
        let shifted =
            shifted.map_err(|error| error.within(&format!("tracks.file: track {:?}", track.id)))?;
        Ok((track, shifted))
    })
    .collect()
}

/// When the recorded drive passed the ego's start, in microseconds.
fn start_time_us(around: &Surroundings<'_>, start: Option<&EgoStart>) -> i64 {
    let Some(EgoStart::Station { trajectory, station_m }) = start else { return 0 };
    let drive = around.drives.iter().find(|drive| drive.name == *trajectory);
    let route = drive.and_then(|drive| Route::new(drive).ok());
    route.map_or(0, |route| route.at(*station_m).time_us)
}

fn asset_of(path: &str, name: &str, around: &Surroundings<'_>) -> Result<AssetInfo, FileError> {
    (around.asset)(name).ok_or_else(|| {
        let message = format!(
            "there is no asset {name:?}; write the hash of one that `wildcity actor list` shows, or leave it out"
        );
        FileError::new(path, message)
    })
}

fn actor_of(
    section: &mut ActorSection,
    own: usize,
    seed: u64,
    around: &Surroundings<'_>,
    start: Option<&EgoStart>,
    courses: &mut Courses<'_>,
    references: &References<'_>,
) -> Result<Actor, FileError> {
    let asset = section.asset.as_deref().map(|name| asset_of("asset", name, around)).transpose()?;
    section.asset = asset.as_ref().map(|asset| asset.hash.clone());
    let class = section.class.or(asset.as_ref().map(|asset| asset.class));
    let drawn = drawn(section.jitter.as_ref(), seed, &section.name)?;
    if let Some(jitter) = &mut section.jitter {
        jitter.drawn = Some(drawn);
    }

    let given = [
        section.log.is_some(),
        section.path.is_some(),
        section.idm.is_some(),
        section.collide.is_some(),
        section.attack.is_some(),
        section.stand.is_some(),
    ];
    if given.iter().filter(|given| **given).count() != 1 {
        let message = "write exactly one of log, path, idm, collide, attack and stand";
        return Err(FileError::new("name", format!("{:?}: {message}", section.name)));
    }
    let mut track_class = None;
    let mut track_size = None;
    let along_rad = section.jitter.and_then(|jitter| jitter.along_rad);
    let behaviour = if let Some(log) = &section.log {
        if section.jitter.is_some() {
            return Err(FileError::new(
                "jitter",
                "is not for log; use collide to displace a track",
            ));
        }
        let track = track_named(&log.track, around)?;
        track_class = Some(track.class);
        track_size = Some(track.size);
        let shifted = track.shifted(start_time_us(around, start));
        Behaviour::Track(shifted.map_err(|error| error.within("log.track"))?)
    } else if let Some(path) = &section.path {
        Behaviour::Follow(follow_of("path", path, &drawn, None, courses)?)
    } else if let Some(idm) = &section.idm {
        let model = idm_of(idm).map_err(|error| error.within("idm"))?;
        Behaviour::Follow(follow_of("idm", &path_of(idm), &drawn, Some(model), courses)?)
    } else if let Some(collide) = &section.collide {
        let track = collide_of(collide, &drawn, along_rad, around);
        Behaviour::Track(track.map_err(|error| error.within("collide"))?)
    } else if let Some(attack) = &section.attack {
        attack_of(attack, &drawn, along_rad).map_err(|error| error.within("attack"))?
    } else if let Some(pose) = &section.stand {
        let pose = displaced(&pose_of("stand", pose)?, &drawn, along_rad);
        Behaviour::Track(standing(pose))
    } else {
        return Err(FileError::new("name", "has no behaviour"));
    };
    let is_follow = matches!(behaviour, Behaviour::Follow(_));
    if is_follow && (drawn.yaw_rad != 0.0 || along_rad.is_some()) {
        let message =
            "yaw_rad and along_rad are for collide, attack and stand: a course has its own heading";
        return Err(FileError::new("jitter", message));
    }
    let class = class.or(track_class).unwrap_or(ActorClass::Vehicle);
    let box_ = match (section.size.or(track_size), &asset) {
        (Some(size), _) => box_of("size", size)?,
        (None, Some(asset)) => asset.box_,
        (None, None) => usual_box(class),
    };
    let mut actor = Actor {
        spec: ActorSpec { name: section.name.clone(), class, box_, asset: section.asset.clone() },
        behaviour,
        script: Vec::new(),
        present: section.present.unwrap_or(true),
    };
    script_of(section, own, &mut actor, courses, references)?;
    Ok(actor)
}

/// The box of a class without an asset.
fn usual_box(class: ActorClass) -> ActorBox {
    match class {
        ActorClass::Vehicle => ActorBox { length_m: 4.5, width_m: 1.8, height_m: 1.5 },
        ActorClass::Pedestrian => ActorBox::PEDESTRIAN,
        ActorClass::Bicycle => ActorBox { length_m: 1.8, width_m: 0.6, height_m: 1.75 },
        ActorClass::Object => ActorBox { length_m: 1.0, width_m: 1.0, height_m: 1.0 },
    }
}

fn track_named<'a>(id: &str, around: &Surroundings<'a>) -> Result<&'a TrackSection, FileError> {
    let Some(tracks) = around.tracks else {
        let message = "needs a tracks file: write \"tracks\": {\"file\": ..}";
        return Err(FileError::new("log.track", message));
    };
    let found = tracks.tracks.iter().find(|track| track.id == *id);
    found.ok_or_else(|| {
        let known = listed(tracks.tracks.iter().map(|track| track.id.as_str()));
        FileError::new("log.track", format!("there is no track {id:?}; there is {known}"))
    })
}

/// The part of an IDM section that `path` has too.
fn path_of(idm: &IdmSection) -> PathSection {
    PathSection {
        along: idm.along.clone(),
        points: idm.points.clone(),
        lanes: idm.lanes.clone(),
        reverse: idm.reverse,
        station_m: idm.station_m,
        offset_m: idm.offset_m,
        speed: idm.speed,
        leaves: idm.leaves,
    }
}

fn follow_of(
    field: &str,
    path: &PathSection,
    drawn: &JitterDraw,
    idm: Option<Idm>,
    courses: &mut Courses<'_>,
) -> Result<Follow, FileError> {
    let course = courses
        .line(
            "along",
            path.along.as_deref(),
            path.points.as_deref(),
            path.lanes.as_deref(),
            path.reverse.unwrap_or(false),
        )
        .map_err(|error| error.within(field))?;
    let length_m = course.length_m();
    let station_m = in_range(&format!("{field}.station_m"), path.station_m, [0.0, length_m])?;
    let offset_m = path.offset_m.unwrap_or(0.0);
    let offset_m = in_range(&format!("{field}.offset_m"), offset_m, [-100.0, 100.0])?;
    let most_mps = limits::ACTOR_SPEED_M_S;
    let speed_mps = in_range(&format!("{field}.speed"), path.speed, [0.0, most_mps])?;
    Ok(Follow {
        courses: vec![course],
        station_m: (station_m + drawn.longitudinal_m).clamp(0.0, length_m),
        // Jitter is to the right, offsets are to the left.
        offset_m: offset_m - drawn.lateral_m,
        speed_mps,
        idm,
        leaves: path.leaves.unwrap_or(false),
    })
}

fn idm_of(section: &IdmSection) -> Result<Idm, FileError> {
    let variant = match section.model.unwrap_or(IdmModel::Wildcity) {
        IdmModel::Wildcity => Idm::WILDCITY,
        IdmModel::Nuplan => Idm::NUPLAN,
        IdmModel::Navsim => Idm::NAVSIM,
        IdmModel::Hugsim => Idm::HUGSIM,
    };
    let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
    let or = |field: &str, value: Option<f64>, usual: f64, bounds: [f64; 2]| match value {
        Some(value) => in_range(field, value, bounds),
        None => Ok(usual),
    };
    let least_gap_m = or("s0", section.s0, variant.least_gap_m, [0.1, 100.0])?;
    // The floor of the gap is the least gap where the variant has one.
    let gap_floor_m = if variant.gap_floor_m > 0.0 { least_gap_m } else { 0.0 };
    let speed_bounds = [0.1, limits::ACTOR_SPEED_M_S];
    Ok(Idm {
        free_speed_mps: or("v0", section.v0, variant.free_speed_mps, speed_bounds)?,
        least_gap_m,
        gap_floor_m,
        headway_s: or("headway_s", section.headway_s, variant.headway_s, [0.0, 60.0])?,
        acceleration_mps2: or("a", section.a, variant.acceleration_mps2, [0.01, most_mps2])?,
        braking_mps2: or("b", section.b, variant.braking_mps2, [0.01, most_mps2])?,
        ..variant
    })
}

/// A track that stands at a pose at all times.
fn standing(world_from_actor: Pose) -> Track {
    let keyframe = TrackKeyframe { time_us: 0, world_from_actor };
    Track::standing(keyframe)
}

fn collide_of(
    section: &CollideSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    match (&section.positions, &section.along) {
        (Some(_), None) => through_positions(section, drawn, along_rad, around),
        (None, Some(name)) => meeting(section, name, drawn, along_rad, around),
        _ => Err(FileError::new("positions", "write exactly one of positions and along")),
    }
}

/// Through timed positions, all displaced alike.
fn through_positions(
    section: &CollideSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    let positions = section.positions.as_deref().unwrap_or_default();
    if !(1..=limits::POSITIONS).contains(&positions.len()) {
        let message = format!("{}; 1 to {} are accepted", positions.len(), limits::POSITIONS);
        return Err(FileError::new("positions", message));
    }
    let mut points_m = Vec::with_capacity(positions.len());
    let mut times_us: Vec<i64> = Vec::with_capacity(positions.len());
    for (index, position) in positions.iter().enumerate() {
        let path = format!("positions[{index}]");
        let end_s = limits::END_S;
        let time_s = in_range(&format!("{path}.time_s"), position.time_s, [-end_s, end_s])?;
        let time_us = (time_s * 1e6).round() as i64;
        if times_us.last().is_some_and(|before_us| time_us <= *before_us) {
            let message = format!("{time_s:?} s; later than the position before it is accepted");
            return Err(FileError::new(format!("{path}.time_s"), message));
        }
        times_us.push(time_us);
        let pose = Pose::checked(position.xyz, [1.0, 0.0, 0.0, 0.0]).map_err(|error| {
            FileError::new(format!("{path}.{}", error.field()), error.to_string())
        })?;
        points_m.push(pose.position_m);
    }
    let yaw_rad = section.yaw_rad.unwrap_or(0.0);
    let yaw_rad = in_range("yaw_rad", yaw_rad, [-100.0, 100.0])?;
    let first_rad = facing_rad(&points_m, 0).unwrap_or(yaw_rad);
    let shift_m = displacement_m(drawn, along_rad.unwrap_or(first_rad));
    let ground = Ground::from_drives(around.drives);
    let mut heading_rad = first_rad;
    let keyframes =
        points_m.iter().zip(&times_us).enumerate().map(|(index, (point_m, time_us))| {
            // An actor that stands keeps its heading; the first one has the given heading.
            heading_rad = facing_rad(&points_m, index).unwrap_or(heading_rad);
            let rotation = DQuat::from_rotation_z(heading_rad + drawn.yaw_rad);
            let pose = Pose { position_m: *point_m + shift_m, rotation };
            TrackKeyframe { time_us: *time_us, world_from_actor: ground.place(pose) }
        });
    track_of(keyframes.collect())
}

/// The direction of the motion at a point: towards the next, at the last from the one before.
fn facing_rad(points_m: &[DVec3], index: usize) -> Option<f64> {
    let last = points_m.len() - 1;
    let way_m = match index == last {
        false => points_m[index + 1] - points_m[index],
        true if last == 0 => return None,
        true => points_m[last] - points_m[last - 1],
    };
    (way_m.truncate().length() > 1e-3).then(|| way_m.y.atan2(way_m.x))
}

/// A straight line at constant speed that meets a recorded drive at a place and a time.
fn meeting(
    section: &CollideSection,
    name: &str,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    let drive = drive_named("along", name, around.drives)?;
    let needed = |field: &str, value: Option<f64>| {
        value.ok_or_else(|| FileError::new(field, "is missing; write it beside along"))
    };
    let station_m = needed("station_m", section.station_m)?;
    let station_m = in_range("station_m", station_m, [0.0, drive.length_m()])?;
    let time_s = in_range("time_s", needed("time_s", section.time_s)?, [0.0, 3600.0])?;
    let angle_rad = in_range("angle_rad", needed("angle_rad", section.angle_rad)?, [-10.0, 10.0])?;
    let speed_mps = needed("speed", section.speed)?;
    let speed_mps = in_range("speed", speed_mps, [0.0, limits::ACTOR_SPEED_M_S])?;
    let meeting = drive.at_station(station_m);
    let turned = meeting.rotation * DQuat::from_rotation_z(angle_rad);
    let meeting = Pose { rotation: turned.normalize(), ..meeting };
    let meeting = displaced(&meeting, drawn, Some(along_rad.unwrap_or(heading_rad(&meeting))));
    let ahead = meeting.rotation * DVec3::X;
    let at = |time_us: i64| {
        let way_m = speed_mps * (time_us as f64 * 1e-6 - time_s) * ahead;
        let world_from_actor = Pose { position_m: meeting.position_m + way_m, ..meeting };
        TrackKeyframe { time_us, world_from_actor }
    };
    // As long again after the meeting, and at least 10 s.
    let end_us = ((2.0 * time_s).max(time_s + 10.0) * 1e6).round() as i64;
    track_of(vec![at(0), at(end_us)])
}

fn track_of(keyframes: Vec<TrackKeyframe>) -> Result<Track, FileError> {
    Track::new(keyframes)
        .map(Track::held)
        .map_err(|error| FileError::new("positions", error.to_string()))
}

fn attack_of(
    section: &AttackSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
) -> Result<Behaviour, FileError> {
    let ticks = section.ticks.unwrap_or(PLAN_TICKS);
    if !(1..=1000).contains(&ticks) {
        return Err(FileError::new("ticks", format!("{ticks}; 1 to 1000 are accepted")));
    }
    let best = section.best_k.unwrap_or(1);
    if !(1..=150).contains(&best) {
        return Err(FileError::new("best_k", format!("{best}; 1 to 150 are accepted")));
    }
    Ok(Behaviour::Attack {
        attack: Attack { plan_us: TICK_US * i64::from(ticks), best: best as usize },
        world_from_actor: displaced(&pose_of("pose", &section.pose)?, drawn, along_rad),
        speed_mps: in_range("speed", section.speed, [0.0, limits::ACTOR_SPEED_M_S])?,
    })
}

fn script_of(
    section: &ActorSection,
    own: usize,
    actor: &mut Actor,
    courses: &mut Courses<'_>,
    references: &References<'_>,
) -> Result<(), FileError> {
    if section.script.len() > limits::TRIGGERS {
        let message = format!("{} triggers; at most {}", section.script.len(), limits::TRIGGERS);
        return Err(FileError::new("script", message));
    }
    for (index, trigger) in section.script.iter().enumerate() {
        let path = format!("script[{index}]");
        if let Some(name) = &trigger.name {
            named(&format!("{path}.name"), name)?;
            let names = &references.triggers[own];
            if names.iter().filter(|other| *other == name).count() > 1 {
                let message = format!("{name:?} is there twice; give each trigger its own name");
                return Err(FileError::new(format!("{path}.name"), message));
            }
        }
        let when = condition_of(&trigger.when, own, references);
        let when = when.map_err(|error| error.within(&format!("{path}.when")))?;
        if !(1..=limits::ACTIONS).contains(&trigger.then.len()) {
            let message =
                format!("{} actions; 1 to {} are accepted", trigger.then.len(), limits::ACTIONS);
            return Err(FileError::new(format!("{path}.do"), message));
        }
        let mut then = Vec::with_capacity(trigger.then.len());
        for (at, action) in trigger.then.iter().enumerate() {
            let action = action_of(action, &mut actor.behaviour, courses);
            then.push(action.map_err(|error| error.within(&format!("{path}.do[{at}]")))?);
        }
        actor.script.push(Trigger { when, then });
    }
    Ok(())
}

fn condition_of(
    section: &ConditionSection,
    own: usize,
    references: &References<'_>,
) -> Result<Condition, FileError> {
    let microseconds = |path: &str, value_s: f64| -> Result<i64, FileError> {
        Ok((in_range(path, value_s, [0.0, limits::END_S])? * 1e6).round() as i64)
    };
    let bounded = |path: &str, value: Option<f64>| {
        value.map(|value| in_range(path, value, [0.0, 1e6])).transpose()
    };
    let near = match (section.within_m, &section.of) {
        (None, None) => None,
        (None, Some(_)) => {
            return Err(FileError::new("of", "needs within_m: write the distance"));
        }
        (Some(within_m), of) => {
            let actor = of.as_ref().map(|name| {
                references.indices.get(name).copied().ok_or_else(|| {
                    let known = listed(references.indices.keys().map(String::as_str));
                    FileError::new("of", format!("there is no actor {name:?}; there is {known}"))
                })
            });
            let within_m = in_range("within_m", within_m, [0.0, 1e6])?;
            Some(Near { actor: actor.transpose()?, within_m })
        }
    };
    let after = match (&section.after, section.delay_s) {
        (None, None) => None,
        (None, Some(_)) => {
            return Err(FileError::new("delay_s", "needs after: write the trigger's name"));
        }
        (Some(name), delay_s) => Some(After {
            delay_us: microseconds("delay_s", delay_s.unwrap_or(0.0))?,
            ..trigger_named(name, own, references)?
        }),
    };
    Ok(Condition {
        time_us: section.time_s.map(|time_s| microseconds("time_s", time_s)).transpose()?,
        near,
        station_m: bounded("station_m", section.station_m)?,
        ego_station_m: bounded("ego_station_m", section.ego_station_m)?,
        speed_above_mps: bounded("speed_above", section.speed_above)?,
        speed_below_mps: bounded("speed_below", section.speed_below)?,
        ego_speed_above_mps: bounded("ego_speed_above", section.ego_speed_above)?,
        after,
    })
}

/// A trigger by `TRIGGER` or `ACTOR/TRIGGER`.
fn trigger_named(text: &str, own: usize, references: &References<'_>) -> Result<After, FileError> {
    let missing = || {
        let message = format!("there is no trigger {text:?}; write TRIGGER or ACTOR/TRIGGER");
        FileError::new("after", message)
    };
    let (actor, name) = match text.split_once('/') {
        None => (own, text),
        Some((actor, name)) => (*references.indices.get(actor).ok_or_else(missing)?, name),
    };
    let triggers = &references.triggers[actor];
    let trigger = triggers.iter().position(|other| !name.is_empty() && other == name);
    Ok(After { actor, trigger: trigger.ok_or_else(missing)?, delay_us: 0 })
}

fn action_of(
    section: &ActionSection,
    behaviour: &mut Behaviour,
    courses: &mut Courses<'_>,
) -> Result<Action, FileError> {
    let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
    let rate_of = |path: &str, rate: f64| in_range(path, rate, [0.01, most_mps2]);
    let action = match section {
        ActionSection::Spawn {} => return Ok(Action::Spawn),
        ActionSection::Remove {} => return Ok(Action::Remove),
        ActionSection::Speed { to, rate } => Action::Speed {
            to_mps: in_range("speed.to", *to, [0.0, limits::ACTOR_SPEED_M_S])?,
            rate_mps2: rate_of("speed.rate", *rate)?,
        },
        ActionSection::Stop { rate } => {
            Action::Speed { to_mps: 0.0, rate_mps2: rate_of("stop.rate", *rate)? }
        }
        ActionSection::Offset { to_m, over_s } => Action::Offset {
            to_m: in_range("offset.to_m", *to_m, [-100.0, 100.0])?,
            over_s: in_range("offset.over_s", *over_s, [0.1, 1000.0])?,
        },
        ActionSection::Path(line) => {
            let reverse = line.reverse.unwrap_or(false);
            let along = line.along.as_deref();
            let points = line.points.as_deref();
            let lanes = line.lanes.as_deref();
            let course = courses.line("along", along, points, lanes, reverse);
            let course = course.map_err(|error| error.within("path"))?;
            if let Behaviour::Follow(follow) = behaviour {
                follow.courses.push(course);
                Action::Course { course: follow.courses.len() - 1 }
            } else {
                Action::Course { course: 0 }
            }
        }
    };
    if matches!(behaviour, Behaviour::Follow(_)) {
        return Ok(action);
    }
    let message = "is for path and idm; other actors know spawn and remove only";
    Err(FileError::new("do", message))
}
