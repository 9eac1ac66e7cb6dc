//! `wildcity demo`.

mod driver;
mod mosaic;
#[cfg(feature = "eval")]
mod off_trajectory;
mod scenario;

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context as _;
use clap::ValueEnum as _;
use glam::DMat3;
use serde_json::json;

use wildcity_client::protocol::message::ScenarioChoice;
use wildcity_client::protocol::observation::Event;
use wildcity_client::{Client, Movement, Observation, Open, Pose};
use wildcity_generate::{Spoil, StreetSettings};
#[cfg(feature = "eval")]
use wildcity_repair::LoadOptions;
use wildcity_repair::Models;
use wildcity_scene::Rig;
use wildcity_scene::manifest::Provenance;
use wildcity_server::{Config, Directories};
use wildcity_session::generated_actors;
use wildcity_twin::ingest::sky;
use wildcity_twin::store::{
    Catalog, NewSky, NewVersion, SkyBytes, StorageOptions, StoreError, StoredActor, Version,
};

use self::driver::CarefulDriver;
use self::scenario::DemoScenario;

use super::backend_options::BackendOptions;
use super::directories::Twins;
#[cfg(feature = "eval")]
use super::repair_options::runtime_library;
use super::{browser, output, progress};

/// Build a demo street, drive through it as an agent, and write images of the drive.
///
/// Builds the street on first use, serves it on a free loopback port, and drives along its recorded
/// trajectory through the WebSocket, as any agent would. Writes a mosaic of the six cameras for
/// every tenth step, the recorded episode, and report.json with the time of every step. With --view
/// it opens the viewer instead, where the street can be driven by hand.
///
/// With --scenario, there is traffic: the agent keeps its distance from other vehicles and
/// pedestrians.
///
/// With --off-trajectory, the command does not drive. It renders views off the recorded drive from
/// a degraded copy of the street, which has reconstruction errors there as real captures have. It
/// compares these views with views of the street itself: as rendered, and with --repair also after
/// the repair.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Demo {
    /// Steps to drive, of 0.1 s each [default: 100; 280 for the scenario traffic]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: Option<u32>,

    /// Drive among other vehicles and pedestrians; their assets are made on first use.
    #[arg(long, value_name = "NAME")]
    scenario: Option<DemoScenario>,

    /// Directory for the images and the report; created if it is missing.
    #[arg(long, value_name = "DIR", default_value = "wildcity-demo")]
    out: PathBuf,

    /// Open the street in the viewer of a browser, instead of driving through it as an agent.
    #[arg(long, conflicts_with_all = ["steps", "scenario"])]
    view: bool,

    /// Render views at this distance to the left of the recorded drive, in metres, instead of
    /// driving.
    #[arg(long, value_name = "M", conflicts_with_all = ["steps", "scenario", "view"], allow_negative_numbers = true)]
    off_trajectory: Option<f64>,

    /// Also repair these views, with the model that comes with the program. This needs the ONNX
    /// Runtime: `pip install onnxruntime`, and --onnxruntime or ORT_DYLIB_PATH with the path of its
    /// library (docs/repair.md has the commands).
    #[arg(long, requires = "off_trajectory")]
    repair: bool,

    /// ONNX Runtime library for --repair, version 1.18 or later [default: $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH", requires = "repair")]
    onnxruntime: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity demo
  wildcity demo --view
  wildcity demo --steps 20 --out /tmp/look
  wildcity demo --scenario cut-in
  wildcity demo --off-trajectory 3 --repair --onnxruntime libonnxruntime.so.1.32.0
  wildcity serve            (then an agent can open the twin \"demo\")";

/// Name of the demo twin.
pub(super) const TWIN: &str = "demo";
/// Name of the demo twin that `wildcity report` measures: the same street in record format f32.
#[cfg(feature = "report")]
const EXACT_TWIN: &str = "demo-f32";
/// Name of the degraded copy of the demo twin.
const SPOILED_TWIN: &str = "demo-spoiled";
/// Amount of its reconstruction errors: [`Spoil::new`].
const SPOILED_BY: f64 = 0.5;
/// Prefix of the provenance of the demo street, in every revision of the generator.
const STREET: &str = "street ";
/// Speed of the agent, in m/s.
const SPEED_M_PER_S: f64 = 8.0;
/// Steps of a drive without a scenario.
const STEPS: u32 = 100;
/// Number of steps between two mosaics.
const MOSAIC_STEPS: u64 = 10;

impl Demo {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let twins = self.twins.dir()?;
        output::create_dir(&self.out)?;
        let repairs = self.models()?;
        let version = demo_twin(&twins, TWIN, StorageOptions::default(), None)?;
        let assets = match self.scenario {
            Some(_) => generated_actors(&self.twins.catalog()?).map_err(anyhow::Error::msg)?,
            None => Vec::new(),
        };
        if self.off_trajectory.is_some() {
            demo_twin(&twins, SPOILED_TWIN, StorageOptions::default(), Some(SPOILED_BY))?;
        }
        // Uploads are needed until they are pushed, and the viewer of --view pushes some.
        let uploads = tempfile::Builder::new()
            .prefix(".uploads")
            .tempdir_in(&self.out)
            .with_context(|| format!("cannot write to {}", self.out.display()))?;
        let directories = Directories {
            twins,
            episodes: self.out.join("episodes"),
            scenarios: self.out.join("scenarios"),
            uploads: uploads.path().to_owned(),
        };
        let config = Config {
            cache: self.twins.cache(),
            repairs: Arc::new(repairs),
            ..Config::local(directories, Arc::from(self.backend.backend()?))
        };
        if self.view {
            return browser::serve(config, TWIN);
        }
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        #[cfg(feature = "eval")]
        if let Some(offset_m) = self.off_trajectory {
            return runtime.block_on(self.show_off_trajectory(config, &version, offset_m));
        }
        let drive = runtime.block_on(async {
            let running = wildcity_server::start(config).await?;
            let drive = self.drive(&running.url(), &version, &assets).await;
            running.stop().await;
            drive
        })?;
        self.report(&version, &drive)
    }

    /// The model of --repair, or none.
    #[cfg(feature = "eval")]
    fn models(&self) -> anyhow::Result<Models> {
        if !self.repair {
            return Ok(Models::default());
        }
        let options = LoadOptions::new(runtime_library(self.onnxruntime.as_ref()));
        off_trajectory::model(&self.out.join("model"), options)
    }

    /// No model: this build has no --off-trajectory.
    ///
    /// # Errors
    /// It was given; the error says what to build.
    #[cfg(not(feature = "eval"))]
    fn models(&self) -> anyhow::Result<Models> {
        let is_given = self.off_trajectory.is_some() || self.repair || self.onnxruntime.is_some();
        anyhow::ensure!(!is_given, "--off-trajectory: {}", super::left_out::built_without("eval"));
        Ok(Models::default())
    }

    #[cfg(feature = "eval")]
    async fn show_off_trajectory(
        &self,
        config: Config,
        version: &Version,
        offset_m: f64,
    ) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let running = wildcity_server::start(config).await?;
        let beside = wildcity_eval::Beside {
            url: &running.url(),
            catalog: &catalog,
            truth: TWIN,
            spoiled: SPOILED_TWIN,
            drive: &version.manifest.trajectories[0],
            offset_m,
            model: self.repair.then_some(off_trajectory::MODEL_NAME),
        };
        let views = beside.run().await;
        running.stop().await;
        off_trajectory::show(&views?, &self.out)
    }

    /// The agent: follows the recorded trajectory, and checks every frame's hash. Without a
    /// scenario it drives at a constant speed.
    async fn drive(
        &self,
        url: &str,
        version: &Version,
        assets: &[StoredActor],
    ) -> anyhow::Result<Drive> {
        let route = &version.manifest.trajectories[0];
        let mut client = Client::connect(url, "wildcity demo").await?;
        let mut open = Open::twin(TWIN);
        let mut driver = None;
        if let Some(scenario) = self.scenario {
            open.scenario = Some(ScenarioChoice::Object(scenario.with_assets(assets)?));
            open.outputs.actors = Some(true);
            driver = Some(CarefulDriver::new(route)?);
        }
        let opened = client.open(open).await?;
        let dt_s = opened.dt_us as f64 * 1e-6;
        let mut drive = Drive {
            backend: opened.backend,
            steps: Vec::new(),
            mosaics: Vec::new(),
            events: Vec::new(),
        };
        let mut seen = client.reset(0, None).await?;
        drive.write_mosaic(&seen, &self.out)?;
        let steps = self.steps.unwrap_or(self.scenario.map_or(STEPS, DemoScenario::steps));
        let bar = progress::count("driving");
        bar.set_length(steps.into());
        for step in 1..=steps {
            let movement = match &driver {
                Some(driver) => Movement::Trajectory(driver.plan(seen.metadata())?),
                None => Movement::Pose(wire_pose(
                    &route.at_station(f64::from(step) * dt_s * SPEED_M_PER_S),
                )),
            };
            let start = Instant::now();
            seen = client.drive(movement, false).await?;
            let step_ms = start.elapsed().as_secs_f64() * 1e3;
            // Outside of the time that is measured: hashing is work of the demo and not of a step.
            seen.verify()?;
            drive.steps.push(step_report(&seen, step_ms));
            drive.events.extend(seen.metadata().events.iter().cloned());
            drive.write_mosaic(&seen, &self.out)?;
            bar.inc(1);
            if seen.metadata().terminated {
                break;
            }
        }
        bar.finish_and_clear();
        client.close().await?;
        Ok(drive)
    }

    fn report(&self, version: &Version, drive: &Drive) -> anyhow::Result<()> {
        let step_ms = |step: &serde_json::Value| step["step_ms"].as_f64().unwrap_or(f64::NAN);
        let mut steps_ms: Vec<f64> = drive.steps.iter().map(step_ms).collect();
        steps_ms.sort_by(f64::total_cmp);
        // At least one step was driven, or an error has ended the demo.
        let last = (steps_ms.len() - 1) as f64;
        let quantile_ms = |share: f64| steps_ms[(last * share).round() as usize];
        let mut report = json!({
            "twin": version.manifest.twin,
            "version": version.number,
            "version_hash": version.hash,
            "gaussians": version.manifest.gaussians(),
            "backend": drive.backend,
            "step_ms": { "median": quantile_ms(0.5), "p95": quantile_ms(0.95), "max": quantile_ms(1.0) },
            "steps": drive.steps,
            "mosaics": drive.mosaics,
        });
        if let Some(scenario) = self.scenario.and_then(|scenario| scenario.to_possible_value()) {
            report["scenario"] = scenario.get_name().into();
            report["events"] = serde_json::to_value(&drive.events)?;
        }
        let path = self.out.join("report.json");
        output::write(&path, format!("{report:#}\n").as_bytes())?;
        let mut out = output::stdout();
        writeln!(
            out,
            "drove {} steps of six cameras: median {:.0} ms a step, 95 % within {:.0} ms",
            drive.steps.len(),
            quantile_ms(0.5),
            quantile_ms(0.95)
        )?;
        if let Some(last) = drive.mosaics.last() {
            writeln!(out, "look at   {}", self.out.join(last).display())?;
        }
        writeln!(out, "report    {}", path.display())?;
        writeln!(out, "episode   {}", self.out.join("episodes").display())?;
        Ok(())
    }
}

