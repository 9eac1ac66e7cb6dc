//! Overhead of a run in addition to rendering.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::json;
use wildcity_generate::StreetSettings;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use wildcity_scene::Rig;
use wildcity_scene::manifest::Provenance;
use wildcity_suite::{AgentChoice, BuiltIn, RunSettings, run};
use wildcity_twin::store::NewVersion;

use crate::street::Bench;

/// A backend that measures how long it renders.
struct Timed {
    cpu: Cpu,
    spent: Mutex<Duration>,
}

impl Backend for Timed {
    fn name(&self) -> &'static str {
        self.cpu.name()
    }

    fn threads(&self) -> usize {
        self.cpu.threads()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        on_view_done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        let begin = Instant::now();
        let rendered = self.cpu.render(frame, targets, on_view_done);
        *self.spent.lock().unwrap() += begin.elapsed();
        rendered
    }
}

/// One camera of 1440 x 928 px on the demo street, with one thread and one episode at a time: the
/// overhead of all steps adds up. It was below 5 % before every run looked for contact with the
/// twin, which reads the solid Gaussians of the street once: 1 to 2 % of this run of one camera,
/// and a sixth of that with six.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_takes_less_than_a_tenth_more_than_its_rendering() {
    let bench = Bench::new();
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let new = NewVersion {
        rig: Some(Rig::preset("vehicle6").unwrap()),
        trajectories: vec![street.trajectory],
        ..NewVersion::from_gaussians("demo", &street.gaussians, Provenance::new("test".into()))
    };
    bench.catalog().commit(new, &mut |_, _| {}).unwrap();
    let scenario = json!({
        "format": "wildcity.scenario/1", "name": "demo", "twin": { "name": "demo" },
        "ego": { "start": { "trajectory": "log", "station_m": 10.0 },
                 "dynamics": { "model": "dynamic", "speed": 10.0 } },
        "actors": [{ "name": "ahead", "asset": "none", "idm": { "along": "log", "station_m": 40.0, "speed": 9.0 } }],
        "end": { "time_s": 3.0, "contact": "any" },
    });
    bench.write("demo.json", &scenario);
    let suite = json!({
        "format": "wildcity.suite/1", "name": "demo", "scenarios": ["demo.json"], "seeds": [0, 0],
        "cameras": ["front"], "size": [1440, 928],
    });
    let suite = bench.write("suite.json", &suite);
    let mut shares = Vec::new();
    // Other programs may run at the same time, so one undisturbed attempt is enough.
    for attempt in 0..8 {
        let cpu = Cpu::new(1, Simd::Best).unwrap();
        let timed = Arc::new(Timed { cpu, spent: Mutex::default() });
        let agent = AgentChoice::BuiltIn(BuiltIn::Log);
        let out = format!("run{attempt}");
        let settings = RunSettings { backend: timed.clone(), ..bench.settings(agent, 1, &out) };
        let cases = bench.cases(&suite).unwrap();
        let begin = Instant::now();
        let result = run(settings, cases).await.unwrap();
        let whole = begin.elapsed();
        assert_eq!(result.counts.passed, 1, "{}", result.to_json());
        let rendering = *timed.spent.lock().unwrap();
        shares.push(whole.as_secs_f64() / rendering.as_secs_f64() - 1.0);
        eprintln!("{whole:?} in all, {rendering:?} of it rendering");
        if shares[attempt] < 0.10 {
            return;
        }
    }
    panic!("more than its rendering by {shares:?}");
}
