//! From a scenario file to what an episode needs, checked against the twin.

use std::sync::Arc;

use wildcity_scene::random::Random;
use wildcity_scene::route::Route;
use wildcity_scene::{ActorBox, Trajectory};

use super::actors::{Actors, actors_from};
use super::around::{EgoStart, Surroundings, drive_named};
use super::condition::{References, condition};
use super::courses::Courses;
use super::end::EndRules;
use super::error::{FileError, check_format, hashed, in_range, named};
use super::file::{EgoSection, EndSection, FilePin, RouteSection, ScenarioFile};
use super::pose::pose_from;
use super::tracks::box_from;
use crate::Dynamics;
use crate::limits;
use crate::route::{COMMAND_AHEAD_M, NavigationRoute, RouteCommand};
use crate::traffic::{EgoBox, Traffic};

/// A scenario that is ready to run.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// The file with seed, drawn jitter and hashes of assets. Without its `format` it is the
    /// episode's identity.
    pub file: ScenarioFile,
    pub traffic: Arc<Traffic>,
    /// Names of the triggers of each actor, in order; empty where a trigger has none.
    pub trigger_names: Vec<Vec<String>>,
    /// Where the ego should drive.
    pub route: Option<Arc<NavigationRoute>>,
    /// When an episode ends.
    pub end: EndRules,
    /// Where the ego starts; `None` leaves it to the request.
    pub start: Option<EgoStart>,
    /// How the ego moves; `None` leaves it to the request.
    pub dynamics: Option<Dynamics>,
    /// Length of the warm-up, in microseconds; `None` leaves it to the request.
    pub warm_up_us: Option<i64>,
}

/// A frame of NeuroNCAP, by which a start is shifted, in microseconds.
const START_FRAME_US: i64 = 500_000;

impl Scenario {
    /// Checks a scenario and everything that it refers to, draws its jitter, and sets up its
    /// traffic.
    ///
    /// # Errors
    /// Names the place of the first mistake in the file.
    pub fn resolve(
        mut file: ScenarioFile,
        seed: u64,
        around: &Surroundings<'_>,
    ) -> Result<Self, FileError> {
        // A resolved file has its own seed, so that it replays whatever the caller passes.
        let seed = *file.seed.get_or_insert(seed);
        check_names(&file)?;
        let start = ego_start(&file.ego, seed, around.drives).map_err(|e| e.within("ego"))?;
        // The shift of the start is in the start from now on.
        file.ego.jitter_frames = None;
        if let (Some(EgoStart::Station { station_m, .. }), Some(section)) =
            (&start, &mut file.ego.start)
        {
            section.station_m = Some(*station_m);
        }
        let dynamics = file
            .ego
            .dynamics
            .map(dynamics_from)
            .transpose()
            .map_err(|error| error.within("ego"))?;
        let ego_box = match &file.ego.box_ {
            None => EgoBox::default(),
            Some(section) => {
                let box_ = box_from("ego.box.size", section.size)?;
                let most_m = ActorBox::MOST_M;
                let center_x_m = in_range("ego.box.center_x", section.center_x, [-most_m, most_m])?;
                EgoBox { box_, center_x_m }
            }
        };
        // One for route and actors, so that all followers of a drive share its course.
        let mut courses = Courses::new(around);
        let route = match &file.route {
            Some(section) => {
                Some(route_from(section, &mut courses).map_err(|error| error.within("route"))?)
            }
            None => default_route(start.as_ref(), &mut courses),
        };
        // This call writes to the file what it draws and chooses.
        let Actors { actors, trigger_names, indices } =
            actors_from(&mut file, seed, around, start.as_ref(), &mut courses)?;
        let references = References { indices: &indices, triggers: &trigger_names };
        // The end may name every trigger, so its condition comes after the actors.
        let when = file
            .end
            .when
            .as_ref()
            .map(|when| condition(when, None, &references))
            .transpose()
            .map_err(|error| error.within("end.when"))?;
        let end = end_rules(&file.end, route.is_some()).map_err(|error| error.within("end"))?;
        if let Some(progress) = file.verdict.progress {
            in_range("verdict.progress", progress, [0.0, 1.0])?;
        }
        let warm_up_us = file.ego.warm_up_us;
        let traffic = Arc::new(Traffic { seed, ego_box, actors, end: when });
        let route = route.map(Arc::new);
        Ok(Self { file, traffic, trigger_names, route, end, start, dynamics, warm_up_us })
    }
}

