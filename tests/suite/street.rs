//! A small twin with a straight drive, and suites on it.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use tempfile::TempDir;

use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_suite::{
    AgentChoice, BuiltIn, Case, CaseOptions, RunSettings, SuiteError, SuiteFile, SuiteResult,
    cases, run,
};
use wildcity_twin::store::{Catalog, NewVersion};

/// A directory with twins, suites and the results of runs.
pub(crate) struct Bench {
    pub(crate) dir: TempDir,
}

impl Bench {
    /// The twin `street`: 200 m at 10 m/s along x, posts next to it, two cameras.
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let count = 400;
        let gaussians = Gaussians {
            sh_degree: 0,
            means_m: (0..count)
                .map(|i| [f64::from(i % 200), if i < 200 { -5.0 } else { 5.0 }, 1.0])
                .collect(),
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; count as usize],
            ln_scales: vec![[-1.0; 3]; count as usize],
            logit_opacities: vec![2.0; count as usize],
            sh: (0..count * 3).map(|i| (i % 7) as f32 * 0.3 - 0.9).collect(),
            ..Gaussians::default()
        };
        let keyframe = |i: i64| Keyframe {
            time_us: 500_000 * i,
            world_from_rig: Pose {
                position_m: DVec3::new(5.0 * i as f64, 0.0, 0.0),
                rotation: DQuat::IDENTITY,
            },
        };
        let log =
            Trajectory { name: "log".to_owned(), keyframes: (0..=40).map(keyframe).collect() };
        let camera = |name: &str, yaw_rad: f64| {
            let pinhole = Pinhole { fx: 20.0, fy: 20.0, cx: 16.0, cy: 12.0 };
            // A camera looks along its z axis; the rig drives along x.
            let rotation = DQuat::from_rotation_z(yaw_rad) * DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
            let position_m = DVec3::new(1.5, 0.0, 1.6);
            RigCamera::new(
                name,
                Camera::from_pinhole(32, 24, pinhole),
                Pose { position_m, rotation },
            )
        };
        let rig = Rig::new("pair", vec![camera("front", 0.0), camera("left", 1.5)]);
        let new = NewVersion {
            rig: Some(rig),
            trajectories: vec![log],
            ..NewVersion::from_gaussians("street", &gaussians, Provenance::new("test".into()))
        };
        let bench = Self { dir };
        bench.catalog().commit(new, &mut |_, _| {}).unwrap();
        bench
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn catalog(&self) -> Catalog {
        Catalog::open(&self.path("twins")).unwrap()
    }

    /// Writes a JSON file.
    pub(crate) fn write(&self, name: &str, value: &Value) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, value.to_string()).unwrap();
        path
    }

    /// A suite of two scenarios with two seeds each: one on rails, one of a car with dynamics.
    pub(crate) fn suite(&self) -> PathBuf {
        self.write("rails.json", &scenario("rails", &json!({ "model": "teleport" })));
        self.write("car.json", &scenario("car", &json!({ "model": "kinematic", "speed": 10.0 })));
        self.write(
            "suite.json",
            &json!({ "format": "wildcity.suite/1", "name": "small", "note": "four episodes",
                "scenarios": ["rails.json", "car.json"], "seeds": [3, 4], "cameras": ["front"] }),
        )
    }

    /// The cases of a suite's file.
    #[expect(clippy::result_large_err, reason = "the package's own error, built once per test")]
    pub(crate) fn cases(&self, path: &Path) -> Result<Vec<Case>, SuiteError> {
        let (suite, scenarios) = SuiteFile::read(path)?;
        cases(&suite, &scenarios, &self.catalog(), CaseOptions::default())
    }

    pub(crate) fn settings(&self, agent: AgentChoice, jobs: usize, out: &str) -> RunSettings {
        RunSettings {
            suite: "small".to_owned(),
            agent,
            jobs,
            retries: 1,
            agent_timeout: Duration::from_secs(30),
            latest: false,
            at_least: None,
            // The street of these tests has no map.
            accept_unjudged: vec!["off_road".to_owned()],
            catalog: self.catalog(),
            twins: self.path("twins"),
            cache: None,
            scenarios: self.dir.path().to_owned(),
            backend: Arc::new(cpu()),
            episodes: self.path(out),
            mcap: true,
            progress: Box::new(|_| {}),
        }
    }

    /// Runs the suite of [`Bench::suite`].
    pub(crate) async fn run(&self, agent: AgentChoice, jobs: usize, out: &str) -> SuiteResult {
        let cases = self.cases(&self.suite()).unwrap();
        run(self.settings(agent, jobs, out), cases).await.unwrap()
    }

    pub(crate) async fn run_built_in(&self, agent: BuiltIn, out: &str) -> SuiteResult {
        self.run(AgentChoice::BuiltIn(agent), 2, out).await
    }
}

pub(crate) fn cpu() -> Cpu {
    Cpu::new(1, Simd::Best).unwrap()
}

/// Two seconds of the drive, from 20 m on.
pub(crate) fn scenario(name: &str, dynamics: &Value) -> Value {
    json!({
        "format": "wildcity.scenario/1", "name": name, "twin": { "name": "street" },
        "ego": { "start": { "trajectory": "log", "station_m": 20.0 }, "dynamics": dynamics },
        "end": { "time_s": 2.0 },
    })
}
