//! A report from start to end: repair, errors and times of all settings, a recommendation, trust,
//! extreme scenes, and the costs of features.

use std::sync::Arc;

use anyhow::Context as _;

use wildcity_render::cpu::Cpu;
use wildcity_render::gpu::Gpu;
use wildcity_render::{Backend, RenderError};
use wildcity_repair::Models;
use wildcity_scene::{Rays, Rig};
use wildcity_stress::CASES;
use wildcity_stress::table::{self, Candidate, Column};
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use crate::confidence::confidence_by_offset;
use crate::measure::{Benchmark, ReferenceImages};
use crate::measurement::{Measurement, normalize_machine_speed};
use crate::recommend::{Goal, recommend};
use crate::repair::{self, RepairBenchmark, RepairReport, RepairSampling};
use crate::sample_points::{Sampling, sample_points};
use crate::settings::{SettingList, Skipped, TwinFeatures, settings_to_compare};
use crate::{Expected, Report, ReportError, Subject, feature_costs};

/// What is measured, and how often.
#[derive(Clone, Debug)]
pub struct Settings {
    pub sampling: Sampling,
    /// Timed steps at each sample point, after one that is not counted.
    pub repeat: u32,
    /// What a recommended setting must reach; `None` for no recommendation.
    pub goal: Option<Goal>,
    /// Poses of the measurement of repair.
    pub repair: RepairSampling,
}

/// The twin that is measured.
pub struct Twin {
    pub resident: Arc<Resident>,
    /// The catalog that has it.
    pub catalog: Catalog,
    /// The cameras of a step.
    pub rig: Rig,
    /// The models whose gains and costs are measured.
    pub models: Arc<Models>,
    /// The twin that is the ground truth of these models; `None` if there is none.
    pub truth: Option<Arc<Resident>>,
}

/// The machine that measures.
pub struct Machine<'a> {
    /// The backends, at least one. The first one renders all settings.
    pub backends: Vec<Box<dyn Backend>>,
    /// Backends that this machine does not have.
    pub absent: Vec<Skipped>,
    /// Counts the work of features.
    pub cpu: Cpu,
    /// Opens a device that has rendered nothing yet; `None` if there is none.
    pub open_device: &'a dyn Fn() -> Option<Gpu>,
    /// Backends of the stress table; none to leave it out.
    pub stress: Vec<Candidate>,
}

/// Called with what is measured, how much of it is done, and how much there is.
pub type Progress<'a> = &'a mut dyn FnMut(&str, u64, u64);

/// Measurements of all settings, and the settings that were skipped.
struct Compared {
    measurements: Vec<Measurement>,
    skipped: Vec<Skipped>,
    /// Time of a step of the reference, in milliseconds.
    reference_ms: f64,
    /// Time with an exact ray for every pixel; `None` if every camera is a pinhole without motion.
    exact_rays_ms: Option<f64>,
}

/// How long [`run`] will take, after a try of a second or two.
///
/// # Errors
/// The twin cannot be read or rendered.
pub fn expect(settings: &Settings, twin: &Twin, machine: &Machine<'_>) -> anyhow::Result<Expected> {
    let Machine { backends, open_device, .. } = machine;
    let manifest = &twin.resident.version.manifest;
    let points = sample_points(manifest, &twin.rig.cameras, settings.sampling);
    let benchmark = Benchmark {
        resident: &twin.resident,
        backends,
        sample_points: &points,
        repeat: settings.repeat,
        open_device,
    };
    let (features, listed) = list_settings(&benchmark);
    let references = 1 + usize::from(features.has_non_pinhole);
    Ok(Expected::new(&benchmark, &listed.settings, references)?)
}

/// Measures a twin. A goal that no setting reaches is no error: the report has the reason.
///
/// # Errors
/// The twin cannot be read or rendered, or a model fails.
pub fn run(
    settings: &Settings,
    twin: &Twin,
    machine: &Machine<'_>,
    progress: Progress<'_>,
) -> anyhow::Result<Report> {
    let resident = &twin.resident;
    let manifest = &resident.version.manifest;
    let Machine { backends, open_device, .. } = machine;
    let points = sample_points(manifest, &twin.rig.cameras, settings.sampling);
    let names: Vec<String> = backends.iter().map(|backend| backend.name().to_owned()).collect();
    // A model may be wrong, and it takes less time to see than the settings.
    let repair = measure_repair(settings, twin, &*backends[0], progress)?;
    let benchmark = Benchmark {
        resident,
        backends,
        sample_points: &points,
        repeat: settings.repeat,
        open_device,
    };
    let mut compared = compare(&benchmark, progress)?;
    compared.skipped.extend(machine.absent.iter().cloned());
    let recommended = settings.goal.map(|goal| recommend(goal, &compared.measurements, &names));
    let (recommendation, unmet_reason) = match recommended.transpose() {
        Ok(recommendation) => (recommendation, None),
        Err(error) => (None, Some(error.to_string())),
    };
    let confidence = confidence_by_offset(resident, &*backends[0], &points)?;
    let stress = stress(&machine.stress, progress);
    let feature_costs = feature_costs::count_features(&machine.cpu, open_device)?;
    Ok(Report {
        subject: Subject {
            twin: manifest.twin.clone(),
            version: resident.version.number,
            version_hash: resident.version.hash.clone(),
            gaussians: manifest.gaussians(),
            sh_degree: manifest.sh_degree,
            record: manifest.record.name(),
            profile: manifest.profile,
            cameras: points[0].views.len(),
            repeat: settings.repeat,
        },
        backends: backends
            .iter()
            .map(|backend| Column { backend: backend.name(), detail: backend.detail() })
            .collect(),
        sampling: settings.sampling,
        sample_points: points.iter().map(|point| point.name.clone()).collect(),
        reference_ms: compared.reference_ms,
        settings: compared.measurements,
        skipped: compared.skipped,
        exact_rays_ms: compared.exact_rays_ms,
        confidence,
        goal: settings.goal,
        recommendation,
        unmet_reason,
        stress,
        feature_costs,
        repair,
    })
}

