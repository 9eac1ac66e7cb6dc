//! The actors of a scenario, from their sections.

use std::collections::BTreeMap;

use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::{ActorBox, ActorClass};

use super::actor_file::{
    ActorSection, AttackSection, IdmModel, IdmSection, JitterDraw, NOT_DRAWN, PathSection,
};
use super::around::{AssetInfo, EgoStart, Surroundings};
use super::collide::collide_from;
use super::condition::References;
use super::courses::Courses;
use super::error::{FileError, in_range, listed, named};
use super::file::ScenarioFile;
use super::jitter::{displaced, drawn};
use super::pose::pose_from;
use super::script::add_script;
use super::tracks::{TrackSection, box_from};
use crate::limits;
use crate::traffic::{
    Actor, ActorSpec, Attack, Behaviour, CourseFollower, Idm, Track, TrackKeyframe,
};

/// Time between two ticks of HUGSIM, in microseconds, and the number of ticks between two plans.
const TICK_US: i64 = 250_000;
const PLAN_TICKS: u32 = 3;

/// All actors, first the recorded ones and then those of the scenario.
pub(super) struct Actors {
    pub(super) actors: Vec<Actor>,
    /// The names of the triggers of each actor.
    pub(super) trigger_names: Vec<Vec<String>>,
    /// The index of each actor, by name.
    pub(super) indices: BTreeMap<String, usize>,
}

