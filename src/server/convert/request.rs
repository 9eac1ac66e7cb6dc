//! Parses text frames as commands.

use std::collections::BTreeSet;

use crate::fault::Fault;
use crate::limits;
use wildcity_protocol::PROTOCOL;
use wildcity_protocol::decode::{Refused, decode};
use wildcity_protocol::message::{self, Open, Request};
use wildcity_scene::geometry::Pose;
use wildcity_session::is_episode_name;
use wildcity_session::{ResetOptions, SessionError, StepOptions};
use wildcity_sim::ego::{Action, Path, TimedPose};

use super::drive::DriveRequest;
use super::field::{check_name, convert_pose, convert_poses};

/// A text frame, checked as far as it can be without a session.
#[derive(Debug)]
pub(crate) enum Parsed {
    /// A request with a number that could be read.
    Numbered {
        seq: u64,
        /// The session of the connection that it names, if any.
        session: Option<String>,
        /// The command, or why the request is refused.
        command: Result<Command, Fault>,
    },
    /// The number could not be read.
    Unnumbered(Fault),
}

/// Action of a request.
#[derive(Debug)]
pub(crate) enum Command {
    Hello {
        /// Name and version of the client.
        client: String,
    },
    /// Asks for observations in shared memory.
    ShareMemory {
        /// The text that is in the memory, once the client has opened it.
        proof: Option<String>,
    },
    Open {
        /// Its name, if the client chose one.
        name: Option<String>,
        /// Options of the session.
        opening: Box<Open>,
        /// The part of a recorded drive that the answer is to have.
        drive: Option<DriveRequest>,
    },
    /// Carries out a step.
    Step {
        /// How the ego moves.
        movement: wildcity_sim::Command,
        /// How long, whether it is the last step, and notes.
        options: StepOptions,
    },
    /// Carries out steps of several sessions of the connection.
    StepMany {
        /// The steps, each of another session.
        steps: Vec<SessionStep>,
    },
    /// Renders images of poses.
    Observe {
        /// The pose `world_from_rig` of each view.
        poses: Vec<Pose>,
    },
    /// Loads the sections that are visible from poses.
    Prefetch {
        /// The pose `world_from_rig` of each view.
        poses: Vec<Pose>,
    },
    /// Begins a new episode.
    Reset {
        /// Seed, start and dynamics.
        options: ResetOptions,
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
        from: BranchPoint,
    },
    Close,
    /// Takes over a session of an earlier connection.
    Resume {
        session: String,
        /// Number of the last request with an answer that arrived.
        last_seq: u64,
        /// The other sessions of the connection that was lost.
        also: Vec<String>,
    },
}

/// The step of one session among several.
#[derive(Debug)]
pub(crate) struct SessionStep {
    /// Name of the session.
    pub(crate) session: String,
    /// How the ego moves, and for how long; or why this session's step is refused.
    pub(crate) step: Result<(wildcity_sim::Command, StepOptions), Fault>,
}

/// A state of an episode, with names that are checked.
#[derive(Debug)]
pub(crate) enum BranchPoint {
    /// A snapshot of a session.
    Snapshot { session: String, snapshot: String },
    /// A step of a recorded episode.
    Recorded { episode: String, step: u64 },
}

/// Reads a text frame.
pub(crate) fn parse(text: &str) -> Parsed {
    match decode::<Request>(text) {
        Ok(request) => convert(request),
        Err(Refused { seq: Some(seq), mistake }) => {
            Parsed::Numbered { seq, session: None, command: Err(mistake.into()) }
        }
        Err(Refused { seq: None, mistake }) => Parsed::Unnumbered(mistake.into()),
    }
}

