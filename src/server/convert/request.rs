//! Parses text frames as commands.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;

use crate::fault::Fault;
use wildcity_protocol::message::{self, Request};
use wildcity_protocol::{PROTOCOL, unknown_field};
use wildcity_scene::ProfileOverrides;
use wildcity_scene::geometry::Pose;
use wildcity_session::is_episode_name;
use wildcity_session::{
    Encoding, ImagePart, Outputs, PixelMaps, RigChoice, ScenarioOptions, ScenarioSource,
    SessionError, SessionOptions, Start,
};
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::{Dynamics, EgoModel};

use super::drive::DriveRequest;
use super::field::{name_of, pose_of, poses_of};
use super::non_finite::{NonFinite, find_non_finite};
use super::rig::rig_of;

/// A text frame, checked as far as it can be without a session.
#[derive(Debug)]
pub(crate) enum Parsed {
    /// A request with a number that could be read.
    Numbered {
        /// The number.
        seq: u64,
        /// The command, or why the request is refused.
        command: Result<Command, Fault>,
    },
    /// The number could not be read.
    Unnumbered(Fault),
}

/// What a request asks for.
#[derive(Debug)]
pub(crate) enum Command {
    /// Begins the connection.
    Hello {
        /// Name and version of the client.
        client: String,
    },
    /// Opens a session.
    Open {
        /// Its name, if the client chose one.
        name: Option<String>,
        /// What is opened.
        opening: Box<SessionOptions>,
        /// The part of a recorded drive that the answer is to have.
        drive: Option<DriveRequest>,
    },
    /// Carries out a step.
    Step {
        /// How the ego moves.
        movement: wildcity_sim::Command,
        /// Whether it is the last step.
        terminate: bool,
    },
    /// Renders images of poses.
    Observe {
        /// `world_from_rig` of each.
        poses: Vec<Pose>,
    },
    /// Loads what is seen from poses.
    Prefetch {
        /// `world_from_rig` of each.
        poses: Vec<Pose>,
    },
    /// Begins a new episode.
    Reset {
        /// Its seed.
        seed: u64,
        /// Its start.
        start: Option<Start>,
    },
    /// Switches to another version of the twin.
    SwitchVersion {
        /// The version; the latest if there is none.
        version: Option<u64>,
    },
    /// Stores the state of the episode.
    Snapshot {
        /// Name of the snapshot.
        name: String,
    },
    /// Returns to a snapshot.
    Restore {
        /// Name of the snapshot.
        name: String,
    },
    /// Opens a session in a state of another episode.
    Branch {
        /// Its name, if the client chose one.
        name: Option<String>,
        /// The state.
        from: BranchPoint,
    },
    /// Ends the session.
    Close,
    /// Takes over a session of an earlier connection.
    Resume {
        /// The session.
        session: String,
        /// Number of the last request with an answer that arrived.
        last_seq: u64,
    },
}

/// A state of an episode, with names that are checked.
#[derive(Debug)]
pub(crate) enum BranchPoint {
    /// A snapshot of a session.
    Snapshot {
        /// The session.
        session: String,
        /// The snapshot.
        snapshot: String,
    },
    /// A step of a recorded episode.
    Recorded {
        /// The episode.
        episode: String,
        /// Steps done.
        step: u64,
    },
}

