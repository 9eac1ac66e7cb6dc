//! Wire to session.

use std::time::Duration;

use serde::Deserialize;

use crate::fault::Fault;
use wildcity_protocol::message::{self, Request};
use wildcity_protocol::unknown_field;
use wildcity_scene::ProfileOverrides;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::json::Intrinsics;
use wildcity_scene::rig::{Rig, RigCamera, check_overlays, is_name};
use wildcity_session::{
    Encoding, ImagePart, Outputs, PixelMaps, RigChoice, SessionError, SessionOptions, Start,
};
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::{Dynamics, EgoModel};

use super::SUBPROTOCOL;
use super::camera::{appearance_of, lens_of, shutter_of, windshield_of};

/// A text frame, checked as far as it can be on its own.
#[derive(Debug)]
pub(crate) enum Parsed {
    /// A request, or something with the number of one.
    Numbered {
        /// Its number.
        seq: u64,
        /// What is wanted, or why it is refused.
        command: Result<Command, Fault>,
    },
    /// Its number could not be read.
    Unnumbered(Fault),
}

/// What a client wants.
#[derive(Debug)]
pub(crate) enum Command {
    /// To be welcomed.
    Hello {
        /// Name and version of the client.
        client: String,
    },
    /// A session, under a name if it chose one.
    Open {
        /// The name.
        name: Option<String>,
        /// The rest.
        opening: Box<SessionOptions>,
    },
    /// A step.
    Step {
        /// How the ego is to move.
        movement: wildcity_sim::Command,
        /// Whether it is the last.
        terminate: bool,
    },
    /// Images of poses.
    Observe {
        /// `world_from_rig` each.
        poses: Vec<Pose>,
    },
    /// To have loaded what is seen from poses.
    Prefetch {
        /// `world_from_rig` each.
        poses: Vec<Pose>,
    },
    /// A new episode.
    Reset {
        /// Its seed.
        seed: u64,
        /// Its start.
        start: Option<Start>,
    },
    /// Another version of the twin; the latest if none is said.
    SwitchVersion {
        /// The version.
        version: Option<u64>,
    },
    /// The end of the session.
    Close,
    /// A session of an earlier connection.
    Resume {
        /// Its name.
        session: String,
        /// Last request whose answer arrived.
        last_seq: u64,
    },
}

/// Reads a text frame.
pub(crate) fn parse(text: &str) -> Parsed {
    use serde_json::error::Category;
    let error = match serde_json::from_str::<Request>(text) {
        Ok(request) => return checked(text, request),
        Err(error) => error,
    };
    if let Some((seq, field)) = not_finite(text) {
        return Parsed::refused(seq, Fault::NotFinite { field });
    }
    // An error of the data stops the parser: the rest may still not be JSON.
    let rest = serde_json::from_str::<serde::de::IgnoredAny>(text).err();
    match (error.classify(), rest) {
        (Category::Data, None) => Parsed::refused(seq_of(text), invalid(text, &error)),
        (_, rest) => {
            let reason = rest.unwrap_or(error).to_string();
            Parsed::Unnumbered(Fault::MalformedJson(reason))
        }
    }
}

impl Parsed {
    fn refused(seq: Option<u64>, fault: Fault) -> Self {
        match seq {
            Some(seq) => Self::Numbered { seq, command: Err(fault) },
            None => Self::Unnumbered(fault),
        }
    }
}

/// A request, unless it says more than was understood.
fn checked(text: &str, request: Request) -> Parsed {
    let unknown = serde_json::from_str(text)
        .and_then(|sent| Ok(unknown_field(&sent, &serde_json::to_value(&request)?)));
    let (seq, command) = convert(request);
    let command = match unknown {
        Ok(None) => command,
        Ok(Some(field)) => {
            let reason = format!("there is no field {field}");
            Err(Fault::InvalidRequest { field: Some(field), reason })
        }
        Err(error) => Err(Fault::Internal(error.to_string())),
    };
    Parsed::Numbered { seq, command }
}