/// The number, the session and the command of a request.
fn convert(request: Request) -> Parsed {
    // Requests that are not for one of several sessions.
    let general = |seq, command| Parsed::Numbered { seq, session: None, command };
    match request {
        Request::Hello { seq, client, protocols } => {
            let command = if protocols.iter().any(|offered| offered == PROTOCOL) {
                Ok(Command::Hello { client: format!("{} {}", client.name, client.version) })
            } else {
                Err(Fault::UnsupportedProtocol { server: PROTOCOL, offered: protocols })
            };
            general(seq, command)
        }
        Request::ShareMemory { seq, proof } => general(seq, Ok(Command::ShareMemory { proof })),
        Request::Open(open) => general(open.seq, open_command(*open)),
        // The three are separate fields on the wire, of which one must be given.
        Request::Step { seq, session, pose, trajectory, action, until_us, notes, terminate } => {
            let movement = convert_movement(pose, trajectory, action);
            let options = StepOptions { until_us, terminate, notes };
            on(seq, session, movement.map(|movement| Command::Step { movement, options }))
        }
        Request::StepMany { seq, steps } => general(seq, many_command(steps)),
        Request::Observe { seq, session, poses } => {
            let poses = convert_poses("poses", &poses, wildcity_session::limits::OBSERVE_POSES);
            on(seq, session, poses.map(|poses| Command::Observe { poses }))
        }
        Request::Prefetch { seq, session, poses } => {
            let poses = convert_poses("poses", &poses, wildcity_session::limits::PREFETCH_POSES);
            on(seq, session, poses.map(|poses| Command::Prefetch { poses }))
        }
        Request::Reset { seq, session, seed, start, dynamics, speed } => {
            let options = ResetOptions { seed, start, dynamics, speed_m_s: speed };
            on(seq, session, Ok(Command::Reset { options }))
        }
        Request::SwitchVersion { seq, session, version } => {
            on(seq, session, Ok(Command::SwitchVersion { version }))
        }
        Request::Snapshot { seq, session, name } => {
            on(seq, session, check_name("name", name).map(|name| Command::Snapshot { name }))
        }
        Request::Restore { seq, session, name } => {
            on(seq, session, check_name("name", name).map(|name| Command::Restore { name }))
        }
        Request::Branch(branch) => general(branch.seq, branch_command(branch)),
        Request::Close { seq, session } => on(seq, session, Ok(Command::Close)),
        Request::Resume { seq, session, last_seq, also } => {
            general(seq, resume_command(session, last_seq, also))
        }
    }
}

/// A request for one session of the connection.
fn on(seq: u64, session: Option<String>, command: Result<Command, Fault>) -> Parsed {
    match session.map(|name| check_name("session", name)).transpose() {
        Ok(session) => Parsed::Numbered { seq, session, command },
        // A session that cannot be named is the first fault, whatever the rest of the request is.
        Err(fault) => Parsed::Numbered { seq, session: None, command: Err(fault) },
    }
}

/// Steps of several sessions. An invalid list is refused as a whole; a number out of range refuses
/// only its own step.
fn many_command(steps: Vec<message::SessionStep>) -> Result<Command, Fault> {
    let most = limits::CONNECTION_SESSIONS;
    if !(1..=most).contains(&steps.len()) {
        let must = format!("{} steps; 1 to {most} are accepted", steps.len());
        return Err(Fault::OutOfRange { field: "steps".to_owned(), must });
    }
    // Two steps of one session would have to be ordered, so a list has each session once.
    let mut names = BTreeSet::new();
    let step = |(index, step): (usize, message::SessionStep)| {
        let message::SessionStep { session, pose, trajectory, action, until_us, notes, terminate } =
            step;
        let field = format!("steps[{index}].session");
        let session = check_name(&field, session)?;
        if !names.insert(session.clone()) {
            return Err(Fault::SessionTwice { field, name: session });
        }
        let step = match convert_movement(pose, trajectory, action) {
            // A step with two movements is a mistake of the client's program, and refuses the list.
            // A pose out of range may come from its model, and refuses its own step.
            Err(Fault::InvalidRequest { field, reason }) => {
                let field = field.map(|field| format!("steps[{index}].{field}"));
                return Err(Fault::InvalidRequest { field, reason });
            }
            Err(fault) => Err(fault),
            Ok(movement) => Ok((movement, StepOptions { until_us, terminate, notes })),
        };
        Ok(SessionStep { session, step })
    };
    let steps = steps.into_iter().enumerate().map(step).collect::<Result<_, Fault>>()?;
    Ok(Command::StepMany { steps })
}