/// All actors of a scenario.
pub(super) fn actors_from(
    file: &mut ScenarioFile,
    seed: u64,
    around: &Surroundings<'_>,
    start: Option<&EgoStart>,
    courses: &mut Courses<'_>,
) -> Result<Actors, FileError> {
    let tracks = recorded(file, around, start)?;
    let count = tracks.len() + file.actors.len();
    if count > limits::ACTORS {
        let message = format!("{count} with those of the tracks; at most {}", limits::ACTORS);
        return Err(FileError::new("actors", message));
    }
    let mut actors: Vec<Actor> = Vec::with_capacity(count);
    for (section, track) in tracks {
        let box_ = box_from("tracks", section.size)?;
        let named = named_asset("tracks", section.asset.as_deref(), around)?;
        // A track that names an asset gets it, or none if it names `none`. Only one without a name
        // gets a default.
        let asset = match &section.asset {
            Some(_) => named,
            None => default_asset("tracks", section.class, &box_, around)?,
        };
        actors.push(Actor {
            spec: ActorSpec {
                name: section.id.clone(),
                class: section.class,
                box_,
                asset: asset.map(|asset| asset.hash),
            },
            behaviour: track.into(),
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

    // Building an actor needs the names of all, and the file is changed while its actors are built:
    // so the names are copies.
    let references = References { indices: &indices, triggers: &trigger_names };
    for (index, section) in file.actors.iter_mut().enumerate() {
        let own = recorded_count + index;
        let actor = actor_from(section, own, seed, around, start, courses, &references)
            .map_err(|error| error.within(&format!("actors[{index}]")))?;
        actors.push(actor);
    }
    Ok(Actors { actors, trigger_names, indices })
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
    // A misspelt id would silently keep a track that should be left out.
    for (index, id) in section.without.iter().enumerate() {
        if !tracks.tracks.iter().any(|track| track.id == *id) {
            let known = listed(tracks.tracks.iter().map(|track| track.id.as_str()));
            let message = format!("there is no track {id:?}; there is {known}");
            return Err(FileError::new(format!("tracks.without[{index}]"), message));
        }
    }
    // Written back, so that a record repeats the episode even if the ego starts elsewhere.
    let start_us = section.start_us.unwrap_or(start_time_us(around, start));
    section.start_us = Some(start_us);
    let kept = tracks.tracks.iter().filter(|track| !section.without.contains(&track.id));
    kept.map(|track| {
        let shifted = track
            .shifted(start_us)
            .map_err(|error| error.within(&format!("tracks.file: track {:?}", track.id)))?;
        Ok((track, shifted))
    })
    .collect()
}

/// When the recorded drive passed the ego's start, in microseconds.
fn start_time_us(around: &Surroundings<'_>, start: Option<&EgoStart>) -> i64 {
    // Without a place on a recorded drive, the clock of the tracks is that of the episode.
    let Some(EgoStart::Station { trajectory, station_m }) = start else { return 0 };
    let drive = around.drives.iter().find(|drive| drive.name == *trajectory);
    let route = drive.and_then(|drive| Route::new(drive).ok());
    route.map_or(0, |route| route.at(*station_m).time_us)
}

/// The asset that an actor names; `None` if it names none, or [`NOT_DRAWN`].
fn named_asset(
    path: &str,
    name: Option<&str>,
    around: &Surroundings<'_>,
) -> Result<Option<AssetInfo>, FileError> {
    let drawn = name.filter(|name| *name != NOT_DRAWN);
    let found = drawn.map(|name| around.assets.find(name)).transpose();
    found.map_err(|reason| FileError::new(path, reason))
}

/// The asset of an actor that names none.
fn default_asset(
    path: &str,
    class: ActorClass,
    box_: &ActorBox,
    around: &Surroundings<'_>,
) -> Result<Option<AssetInfo>, FileError> {
    let found = around.assets.default_for(class, box_);
    found.map_err(|reason| FileError::new(path, format!("has no asset, and {reason}")))
}

fn actor_from(
    section: &mut ActorSection,
    own: usize,
    seed: u64,
    around: &Surroundings<'_>,
    start: Option<&EgoStart>,
    courses: &mut Courses<'_>,
    references: &References<'_>,
) -> Result<Actor, FileError> {
    let asset = named_asset("asset", section.asset.as_deref(), around)?;
    let class = section.class.or(asset.as_ref().map(|asset| asset.class));
    // Drawn for each actor by its name, so that another actor in the file changes no draw.
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
    // All are counted, so that two behaviours are a mistake and not silently the first of them.
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
        Behaviour::from(shifted.map_err(|error| error.within("log.track"))?)
    } else if let Some(path) = &section.path {
        Behaviour::from(follower_from("path", path, &drawn, None, courses)?)
    } else if let Some(idm) = &section.idm {
        let model = idm_from(idm).map_err(|error| error.within("idm"))?;
        Behaviour::from(follower_from("idm", &path_from_idm(idm), &drawn, Some(model), courses)?)
    } else if let Some(collide) = &section.collide {
        let track = collide_from(collide, &drawn, along_rad, around);
        Behaviour::from(track.map_err(|error| error.within("collide"))?)
    } else if let Some(attack) = &section.attack {
        attack_from(attack, &drawn, along_rad).map_err(|error| error.within("attack"))?
    } else if let Some(pose) = &section.stand {
        let pose = displaced(&pose_from("stand", pose)?, &drawn, along_rad);
        Behaviour::from(standing(pose))
    } else {
        // Not reached, because exactly one is given. An error here is safer than a panic in a
        // server.
        return Err(FileError::new("name", "has no behaviour"));
    };
    // A follower takes its heading from its course, so that a drawn heading would have no effect.
    let is_follow = matches!(behaviour, Behaviour::Follow(_));
    if is_follow && (drawn.yaw_rad != 0.0 || along_rad.is_some()) {
        let message =
            "yaw_rad and along_rad are for collide, attack and stand: a course has its own heading";
        return Err(FileError::new("jitter", message));
    }
    // The actor's own class wins, then that of its asset, then that of its track.
    let class = class.or(track_class).unwrap_or(ActorClass::Vehicle);
    // The box prefers the track to the asset: a recorded size is that of the actor itself.
    let box_ = match (section.size.or(track_size), &asset) {
        (Some(size), _) => box_from("size", size)?,
        (None, Some(asset)) => asset.box_,
        (None, None) => usual_box(class),
    };
    // The default asset depends on the box, so it is looked up last.
    let shown = match &section.asset {
        Some(_) => asset,
        None => default_asset("asset", class, &box_, around)?,
    };
    let asset = shown.map(|asset| asset.hash);
    // An actor that is not drawn keeps the word for it, so that it is not drawn again either. One
    // that gets an asset by its size keeps that size: the asset's own would be taken the next time.
    if asset.is_some() {
        section.size.get_or_insert([box_.length_m, box_.width_m, box_.height_m]);
        section.asset.clone_from(&asset);
    }
    let mut actor = Actor {
        spec: ActorSpec { name: section.name.clone(), class, box_, asset },
        behaviour,
        script: Vec::new(),
        present: section.present.unwrap_or(true),
    };
    // Last, because actions may add courses to the behaviour.
    add_script(section, own, &mut actor, courses, references)?;
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
fn path_from_idm(idm: &IdmSection) -> PathSection {
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

fn follower_from(
    field: &str,
    path: &PathSection,
    drawn: &JitterDraw,
    idm: Option<Idm>,
    courses: &mut Courses<'_>,
) -> Result<CourseFollower, FileError> {
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
    let given_m = path.offset_m.unwrap_or(0.0);
    let offset_m = in_range(&format!("{field}.offset_m"), given_m, [-100.0, 100.0])?;
    let most_mps = limits::ACTOR_SPEED_M_S;
    let speed_mps = in_range(&format!("{field}.speed"), path.speed, [0.0, most_mps])?;
    Ok(CourseFollower {
        courses: vec![course],
        // Jitter may draw a place beyond the ends of the course.
        station_m: (station_m + drawn.longitudinal_m).clamp(0.0, length_m),
        // Jitter is to the right, offsets are to the left.
        offset_m: offset_m - drawn.lateral_m,
        speed_mps,
        idm,
        leaves: path.leaves.unwrap_or(false),
    })
}

fn idm_from(section: &IdmSection) -> Result<Idm, FileError> {
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

fn attack_from(
    section: &AttackSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
) -> Result<Behaviour, FileError> {
    let ticks = section.ticks.unwrap_or(PLAN_TICKS);
    if !(1..=1000).contains(&ticks) {
        return Err(FileError::new("ticks", format!("{ticks}; 1 to 1000 are accepted")));
    }
    let best = section.best_k.unwrap_or(1);
    // There are 150 plans, so a larger number would have no effect.
    if !(1..=150).contains(&best) {
        return Err(FileError::new("best_k", format!("{best}; 1 to 150 are accepted")));
    }
    Ok(Behaviour::Attack {
        attack: Attack { plan_us: TICK_US * i64::from(ticks), best: best as usize },
        world_from_actor: displaced(&pose_from("pose", &section.pose)?, drawn, along_rad),
        speed_mps: in_range("speed", section.speed, [0.0, limits::ACTOR_SPEED_M_S])?,
    })
}