/// What is wrong with something that is JSON but no request.
fn invalid(text: &str, error: &serde_json::Error) -> Fault {
    // Behind the tag `type` serde forgets where it was, so that every field is read once more.
    let deserializer = &mut serde_json::Deserializer::from_str(text);
    match serde_path_to_error::deserialize::<_, Fields>(deserializer) {
        Err(found) if found.path().iter().next().is_some() => {
            let (field, reason) = (found.path().to_string(), found.inner());
            Fault::InvalidRequest { reason: format!("{field}: {reason}"), field: Some(field) }
        }
        _ => Fault::InvalidRequest { field: None, reason: error.to_string() },
    }
}

/// Every field of any request.
#[derive(Deserialize)]
#[expect(dead_code, reason = "read for the path to a mistake, not for the values")]
struct Fields {
    seq: Option<u64>,
    client: Option<message::ClientInfo>,
    protocols: Option<Vec<String>>,
    twin: Option<String>,
    version: Option<u64>,
    session: Option<String>,
    seed: Option<u64>,
    start: Option<message::Start>,
    rig: Option<message::RigChoice>,
    profile: Option<serde_json::Map<String, serde_json::Value>>,
    outputs: Option<message::Outputs>,
    dt_us: Option<i64>,
    deadline_ms: Option<u64>,
    decision_us: Option<i64>,
    warm_up_us: Option<i64>,
    pose: Option<message::Pose>,
    trajectory: Option<Vec<message::TimedPose>>,
    action: Option<message::Action>,
    dynamics: Option<message::DynamicsChoice>,
    poses: Option<Vec<message::Pose>>,
    terminate: Option<bool>,
    last_seq: Option<u64>,
}

fn convert(request: Request) -> (u64, Result<Command, Fault>) {
    match request {
        Request::Hello { seq, client, protocols } => {
            let command = if protocols.iter().any(|offered| offered == SUBPROTOCOL) {
                Ok(Command::Hello { client: format!("{} {}", client.name, client.version) })
            } else {
                Err(Fault::UnsupportedProtocol { server: SUBPROTOCOL, offered: protocols })
            };
            (seq, command)
        }
        Request::Open(open) => (open.seq, open_command(*open)),
        Request::Step { seq, pose, trajectory, action, terminate } => {
            let movement = movement_of(pose, trajectory, action);
            (seq, movement.map(|movement| Command::Step { movement, terminate }))
        }
        Request::Observe { seq, poses } => {
            let poses = poses_of(&poses, wildcity_session::limits::OBSERVE_POSES);
            (seq, poses.map(|poses| Command::Observe { poses }))
        }
        Request::Prefetch { seq, poses } => {
            let poses = poses_of(&poses, wildcity_session::limits::PREFETCH_POSES);
            (seq, poses.map(|poses| Command::Prefetch { poses }))
        }
        Request::Reset { seq, seed, start } => {
            let start = start.map(start_of).transpose();
            (seq, start.map(|start| Command::Reset { seed, start }))
        }
        Request::SwitchVersion { seq, version } => (seq, Ok(Command::SwitchVersion { version })),
        Request::Close { seq } => (seq, Ok(Command::Close)),
        Request::Resume { seq, session, last_seq } => {
            let command =
                name_of("session", session).map(|session| Command::Resume { session, last_seq });
            (seq, command)
        }
    }
}