fn resume_command(session: String, last_seq: u64, also: Vec<String>) -> Result<Command, Fault> {
    let session = check_name("session", session)?;
    // With the first session these are all that a connection can have had.
    let most = limits::CONNECTION_SESSIONS - 1;
    if also.len() > most {
        let must = format!("{} sessions; at most {most} are accepted", also.len());
        return Err(Fault::OutOfRange { field: "also".to_owned(), must });
    }
    let mut names = BTreeSet::from([session.clone()]);
    let other = |(index, name): (usize, String)| {
        let field = format!("also[{index}]");
        let name = check_name(&field, name)?;
        if names.insert(name.clone()) { Ok(name) } else { Err(Fault::SessionTwice { field, name }) }
    };
    let also = also.into_iter().enumerate().map(other).collect::<Result<_, Fault>>()?;
    Ok(Command::Resume { session, last_seq, also })
}

/// The session checks the options; the server reads the name and the drive.
fn open_command(mut open: Open) -> Result<Command, Fault> {
    let name = open.session.take().map(|name| check_name("session", name)).transpose()?;
    let drive = open.trajectory.take().map(Into::into);
    Ok(Command::Open { name, opening: Box::new(open), drive })
}

fn branch_command(branch: message::Branch) -> Result<Command, Fault> {
    let name = branch.session.map(|name| check_name("session", name)).transpose()?;
    let from = match branch.from {
        message::BranchPoint::Snapshot { session, snapshot } => BranchPoint::Snapshot {
            session: check_name("from.session", session)?,
            snapshot: check_name("from.snapshot", snapshot)?,
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

fn convert_movement(
    pose: Option<message::Pose>,
    trajectory: Option<Vec<message::TimedPose>>,
    action: Option<message::Action>,
) -> Result<wildcity_sim::Command, Fault> {
    match (pose, trajectory, action) {
        (Some(pose), None, None) => convert_pose("pose", &pose).map(wildcity_sim::Command::Pose),
        (None, Some(poses), None) => {
            // Reads at most one pose more than the maximum, which is enough for the check to refuse
            // the list.
            let poses = poses.iter().take(wildcity_sim::limits::PATH_POSES + 1).enumerate();
            let timed = |(index, timed): (usize, &message::TimedPose)| {
                let start_from_rig =
                    convert_pose(&format!("trajectory[{index}].pose"), &timed.pose)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_finite_is_found_in_every_dialect() {
        let step = |x: &str| {
            format!(r#"{{"type":"step","seq":3,"pose":{{"xyz":[0,{x},0],"q":[1,0,0,0]}}}}"#)
        };
        // Literals of JavaScript and Python, numbers beyond f64, and what JSON writers make of
        // them.
        for x in ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "null"] {
            let Parsed::Numbered { seq: 3, command, .. } = parse(&step(x)) else { panic!("{x}") };
            let field = fault_field(command);
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

    fn fault_field(command: Result<Command, Fault>) -> String {
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
        assert_eq!(fault_field(command(&observe)), "poses[1].q[2]");
        // A NaN within a text, with an escaped quotation mark, is no number.
        let camera = format!(r#"{{"name":"NaN \" NaN","camera_to_rig":{bad}}}"#);
        let open = format!(r#"{{"type":"open","seq":1,"rig":{{"cameras":[{camera}]}}}}"#);
        assert_eq!(fault_field(command(&open)), "rig.cameras[0].camera_to_rig.q[2]");
    }

    #[test]
    fn deep_nesting_is_malformed() {
        let fault = command(&"[".repeat(100_000)).unwrap_err();
        assert!(matches!(fault, Fault::MalformedJson(_)), "{fault}");
    }
}
