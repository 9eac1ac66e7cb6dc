//! Parses text frames as commands.

use std::time::Duration;

use crate::fault::Fault;
use wildcity_protocol::PROTOCOL;
use wildcity_protocol::decode::{Refused, decode};
use wildcity_protocol::message::{self, Request};
use wildcity_scene::ProfileOverrides;
use wildcity_scene::geometry::Pose;
use wildcity_session::{
    Encoding, ImagePart, Outputs, PixelMaps, RigChoice, SessionError, SessionOptions, Start,
};
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::{Dynamics, EgoModel};

use super::field::{name_of, pose_of, poses_of};
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

/// Reads a text frame.
pub(crate) fn parse(text: &str) -> Parsed {
    match decode::<Request>(text) {
        Ok(request) => {
            let (seq, command) = convert(request);
            Parsed::Numbered { seq, command }
        }
        Err(Refused { seq: Some(seq), mistake }) => {
            Parsed::Numbered { seq, command: Err(mistake.into()) }
        }
        Err(Refused { seq: None, mistake }) => Parsed::Unnumbered(mistake.into()),
    }
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
        (pose, trajectory, _) => {
            // The second of two, or the first of none.
            let field = match (pose, trajectory) {
                (Some(_), Some(_)) => "trajectory",
                (None, None) => "pose",
                _ => "action",
            };
            let reason = "a step has exactly one of pose, trajectory and action".to_owned();
            Err(Fault::InvalidRequest { field: Some(field.to_owned()), reason })
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
            assert!(!matches!(fault, Fault::PoseNotFinite { .. }), "{x}: {fault}");
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
            Err(Fault::PoseNotFinite { field }) => field,
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