/// Checks names and hashes that do not need the twin.
fn check_names(file: &ScenarioFile) -> Result<(), FileError> {
    check_format(Some(&file.format), ScenarioFile::FORMAT)?;
    named("name", &file.name)?;
    named("twin.name", &file.twin.name)?;
    if let Some(hash) = &file.twin.version_hash {
        hashed("twin.version_hash", hash)?;
    }
    let pin = |path: &str, pin: &FilePin| -> Result<(), FileError> {
        named(&format!("{path}.file"), &pin.file)?;
        pin.hash.iter().try_for_each(|hash| hashed(&format!("{path}.hash"), hash))
    };
    if let Some(map) = &file.map {
        pin("map", map)?;
    }
    if let Some(tracks) = &file.tracks {
        pin("tracks", &FilePin { file: tracks.file.clone(), hash: tracks.hash.clone() })?;
    }
    Ok(())
}

fn ego_start(
    ego: &EgoSection,
    seed: u64,
    drives: &[Trajectory],
) -> Result<Option<EgoStart>, FileError> {
    let frames = ego.jitter_frames.unwrap_or(0);
    if frames > limits::START_FRAMES {
        let message = format!("{frames}; at most {} are accepted", limits::START_FRAMES);
        return Err(FileError::new("jitter_frames", message));
    }
    let needs_drive = "needs a start along a trajectory: write start.trajectory";
    let Some(start) = &ego.start else {
        // The request decides on the start then.
        return match frames {
            0 => Ok(None),
            _ => Err(FileError::new("jitter_frames", needs_drive)),
        };
    };
    match (&start.trajectory, &start.pose) {
        (Some(_), Some(_)) => {
            Err(FileError::new("start.pose", "is there beside trajectory; write one of them"))
        }
        (None, None) => Err(FileError::new("start", "is empty; write trajectory or pose")),
        (None, Some(pose)) => {
            if frames > 0 {
                return Err(FileError::new("jitter_frames", needs_drive));
            }
            if start.station_m.is_some() {
                return Err(FileError::new("start.station_m", "is for a start along a trajectory"));
            }
            Ok(Some(EgoStart::Pose(pose_from("start.pose", pose)?)))
        }
        (Some(name), None) => {
            let drive = drive_named("start.trajectory", name, drives)?;
            let length_m = drive.length_m();
            let given_m = start.station_m.unwrap_or(0.0);
            let checked_m = in_range("start.station_m", given_m, [0.0, length_m])?;
            let station_m = shifted(drive, checked_m, seed, frames)
                .map_err(|message| FileError::new("start", message))?;
            Ok(Some(EgoStart::Station { trajectory: name.clone(), station_m }))
        }
    }
}

/// A station that is earlier or later by up to `frames` frames of 0.5 s of the recorded drive.
fn shifted(drive: &Trajectory, station_m: f64, seed: u64, frames: u32) -> Result<f64, String> {
    if frames == 0 {
        return Ok(station_m);
    }
    // Uniform over the 2 n + 1 frames from -n to n. `frames` is at most 100, so nothing overflows.
    let shift = Random::new(seed, "start", 0).below(2 * frames as usize + 1) as i64;
    let shift_us = (shift - i64::from(frames)) * START_FRAME_US;
    let route = Route::new(drive).map_err(|error| error.to_string())?;
    // `Route::new` has checked that the drive has keyframes.
    let first_us = drive.keyframes[0].time_us;
    let last_us = drive.keyframes[drive.keyframes.len() - 1].time_us;
    // A shift beyond the ends of the drive starts at its end.
    let time_us = route.at(station_m).time_us.saturating_add(shift_us).clamp(first_us, last_us);
    // Between the two keyframes around that time.
    let last = drive.keyframes.len() - 1;
    let after = drive.keyframes.partition_point(|key| key.time_us < time_us).min(last);
    let stations_m = route.stations_m();
    // The time is that of the first keyframe.
    let Some(before) = after.checked_sub(1) else { return Ok(0.0) };
    let from = &drive.keyframes[before];
    let to = &drive.keyframes[after];
    // In 128 bits, because the difference of two times of 64 bits may not fit. Times rise, so the
    // span is above 0.
    let span_us = i128::from(to.time_us) - i128::from(from.time_us);
    let since_us = i128::from(time_us) - i128::from(from.time_us);
    let t = since_us as f64 / span_us as f64;
    Ok(stations_m[before] + t * (stations_m[after] - stations_m[before]))
}

