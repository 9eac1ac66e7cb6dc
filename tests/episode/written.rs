//! Episodes' files as a session writes them, made up for the tests.

use std::fs;
use std::path::Path;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};

use wildcity_episode::{
    ActorLine, ActorsLine, EgoLine, EpisodeFile, EventLine, RoutePoint, ScenarioLine,
};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_sim::contact::Contact;
use wildcity_sim::ego::TimedPose;
use wildcity_sim::traffic::{ActorSpec, ActorState, EgoBox};

/// An episode of `steps` steps of 0.1 s.
#[derive(Clone)]
pub(crate) struct Made {
    /// Steps.
    pub(crate) steps: u64,
    /// Speed of the ego along x, in m/s.
    pub(crate) speed_mps: f64,
    /// Number of actors, in two rows beside the road.
    pub(crate) actors: u16,
    /// Poses of the plan that is the command of each step; 0 for an action.
    pub(crate) plan_poses: u32,
    /// Contacts, each with the step at which it is written.
    pub(crate) contacts: Vec<(u64, Contact)>,
    /// Outcome of the last line; none to leave it out.
    pub(crate) outcome: Option<&'static str>,
}

impl Default for Made {
    fn default() -> Self {
        let contacts = Vec::new();
        let outcome = Some("completed");
        Self { steps: 50, speed_mps: 10.0, actors: 2, plan_poses: 0, contacts, outcome }
    }
}

pub(crate) fn ego_at(x_m: f64) -> Pose {
    Pose { position_m: DVec3::new(x_m, 0.0, 0.1), rotation: DQuat::from_rotation_z(1e-3 * x_m) }
}

fn actor_at(index: u16, step: u64) -> ActorState {
    let row = f64::from(index % 2);
    let speed_mps = 3.7 + 0.1 * f64::from(index);
    let x_m = 8.1 * f64::from(index) + 0.1 * speed_mps * step as f64;
    let rotation = DQuat::from_rotation_z(0.013 * f64::from(index) + 1e-3 * step as f64);
    ActorState {
        index,
        world_from_actor: Pose { position_m: DVec3::new(x_m, 20.3 + 3.1 * row, 0.07), rotation },
        velocity_mps: rotation * (speed_mps * DVec3::X),
        yaw_rate_radps: 0.01,
        present: true,
    }
}

impl Made {
    /// The lines of the file.
    pub(crate) fn lines(&self) -> Vec<Value> {
        let car = ActorBox { length_m: 4.2, width_m: 1.8, height_m: 1.5 };
        let ego = EgoBox {
            box_: ActorBox { length_m: 5.0, width_m: 2.0, height_m: 1.5 },
            center_x_m: 1.3,
        };
        let spec = |index: u16| ActorSpec {
            name: format!("car{index}"),
            class: ActorClass::Vehicle,
            box_: car,
            asset: None,
        };
        let route = (0..=100).map(|k| RoutePoint(k * 100_000, [k as f64, 0.0, 0.1]));
        let scenario = ScenarioLine {
            name: "made".to_owned(),
            hash: "0".repeat(64),
            scenario: json!({ "name": "made" }),
            ego: EgoLine::new(&ego),
            actors: (0..self.actors).map(|index| ActorLine::new(&spec(index))).collect(),
            route: route.collect(),
            way: Vec::new(),
            limit_us: Some(self.steps as i64 * 100_000),
            least_progress: 0.8,
            lanes: Vec::new(),
            ground: Vec::new(),
            checks_static: false,
        };
        let mut lines = vec![header(), tagged("scenario", &scenario)];
        for step in 0..=self.steps {
            let states: Vec<ActorState> =
                (0..self.actors).map(|index| actor_at(index, step)).collect();
            let time_us = step as i64 * 100_000;
            lines.push(tagged("actors", &ActorsLine::new(step, time_us, &states)));
            let due = self.contacts.iter().filter(|(at, _)| *at == step);
            lines.extend(
                due.map(|(_, contact)| tagged("event", &EventLine::contact(step, contact))),
            );
            let mut frame = frame(step, &ego_at(0.1 * self.speed_mps * step as f64));
            if self.plan_poses > 0 && step > 0 {
                frame["command"] = json!({ "trajectory": self.plan(step) });
            }
            lines.push(frame);
        }
        if let Some(outcome) = self.outcome {
            let steps = self.steps;
            lines.push(json!({ "kind": "end", "outcome": outcome, "steps": steps,
                "time_us": steps * 100_000, "distance_m": 0.1 * self.speed_mps * steps as f64 }));
        }
        lines
    }

    /// A plan with all digits, which differs from step to step.
    fn plan(&self, step: u64) -> Vec<Value> {
        let pose = |k: u32| {
            let time_s = 0.1 * f64::from(k);
            let turned = 0.037 * (0.31 * step as f64).sin() * time_s;
            let ahead_m = self.speed_mps * time_s * (0.5 * turned).cos();
            let position_m = DVec3::new(ahead_m, 0.5 * turned * time_s, 1e-3 * turned);
            let start_from_rig = Pose { position_m, rotation: DQuat::from_rotation_z(turned) };
            json!(TimedPose { time_us: 100_000 * i64::from(k), start_from_rig })
        };
        (1..=self.plan_poses).map(pose).collect()
    }

    /// Writes the file and reads it.
    pub(crate) fn read(&self) -> EpisodeFile {
        read(&self.lines())
    }
}

/// Writes lines and reads them.
pub(crate) fn read(lines: &[Value]) -> EpisodeFile {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("made-1.jsonl");
    write(&path, lines);
    EpisodeFile::read(&path).unwrap()
}

/// Writes lines.
pub(crate) fn write(path: &Path, lines: &[Value]) {
    let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
    fs::write(path, text).unwrap();
}

fn tagged(kind: &str, line: &impl serde::Serialize) -> Value {
    // By its text: as a value, an f32 would have the digits of an f64.
    let mut value: Value = serde_json::from_str(&serde_json::to_string(line).unwrap()).unwrap();
    value["kind"] = kind.into();
    value
}

fn header() -> Value {
    let camera = |name: &str| json!({ "name": name });
    json!({
        "kind": "episode", "format": 0, "build": "wildcity 0.1.0", "session": "made", "twin": "street",
        "version": 1, "version_hash": "a".repeat(64), "profile": { "near_m": 0.1 },
        "profile_hash": "b".repeat(64), "backend": "cpu", "rig": { "name": "two",
        "cameras": [camera("left"), camera("right")] }, "outputs": {}, "seed": 7,
        "dynamics": { "model": "kinematic", "speed_m_s": 10.0, "reverse": false },
        "start": ego_at(0.0), "dt_us": 100_000,
    })
}

fn frame(step: u64, pose: &Pose) -> Value {
    let hash = |what: &str| {
        let mixed = step.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ what.len() as u64;
        format!("{mixed:016x}").repeat(4)
    };
    let request = if step == 0 { "reset" } else { "step" };
    json!({
        "kind": "frame", "request": request, "step": step, "time_us": step * 100_000, "poses": [pose],
        "command": { "action": { "acceleration_m_s2": 0.0, "curvature_1_m": 0.0 } },
        "terminated": false, "frame_hash": hash("frame"), "images": [hash("left"), hash("right!")],
    })
}