/// Reads a text frame.
pub(crate) fn parse(text: &str) -> Parsed {
    use serde_json::error::Category;
    let error = match serde_json::from_str::<Request>(text) {
        Ok(request) => return checked(text, request),
        Err(error) => error,
    };
    if let Some(NonFinite { seq, field }) = find_non_finite(text) {
        return Parsed::refused(seq, Fault::NotFinite { field });
    }
    // An error in the data stops the parser before the rest, which may not be JSON.
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

/// A request, unless it has a field that was not understood.
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

/// What is wrong with a text that is JSON, but not a request.
fn invalid(text: &str, error: &serde_json::Error) -> Fault {
    // serde loses the path to a mistake behind the tag `type`: every field is read once more.
    let deserializer = &mut serde_json::Deserializer::from_str(text);
    match serde_path_to_error::deserialize::<_, Fields>(deserializer) {
        Err(found) if found.path().iter().next().is_some() => {
            let field = found.path().to_string();
            let reason = format!("{field}: {}", found.inner());
            Fault::InvalidRequest { reason, field: Some(field) }
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
    name: Option<String>,
    from: Option<message::BranchPoint>,
    dynamics: Option<message::DynamicsChoice>,
    scenario: Option<message::ScenarioChoice>,
    poses: Option<Vec<message::Pose>>,
    terminate: Option<bool>,
    last_seq: Option<u64>,
}

/// The number and the command of a request.
fn convert(request: Request) -> (u64, Result<Command, Fault>) {
    match request {
        Request::Hello { seq, client, protocols } => {
            let command = if protocols.iter().any(|offered| offered == PROTOCOL) {
                Ok(Command::Hello { client: format!("{} {}", client.name, client.version) })
            } else {
                Err(Fault::UnsupportedProtocol { server: PROTOCOL, offered: protocols })
            };
            (seq, command)
        }
        Request::Open(open) => (open.seq, open_command(*open)),
        Request::Step { seq, pose, trajectory, action, terminate } => {
            let movement = movement_of(pose, trajectory, action);
            (seq, movement.map(|movement| Command::Step { movement, terminate }))
        }
        Request::Observe { seq, poses } => {
            let poses = poses_of("poses", &poses, wildcity_session::limits::OBSERVE_POSES);
            (seq, poses.map(|poses| Command::Observe { poses }))
        }
        Request::Prefetch { seq, poses } => {
            let poses = poses_of("poses", &poses, wildcity_session::limits::PREFETCH_POSES);
            (seq, poses.map(|poses| Command::Prefetch { poses }))
        }
        Request::Reset { seq, seed, start } => {
            let start = start.map(start_of).transpose();
            (seq, start.map(|start| Command::Reset { seed, start }))
        }
        Request::SwitchVersion { seq, version } => (seq, Ok(Command::SwitchVersion { version })),
        Request::Snapshot { seq, name } => {
            (seq, name_of("name", name).map(|name| Command::Snapshot { name }))
        }
        Request::Restore { seq, name } => {
            (seq, name_of("name", name).map(|name| Command::Restore { name }))
        }
        Request::Branch(branch) => (branch.seq, branch_command(branch)),
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
        actors,
        period_us,
    } = open.outputs;
    let part = |message::ImagePart { crop, size }| ImagePart { crop, size };
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
            trust: trust.unwrap_or(false),
            periods_us: period_us.unwrap_or_default(),
        },
        scenario: open.scenario.map(|choice| {
            let (source, values) = scenario_of(choice);
            ScenarioOptions {
                source,
                values,
                dynamics: open.dynamics.is_none(),
                warm_up: open.warm_up_us.is_none(),
                actors: actors.unwrap_or(false),
            }
        }),
        dynamics: open.dynamics.map(dynamics_of).transpose()?.unwrap_or_default(),
        dt_us: open.dt_us,
        deadline: open.deadline_ms.map(Duration::from_millis),
        decision_us: open.decision_us,
        warm_up_us: open.warm_up_us.unwrap_or(0),
    };
    Ok(Command::Open { name, opening: Box::new(opening), drive: open.trajectory.map(Into::into) })
}

fn scenario_of(choice: message::ScenarioChoice) -> (ScenarioSource, BTreeMap<String, Value>) {
    match choice {
        message::ScenarioChoice::Name(name) => (ScenarioSource::Named(name), BTreeMap::new()),
        message::ScenarioChoice::Values { name, values } => {
            (ScenarioSource::Named(name), values.into_iter().collect())
        }
        message::ScenarioChoice::Inline(scenario) => {
            (ScenarioSource::Inline(Value::Object(scenario)), BTreeMap::new())
        }
    }
}

fn branch_command(branch: message::Branch) -> Result<Command, Fault> {
    let name = branch.session.map(|name| name_of("session", name)).transpose()?;
    let from = match branch.from {
        message::BranchPoint::Snapshot { session, snapshot } => BranchPoint::Snapshot {
            session: name_of("from.session", session)?,
            snapshot: name_of("from.snapshot", snapshot)?,
        },
        message::BranchPoint::Recorded { episode, step } => {
            if !is_episode_name(&episode) {
                return Err(Fault::InvalidName { field: "from.episode".into(), name: episode });
            }
            BranchPoint::Recorded { episode, step }
        }
    };
    Ok(Command::Branch { name, from })
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
            // Reads at most one pose more than the maximum, which is enough for the check to refuse the list.
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

/// The number of a text that is not a request but has a number.
fn seq_of(text: &str) -> Option<u64> {
    #[derive(Deserialize)]
    struct Numbered {
        seq: u64,
    }
    serde_json::from_str::<Numbered>(text).ok().map(|numbered| numbered.seq)
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
    fn deep_nesting_is_malformed() {
        let fault = command(&"[".repeat(100_000)).unwrap_err();
        assert!(matches!(fault, Fault::MalformedJson(_)), "{fault}");
    }
}