/// Records of a drive.
struct Drive {
    backend: String,
    /// One JSON object per step.
    steps: Vec<serde_json::Value>,
    /// File names of the mosaics.
    mosaics: Vec<String>,
    /// Events of the scenario.
    events: Vec<Event>,
}

impl Drive {
    /// Writes a mosaic of every tenth step.
    fn write_mosaic(&mut self, seen: &Observation, out: &Path) -> anyhow::Result<()> {
        let step = seen.metadata().step;
        if step.is_multiple_of(MOSAIC_STEPS) {
            let name = format!("step_{step:04}.png");
            mosaic::write(seen, &out.join(&name))?;
            self.mosaics.push(name);
        }
        Ok(())
    }
}

fn step_report(seen: &Observation, step_ms: f64) -> serde_json::Value {
    let metadata = seen.metadata();
    json!({
        "step": metadata.step,
        "time_us": metadata.time_us,
        "frame_hash": metadata.frame_hash,
        "step_ms": step_ms,
        "answer_bytes": seen.frame().len(),
        "timings": metadata.timings,
    })
}

fn wire_pose(pose: &wildcity_scene::geometry::Pose) -> Pose {
    Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
}

/// The demo street in the exact record format f32, under its own name.
#[cfg(feature = "report")]
pub(super) fn exact_twin(twins: &Path) -> anyhow::Result<Version> {
    demo_twin(
        twins,
        EXACT_TWIN,
        StorageOptions { record: wildcity_scene::RecordFormat::F32, ..StorageOptions::default() },
        None,
    )
}