fn open_command(open: message::Open) -> Result<Command, Fault> {
    let name = open.session.map(|name| name_of("session", name)).transpose()?;
    let rig = match open.rig {
        None => None,
        Some(message::RigChoice::Preset(name)) => Some(RigChoice::Preset(name)),
        Some(message::RigChoice::Full(rig)) => Some(RigChoice::Full(rig_of(rig)?)),
    };
    let message::Outputs {
        cameras,
        images,
        encoding,
        quality,
        depth,
        opacity,
        normals,
        frames,
        trust,
        period_us,
    } = open.outputs;
    let part = |message::ImagePart { crop, size }| ImagePart { crop, size };
    let (trust, periods_us) = (trust.unwrap_or(false), period_us.unwrap_or_default());
    let encoding = match encoding {
        message::Encoding::Jpeg => {
            Encoding::Jpeg(quality.unwrap_or(wildcity_session::limits::JPEG_QUALITY))
        }
        message::Encoding::Png => Encoding::Png,
        message::Encoding::Raw => Encoding::Raw,
    };
    let opening = SessionOptions {
        twin: name_of("twin", open.twin)?,
        version: open.version,
        seed: open.seed,
        start: open.start.map(start_of).transpose()?,
        rig,
        profile: ProfileOverrides::new(open.profile),
        outputs: Outputs {
            cameras,
            images: images.into_iter().map(|(name, image)| (name, part(image))).collect(),
            encoding,
            maps: PixelMaps { depth, opacity, normals: normals.unwrap_or(false) },
            frames,
            trust,
            periods_us,
        },
        dynamics: open.dynamics.map(dynamics_of).transpose()?.unwrap_or_default(),
        dt_us: open.dt_us,
        deadline: open.deadline_ms.map(Duration::from_millis),
        decision_us: open.decision_us,
        warm_up_us: open.warm_up_us.unwrap_or(0),
    };
    Ok(Command::Open { name, opening: Box::new(opening) })
}

fn dynamics_of(choice: message::DynamicsChoice) -> Result<Dynamics, Fault> {
    let message::Dynamics { model, speed, reverse } = match choice {
        message::DynamicsChoice::Full(dynamics) => dynamics,
        message::DynamicsChoice::Model(model) => {
            message::Dynamics { model, speed: 0.0, reverse: false }
        }
    };
    let model = match model {
        message::DynamicsModel::Teleport => EgoModel::Teleport,
        message::DynamicsModel::Kinematic => EgoModel::Kinematic,
        message::DynamicsModel::Dynamic => EgoModel::Dynamic,
    };
    Ok(Dynamics::checked(model, speed, reverse).map_err(SessionError::from)?)
}

fn movement_of(
    pose: Option<message::Pose>,
    trajectory: Option<Vec<message::TimedPose>>,
    action: Option<message::Action>,
) -> Result<wildcity_sim::Command, Fault> {
    match (pose, trajectory, action) {
        (Some(pose), None, None) => pose_of("pose", &pose).map(wildcity_sim::Command::Pose),
        (None, Some(poses), None) => {
            // One more than is accepted tells the check that there are too many.
            let poses = poses.iter().take(wildcity_sim::limits::PATH_POSES + 1).enumerate();
            let timed = |(index, timed): (usize, &message::TimedPose)| {
                let start_from_rig = pose_of(&format!("trajectory[{index}].pose"), &timed.pose)?;
                Ok(TimedPose { time_us: timed.time_us, start_from_rig })
            };
            let path = Path::checked(poses.map(timed).collect::<Result<_, Fault>>()?);
            Ok(wildcity_sim::Command::Path(path.map_err(SessionError::from)?))
        }
        (None, None, Some(message::Action { acceleration, curvature })) => {
            let action = Action::checked(acceleration, curvature);
            Ok(wildcity_sim::Command::Action(action.map_err(SessionError::from)?))
        }
        _ => {
            let reason = "a step has exactly one of pose, trajectory and action".to_owned();
            Err(Fault::InvalidRequest { field: Some("pose".to_owned()), reason })
        }
    }
}

fn start_of(start: message::Start) -> Result<Start, Fault> {
    Ok(match start {
        message::Start::Pose { pose } => Start::Pose(pose_of("start.pose", &pose)?),
        message::Start::Station { trajectory, station_m } => {
            Start::Station { trajectory, station_m }
        }
    })
}

fn rig_of(rig: message::Rig) -> Result<Rig, Fault> {
    let refused = |field: &str| {
        let field = field.to_owned();
        move |cause| Fault::Rig { field, cause }
    };
    let mut cameras = Vec::new();
    // One more than is accepted tells the check that there are too many.
    for (index, camera) in rig.cameras.into_iter().take(Rig::MAX_CAMERAS + 1).enumerate() {
        cameras.push(camera_of(&format!("rig.cameras[{index}]"), camera)?);
        // Before the next one is unpacked.
        check_overlays(&cameras).map_err(refused("rig.cameras"))?;
    }
    let rig = Rig { name: name_of("rig.name", rig.name)?, cameras };
    rig.check().map_err(refused("rig.cameras"))?;
    Ok(rig)
}