/// Gains and costs of the models; `None` without models.
fn measure_repair(
    settings: &Settings,
    twin: &Twin,
    backend: &dyn Backend,
    progress: Progress<'_>,
) -> anyhow::Result<Option<RepairReport>> {
    let models =
        twin.models.names().map(|name| twin.models.get(name)).collect::<Result<Vec<_>, _>>()?;
    if models.is_empty() {
        return Ok(None);
    }
    let benchmark = RepairBenchmark {
        resident: &twin.resident,
        catalog: &twin.catalog,
        truth: twin.truth.as_ref(),
        backend,
        cameras: &twin.rig.cameras,
        models: &models,
        references: twin.models.references(),
        sampling: settings.repair.clone(),
    };
    let report = repair::measure(&benchmark, &mut |done, all| {
        progress("repair", done as u64, all as u64);
    })?;
    Ok(Some(report))
}

/// Measures every setting that can affect the twin.
fn compare(benchmark: &Benchmark<'_>, progress: Progress<'_>) -> anyhow::Result<Compared> {
    let (twin, SettingList { settings, mut skipped }) = list_settings(benchmark);
    let splats = render_reference(benchmark, Rays::Splats, "reference", progress)?;
    let rays = twin
        .has_non_pinhole
        .then(|| render_reference(benchmark, Rays::Exact, "every ray", progress))
        .transpose()?;
    let mut measurements = Vec::new();
    for (done, setting) in settings.iter().enumerate() {
        progress(&setting.name, done as u64, settings.len() as u64);
        let reference = match (setting.reference_rays, &rays) {
            (Rays::Exact, Some(rays)) => rays,
            // Without a non-pinhole camera no setting is compared with exact rays.
            (Rays::Splats | Rays::Exact, _) => &splats,
        };
        match benchmark.measure(setting, reference) {
            Ok(measurement) => measurements.push(measurement),
            // The map of a sky with this accuracy would be too large.
            Err(ReportError::Render(error @ RenderError::Sky(_))) => {
                skipped.push(Skipped::new(setting.name.clone(), error.to_string()));
            }
            Err(error) => return Err(error.into()),
        }
    }
    normalize_machine_speed(&mut measurements);
    Ok(Compared {
        measurements,
        skipped,
        reference_ms: splats.step_ms,
        exact_rays_ms: rays.map(|rays| rays.step_ms),
    })
}

/// What the settings of a twin depend on, and the settings.
fn list_settings(benchmark: &Benchmark<'_>) -> (TwinFeatures, SettingList) {
    let resident = benchmark.resident;
    let views = &benchmark.sample_points[0].views;
    let sky = resident.sky().map(AsRef::as_ref);
    let twin = TwinFeatures::new(&resident.version.manifest, sky, views);
    let names: Vec<&str> = benchmark.backends.iter().map(|backend| backend.name()).collect();
    let list = settings_to_compare(&twin, &names);
    (twin, list)
}

fn render_reference(
    benchmark: &Benchmark<'_>,
    rays: Rays,
    label: &str,
    progress: Progress<'_>,
) -> anyhow::Result<ReferenceImages> {
    let all = benchmark.sample_points.len() as u64;
    let images = benchmark.render_reference(rays, &mut |done| progress(label, done as u64, all));
    images.context(
        "the reference cannot render the whole twin at full detail and without a draw distance",
    )
}

/// The stress table; empty without backends.
fn stress(backends: &[Candidate], progress: Progress<'_>) -> table::Table {
    let cases: Vec<_> = if backends.is_empty() { Vec::new() } else { CASES.iter().collect() };
    let all = (cases.len() * backends.len()) as u64;
    table::run(&cases, backends, false, &mut |done, case| progress(case, done as u64, all))
}