/// The demo twin in the user's directory. It is built on first use, and again if the generator
/// changed or the files are damaged.
fn demo_twin(
    twins: &Path,
    name: &str,
    storage: StorageOptions,
    spoil: Option<f64>,
) -> anyhow::Result<Version> {
    let catalog = Catalog::open(twins)?;
    let settings = StreetSettings::default();
    let revision = wildcity_generate::REVISION;
    let settings_json = serde_json::to_string(&settings)?;
    let spoiled = spoil.map_or(String::new(), |amount| format!(", spoiled by {amount}"));
    let provenance = Provenance::new(format!("{STREET}{revision}: {settings_json}{spoiled}"));
    // The provenance has all settings: a twin of another build or amount is made anew.
    let reason = match existing(&catalog, name, &provenance)? {
        Existing::Usable(version) => return Ok(*version),
        Existing::Rebuild(reason) => reason,
    };
    writeln!(io::stderr(), "building the twin {name} in {} ({reason})", twins.display())?;
    let mut street = wildcity_generate::street(&settings)?;
    if let Some(amount) = spoil {
        let spoil = Spoil::new(amount, settings.seed, &street.trajectory)?;
        street.gaussians = spoil.apply(&street.gaussians);
    }
    let sky = sky::read_bytes(wildcity_generate::SKY, None)?;
    let bar = progress::count("writing");
    let version = catalog.commit(
        NewVersion {
            rig: Rig::preset("vehicle6"),
            trajectories: vec![street.trajectory],
            sky: Some(NewSky::Put(SkyBytes {
                bytes: sky.bytes.into(),
                image: None,
                sky_from_world: DMat3::IDENTITY,
            })),
            storage,
            ..NewVersion::from_gaussians(name, &street.gaussians, provenance)
        },
        &mut progress::show(&bar),
    )?;
    bar.finish_and_clear();
    Ok(version)
}