fn camera_of(field: &str, camera: message::RigCamera) -> Result<RigCamera, Fault> {
    let message::RigCamera { name, width, height, fx, fy, cx, cy, camera_to_rig, .. } = camera;
    let name = name_of(&format!("{field}.name"), name)?;
    let rig_from_camera = pose_of(&format!("{field}.camera_to_rig"), &camera_to_rig)?;
    let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    let intrinsics = Intrinsics {
        size_px,
        focal_px: [fx, fy],
        center_px: [cx, cy],
        lens: camera.lens.map(lens_of),
        windshield: camera.windshield.map(windshield_of),
    };
    let fault = |cause| Fault::Camera { field: field.to_owned(), cause };
    let checked = intrinsics.camera().and_then(|camera| camera.check().map(|()| camera));
    let shutter = camera.shutter.map(shutter_of).transpose().map_err(fault)?;
    let checked = checked.map_err(fault)?;
    let looks = appearance_of(camera.exposure, camera.overlay.as_deref(), size_px);
    let appearance = looks.and_then(|looks| looks.check(size_px).map(|()| looks));
    let appearance = appearance.map_err(|cause| Fault::Appearance {
        field: format!("{field}.{}", cause.field()),
        cause,
    })?;
    Ok(RigCamera { name, camera: checked, rig_from_camera, shutter, appearance })
}

fn name_of(field: &str, name: String) -> Result<String, Fault> {
    if is_name(&name) { Ok(name) } else { Err(Fault::InvalidName { field: field.into(), name }) }
}

pub(super) fn pose_of(field: &str, pose: &message::Pose) -> Result<Pose, Fault> {
    Pose::checked(pose.xyz, pose.q).map_err(|cause| Fault::Pose { field: field.into(), cause })
}

/// The poses of a request that may have so many.
fn poses_of(poses: &[message::Pose], most: usize) -> Result<Vec<Pose>, Fault> {
    // One more than is accepted tells the session that there are too many.
    let poses = poses.iter().take(most + 1).enumerate();
    poses.map(|(index, pose)| pose_of(&format!("poses[{index}]"), pose)).collect()
}

/// The number of something that has one but is no request.
fn seq_of(text: &str) -> Option<u64> {
    #[derive(Deserialize)]
    struct Numbered {
        seq: u64,
    }
    serde_json::from_str::<Numbered>(text).ok().map(|numbered| numbered.seq)
}

/// Finds NaN or infinity in a pose, and the number of the request.
///
/// JSON has no word for them, but agents that divide by zero say them all the same: Python writes
/// `NaN`, JavaScript `null`, others `1e999`. They deserve a better answer than "not JSON".
fn not_finite(text: &str) -> Option<(Option<u64>, String)> {
    let value: serde_json::Value = serde_json::from_str(&without_infinities(text)).ok()?;
    let seq = value.get("seq").and_then(serde_json::Value::as_u64);
    let in_pose = |name: &str, pose: &serde_json::Value| {
        ["xyz", "q"].into_iter().find_map(|part| {
            let numbers = pose.get(part)?.as_array()?;
            let index = numbers.iter().position(serde_json::Value::is_null)?;
            Some(format!("{name}.{part}[{index}]"))
        })
    };
    let single = ["/pose", "/start/pose"]
        .into_iter()
        .find_map(|pointer| in_pose(&pointer[1..].replace('/', "."), value.pointer(pointer)?));
    let of_list = |pointer: &str, name: &str, inner: &str| {
        let list = value.pointer(pointer)?.as_array()?;
        list.iter().enumerate().find_map(|(index, entry)| {
            let pose = if inner.is_empty() { Some(entry) } else { entry.get(&inner[1..]) };
            in_pose(&format!("{name}[{index}]{inner}"), pose?)
        })
    };
    let field = single
        .or_else(|| of_list("/poses", "poses", ""))
        .or_else(|| of_list("/trajectory", "trajectory", ".pose"))
        .or_else(|| {
            let parts = ["acceleration", "curvature"];
            let is_null = |part: &&str| {
                value.pointer(&format!("/action/{part}")).is_some_and(serde_json::Value::is_null)
            };
            parts.into_iter().find(is_null).map(|part| format!("action.{part}"))
        })
        .or_else(|| of_list("/rig/cameras", "rig.cameras", ".camera_to_rig"))?;
    Some((seq, field))
}