fn dynamics_from(asked: wildcity_options::Dynamics) -> Result<Dynamics, FileError> {
    Dynamics::try_from(asked).map_err(|error| FileError::new(error.field(), error.to_string()))
}

fn route_from(
    section: &RouteSection,
    courses: &mut Courses<'_>,
) -> Result<NavigationRoute, FileError> {
    let course = courses.line(
        "trajectory",
        section.trajectory.as_deref(),
        section.points.as_deref(),
        section.lanes.as_deref(),
        false,
    )?;
    let length_m = course.length_m();
    if section.commands.len() > limits::COMMANDS {
        let message = format!("{}; at most {}", section.commands.len(), limits::COMMANDS);
        return Err(FileError::new("commands", message));
    }
    let mut commands = Vec::new();
    // Commands must be in order, since the route takes the first one that is not passed.
    let mut before_m = 0.0;
    for (index, command) in section.commands.iter().enumerate() {
        let path = format!("commands[{index}]");
        let station_m =
            in_range(&format!("{path}.station_m"), command.station_m, [before_m, length_m])?;
        before_m = station_m;
        let given_m = command.ahead_m.unwrap_or(COMMAND_AHEAD_M);
        let ahead_m = in_range(&format!("{path}.ahead_m"), given_m, [0.0, 1e6])?;
        if command.text.as_ref().is_some_and(|text| text.len() > limits::COMMAND_BYTES) {
            let message = format!("longer than {} bytes", limits::COMMAND_BYTES);
            return Err(FileError::new(format!("{path}.text"), message));
        }
        let text = command.text.clone();
        commands.push(RouteCommand { station_m, command: command.command, text, ahead_m });
    }
    Ok(NavigationRoute { course: (*course).clone(), commands })
}

/// The route of a scenario that names none: the trajectory on which the ego starts.
fn default_route(start: Option<&EgoStart>, courses: &mut Courses<'_>) -> Option<NavigationRoute> {
    let Some(EgoStart::Station { trajectory, .. }) = start else { return None };
    // No error here, because the scenario has not asked for a route. A drive that stands has none.
    let course = courses.line("trajectory", Some(trajectory), None, None, false).ok()?;
    Some(NavigationRoute { course: (*course).clone(), commands: Vec::new() })
}

fn end_rules(section: &EndSection, has_route: bool) -> Result<EndRules, FileError> {
    let microseconds = |path: &str, value_s: Option<f64>| -> Result<Option<i64>, FileError> {
        // At least one millisecond: an end at 0 would be an episode without a step.
        let value_s = value_s.map(|value_s| in_range(path, value_s, [0.001, limits::END_S]));
        Ok(value_s.transpose()?.map(|value_s| (value_s * 1e6).round() as i64))
    };
    let off_route_m = section
        .off_route_m
        .map(|most_m| in_range("off_route_m", most_m, [0.1, 1e6]))
        .transpose()?;
    // Without a route the distance is unknown and the rule could never end the episode.
    if off_route_m.is_some() && !has_route {
        let message = "there is no route; write one, or start along a trajectory";
        return Err(FileError::new("off_route_m", message));
    }
    Ok(EndRules {
        time_us: microseconds("time_s", section.time_s)?,
        off_route_m,
        contact: section.contact,
        stuck_us: microseconds("stuck_s", section.stuck_s)?,
        // By default an episode ends with its route, if there is one.
        route_done: section.route_done.unwrap_or(true) && has_route,
    })
}