/// State of the demo twin in a directory.
enum Existing {
    /// It was built before, and can be used.
    Usable(Box<Version>),
    /// It must be built, for this reason.
    Rebuild(&'static str),
}

/// Looks for the demo twin.
///
/// # Errors
/// Another twin has the name: a user imported it, and it must not get a version of the demo street.
fn existing(catalog: &Catalog, name: &str, provenance: &Provenance) -> anyhow::Result<Existing> {
    const DAMAGED: &str = "its files are damaged";
    let version = match catalog.version(name, None) {
        Ok(version) => version,
        Err(StoreError::NoTwin { .. }) => {
            return Ok(Existing::Rebuild("only on the first use"));
        }
        Err(StoreError::Damaged { .. }) => return Ok(Existing::Rebuild(DAMAGED)),
        Err(StoreError::Format { .. }) => {
            return Ok(Existing::Rebuild("it is stored in the format of another build"));
        }
        Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {
            return Ok(Existing::Rebuild(DAMAGED));
        }
        Err(error) => return Err(error.into()),
    };
    let found = &version.manifest.provenance;
    anyhow::ensure!(
        // A twin of the user with the same name must not be replaced.
        found.source.starts_with(STREET),
        "twin {name:?} in {} is not the demo street (its source is {:?}): give another directory with \
         --twins, or import that twin under another name",
        catalog.dir().display(),
        found.source,
    );
    if found != provenance {
        return Ok(Existing::Rebuild("the generator changed"));
    }
    Ok(if is_intact(catalog, name, &version)? {
        Existing::Usable(Box::new(version))
    } else {
        Existing::Rebuild(DAMAGED)
    })
}

/// Whether every chunk of a version, and its sky, have the hashes that were committed. Damage in
/// older versions does not count.
fn is_intact(catalog: &Catalog, name: &str, version: &Version) -> anyhow::Result<bool> {
    let bar = progress::bytes("checking");
    let verified = catalog.verify(name, &mut progress::show(&bar))?;
    bar.finish_and_clear();
    let chunks = &version.manifest.chunks;
    let mut damaged = verified.damaged.iter().map(|damage| &damage.object);
    let sky = version.manifest.sky.as_ref();
    Ok(!damaged.any(|object| {
        chunks.iter().any(|chunk| chunk.object == *object)
            || sky.is_some_and(|sky| sky.object == *object)
    }))
}