/// The text with every bare number that is not finite replaced by `null`.
fn without_infinities(text: &str) -> String {
    let is_number = |c: char| c.is_ascii_alphanumeric() || "+-.".contains(c);
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let end = if first == '"' {
            string_end(rest)
        } else if is_number(first) {
            rest.find(|c| !is_number(c)).unwrap_or(rest.len())
        } else {
            first.len_utf8()
        };
        let (token, after) = rest.split_at(end);
        let infinite = is_number(first) && token.parse::<f64>().is_ok_and(|x| !x.is_finite());
        out.push_str(if infinite { "null" } else { token });
        rest = after;
    }
    out
}

/// Length of the string literal at the start of a text, its quotes included.
fn string_end(text: &str) -> usize {
    let mut escaped = true;
    for (index, byte) in text.bytes().enumerate() {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = true,
            b'"' => return index + 1,
            _ => {}
        }
    }
    text.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_finite_is_found_in_every_dialect() {
        let step = |x: &str| {
            format!(r#"{{"type":"step","seq":3,"pose":{{"xyz":[0,{x},0],"q":[1,0,0,0]}}}}"#)
        };
        for x in ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "null"] {
            let Parsed::Numbered { seq: 3, command } = parse(&step(x)) else { panic!("{x}") };
            let field = field_of(command);
            assert_eq!(field, "pose.xyz[1]", "{x}");
        }
        assert!(command(&step("1e308")).is_err(), "too far");
        assert!(command(&step("1.5")).is_ok());
        for x in ["nope", "\"1\"", "1e", "[1]"] {
            let fault = command(&step(x)).unwrap_err();
            assert!(!matches!(fault, Fault::NotFinite { .. }), "{x}: {fault}");
        }
    }

    fn command(text: &str) -> Result<Command, Fault> {
        match parse(text) {
            Parsed::Numbered { command, .. } => command,
            Parsed::Unnumbered(fault) => Err(fault),
        }
    }

    fn field_of(command: Result<Command, Fault>) -> String {
        match command {
            Err(Fault::NotFinite { field }) => field,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn poses_in_lists_are_named() {
        let unit = r#"{"xyz":[0,0,0],"q":[1,0,0,0]}"#;
        let bad = r#"{"xyz":[0,0,0],"q":[1,0,NaN,0]}"#;
        let observe = format!(r#"{{"type":"observe","seq":0,"poses":[{unit},{bad}]}}"#);
        assert_eq!(field_of(command(&observe)), "poses[1].q[2]");
        let camera = format!(r#"{{"name":"NaN \" NaN","camera_to_rig":{bad}}}"#);
        let open = format!(r#"{{"type":"open","seq":1,"rig":{{"cameras":[{camera}]}}}}"#);
        assert_eq!(field_of(command(&open)), "rig.cameras[0].camera_to_rig.q[2]");
    }

    #[test]
    fn strings_are_left_alone() {
        let text = r#"{"a":"NaN, \"NaN\\","b":[NaN,1.5,true]}"#;
        let clean = r#"{"a":"NaN, \"NaN\\","b":[null,1.5,true]}"#;
        assert_eq!(without_infinities(text), clean);
        assert_eq!(without_infinities("\"open"), "\"open");
    }

    #[test]
    fn deep_nesting_is_malformed() {
        let fault = command(&"[".repeat(100_000)).unwrap_err();
        assert!(matches!(fault, Fault::MalformedJson(_)), "{fault}");
    }
}
