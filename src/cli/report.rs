//! `wildcity report`.

use std::fs;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

use crate::cli::limits;
use wildcity_render::gpu::Gpu;
use wildcity_render::{Backend, RenderError};
use wildcity_report::confidence::confidence_by_offset;
use wildcity_report::measure::normalize_machine_speed;
use wildcity_report::measure::{Benchmark, ReferenceImages};
use wildcity_report::recommend::{Goal, Recommendation, recommend};
use wildcity_report::sample_points::{Sampling, sample_points};
use wildcity_report::settings::{SettingList, Skipped, TwinFeatures, settings_to_compare};
use wildcity_report::{Report, ReportError, Subject, feature_costs, page};
use wildcity_scene::{Rays, Rig};
use wildcity_stress::CASES;
use wildcity_stress::table::{self, Candidate, Column};
use wildcity_twin::residency::Cache;

use super::backend_options::HardwareOptions;
use super::directories::{TwinVersion, Twins};
use super::rig::rig_of;
use super::stress::{Name, candidate};
use super::{demo, output, progress};

/// Measure what each setting of the renderer costs and what it loses, on a twin and on this machine.
///
/// Backends, levels of detail, records, antialiasing, alpha cut, stop, the sky, lenses, image scale and
/// encoding, each against the f64 reference, at places on the recorded drive and 1, 3 and 5 m beside it
/// (around a twin that has none). Windows of each image are compared, at full focal length; whole steps
/// are timed. What the twin cannot feel is left out, and named. Also how far images may be believed beside
/// the drive, the stress table, and what a scene with and without each feature runs. Writes report.html,
/// which needs nothing else, report.json and report.csv.
///
/// With --at-least-db or --at-most-ms it recommends a setting, verified at places that were not used to
/// choose it, and writes it as profile.json for `wildcity serve --profile`; where it cannot, the report
/// says why, and a profile.json of an earlier one is removed. Its decibels and milliseconds are of what is
/// rendered, before images are encoded: a profile does not choose the encoding. What encodings lose and
/// take is measured, and told beside it.
///
/// The reference draws the whole twin in full detail, however far it goes: it must fit into memory.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Command {
    /// The twin, or NAME@NUMBER for an older version; `demo` is the demo street in record f32, built on
    /// first use, so that all records can be compared.
    #[arg(value_name = "TWIN", default_value = demo::TWIN)]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// Directory for the report; made if it is missing.
    #[arg(long, value_name = "DIR", default_value = "wildcity-report")]
    out: PathBuf,

    /// Recommend the fastest setting with at least this PSNR in every camera's window at every place, in
    /// dB, before images are encoded.
    #[arg(long, value_name = "DB", value_parser = at_least_db, allow_negative_numbers = true)]
    at_least_db: Option<Goal>,

    /// Recommend the most exact setting of which all but one of twenty steps take at most this time, in
    /// milliseconds, before images are encoded.
    #[arg(long, value_name = "MS", value_parser = at_most_ms, allow_negative_numbers = true)]
    #[arg(conflicts_with = "at_least_db")]
    at_most_ms: Option<Goal>,

    /// Stations along the drive, each on it and 1, 3 and 5 m beside; around a twin without a drive, four
    /// times as many places. The reference takes about a second for each place and camera.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=limits::REPORT_STATIONS))]
    stations: u32,

    /// Side of the window that is compared of each image, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 96, value_parser = clap::value_parser!(u32).range(16..=limits::REPORT_WINDOW_PX))]
    window: u32,

    /// Steps to time at each place, after one that is not counted.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeat: u32,

    /// Cameras to look with instead of the twin's own: a preset (see `wildcity rig show`) or a file.
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,

    /// Backends beside the reference, the one that draws all settings first.
    #[arg(long = "backend", value_name = "NAME", value_delimiter = ',', value_enum, default_values_t = [Measurable::Cpu, Measurable::Gpu])]
    backends: Vec<Measurable>,

    /// Leave out the stress table.
    #[arg(long)]
    no_stress: bool,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity report
  wildcity report street --at-least-db 40 --out report
  wildcity report street --rig alpamayo2
  wildcity report street --backend gpu --at-most-ms 20 && \\
    wildcity serve --backend gpu --profile wildcity-report/profile.json";

/// Backends that can be measured: the reference is what they are compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Measurable {
    Cpu,
    Gpu,
}

impl From<Measurable> for Name {
    fn from(measurable: Measurable) -> Self {
        match measurable {
            Measurable::Cpu => Self::Cpu,
            Measurable::Gpu => Self::Gpu,
        }
    }
}

fn at_least_db(text: &str) -> Result<Goal, String> {
    match text.parse() {
        Ok(db) if (0.0..=1000.0).contains(&db) => Ok(Goal::AtLeastDb(db)),
        _ => Err("expected 0 to 1000 dB, as 40".to_owned()),
    }
}

fn at_most_ms(text: &str) -> Result<Goal, String> {
    match text.parse() {
        Ok(ms) if ms > 0.0 && f64::is_finite(ms) => Ok(Goal::AtMostMs(ms)),
        _ => Err("expected milliseconds, more than 0, as 20".to_owned()),
    }
}

impl Command {
    pub(super) fn run(mut self) -> anyhow::Result<()> {
        let again = |(index, name)| self.backends[..index].contains(name);
        let twice = self.backends.iter().enumerate().any(again);
        ensure!(!twice, "--backend names one twice: name each once");
        if self.twin.name == demo::TWIN {
            self.twin.name = demo::exact(&self.twins.dir()?)?.manifest.twin;
        }
        let report = self.measure()?;
        output::make_dir(&self.out)?;
        let mut files = vec![
            ("report.html", page::html(&report)?),
            ("report.json", format!("{:#}\n", serde_json::to_value(&report)?)),
            ("report.csv", report.csv()),
        ];
        // It would be another report's beside this one.
        let profile = self.out.join("profile.json");
        remove(&profile)?;
        if let Some(best) = &report.recommendation {
            let changes = serde_json::to_value(best.changes()?)?;
            files.push(("profile.json", format!("{changes:#}\n")));
        }
        let mut out = io::stdout().lock();
        for (name, text) in files {
            let path = self.out.join(name);
            output::write(&path, text.as_bytes())?;
            writeln!(out, "{}", path.display())?;
        }
        for Skipped { what, why } in &report.skipped {
            writeln!(out, "not compared: {what} ({why})")?;
        }
        if let Some(best) = &report.recommendation {
            let Recommendation { wanted, setting, backend, chosen_by, margin, verified, .. } = best;
            writeln!(
                out,
                "{wanted}: {setting} on {backend}, {chosen_by:.1} at worst where it was chosen, with a \
                 margin of {margin:.1}, and {verified:.1} at worst at other places, {}",
                best.of_what()
            )?;
            writeln!(out, "{}", best.serve(&profile.display().to_string()))?;
        }
        // What was measured is on disk, and says so, too.
        report.unmet_reason.map_or(Ok(()), |why| bail!(why))
    }

    fn measure(&self) -> anyhow::Result<Report> {
        let candidates = self.backends.iter().map(|name| candidate((*name).into(), &self.hardware));
        let candidates = candidates.collect::<anyhow::Result<Vec<Candidate>>>()?;
        let (mut backends, mut absent): (Vec<Box<dyn Backend>>, _) = (Vec::new(), Vec::new());
        for candidate in candidates {
            match candidate {
                Ok(backend) => backends.push(backend),
                Err((name, why)) => absent.push(Skipped::new(format!("backend {name}"), why)),
            }
        }
        ensure!(!backends.is_empty(), "none of the --backend is there");
        let resident = Cache::new(self.twins.catalog()?).open(&self.twin.name, self.twin.number)?;
        let manifest = &resident.version.manifest;
        let named = self.rig.as_deref().map(rig_of).transpose()?;
        let own = || manifest.rig.clone().or_else(|| Rig::preset(wildcity_session::limits::RIG));
        let rig = named.or_else(own).context("no rig")?;
        let sampling = Sampling { stations: self.stations, window_px: [self.window; 2] };
        let places = sample_points(manifest, &rig.cameras, sampling);

        let bench = Benchmark {
            resident: &resident,
            backends: &backends,
            places: &places,
            repeat: self.repeat,
            device: &|| self.device(),
        };
        let truth = |rays: Rays, label| -> anyhow::Result<ReferenceImages> {
            let bar = progress::count(label);
            bar.set_length(places.len() as u64);
            let truth = bench.truth(rays, &mut |done| bar.set_position(done as u64));
            let truth = truth.context(
                "the reference draws the whole twin, in full detail and however far it goes",
            )?;
            bar.finish_and_clear();
            Ok(truth)
        };
        let twin = TwinFeatures::of(manifest, resident.sky().map(AsRef::as_ref), &places[0].views);
        let splats = truth(Rays::Splats, "reference")?;
        let rays = twin.bent.then(|| truth(Rays::Exact, "reference, every ray")).transpose()?;

        let names: Vec<&str> = backends.iter().map(|backend| backend.name()).collect();
        let SettingList { settings, mut skipped } = settings_to_compare(&twin, &names);
        skipped.extend(absent);
        let bar = progress::state();
        bar.set_length(settings.len() as u64);
        let mut measured = Vec::new();
        for setting in &settings {
            bar.set_message(setting.name.clone());
            let truth = match (setting.against, &rays) {
                (Rays::Exact, Some(rays)) => rays,
                // A ladder has nothing against rays unless a camera is bent.
                (Rays::Splats | Rays::Exact, _) => &splats,
            };
            match bench.measure(setting, truth) {
                Ok(one) => measured.push(one),
                // A map that would be too large.
                Err(ReportError::Render(why @ RenderError::Sky(_))) => {
                    skipped.push(Skipped::new(setting.name.clone(), why.to_string()));
                }
                Err(error) => return Err(error.into()),
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        normalize_machine_speed(&mut measured);

        let wanted = self.at_least_db.or(self.at_most_ms);
        let names: Vec<String> = names.into_iter().map(str::to_owned).collect();
        let recommended = wanted.map(|wanted| recommend(wanted, &measured, &names)).transpose();
        let (recommendation, unmet) = match recommended {
            Ok(recommendation) => (recommendation, None),
            Err(unmet) => (None, Some(unmet.to_string())),
        };
        Ok(Report {
            subject: Subject {
                twin: manifest.twin.clone(),
                version: resident.version.number,
                version_hash: resident.version.hash.clone(),
                gaussians: manifest.gaussians(),
                sh_degree: manifest.sh_degree,
                record: manifest.record.name(),
                profile: manifest.profile,
                cameras: places[0].views.len(),
                repeat: self.repeat,
            },
            backends: backends
                .iter()
                .map(|b| Column { backend: b.name(), detail: b.detail() })
                .collect(),
            sampling,
            sample_points: places.iter().map(|place| place.name.clone()).collect(),
            reference_ms: splats.step_ms,
            settings: measured,
            skipped,
            exact_rays_ms: rays.map(|rays| rays.step_ms),
            confidence: confidence_by_offset(&resident, &*backends[0], &places)?,
            goal: wanted,
            recommendation,
            unmet_reason: unmet,
            stress: self.stress()?,
            feature_costs: feature_costs::count_features(&self.hardware.cpu()?, &|| self.device())?,
        })
    }

    /// A device that drew nothing yet, if one is wanted and there.
    fn device(&self) -> Option<Gpu> {
        if self.backends.contains(&Measurable::Gpu) { self.hardware.gpu().ok() } else { None }
    }

    /// The stress table on every backend of the report, and on the definition.
    fn stress(&self) -> anyhow::Result<table::Table> {
        let backends = self.backends.iter().map(|name| Name::from(*name));
        let names = [Name::Reference].into_iter().chain(backends);
        let names = names.filter(|_| !self.no_stress);
        let candidates = names.map(|name| candidate(name, &self.hardware));
        let candidates = candidates.collect::<anyhow::Result<Vec<_>>>()?;
        let cases: Vec<_> = if self.no_stress { Vec::new() } else { CASES.iter().collect() };
        let bar = progress::state();
        bar.set_length((cases.len() * candidates.len()) as u64);
        let table = table::run(&cases, &candidates, false, &mut |done, case| {
            bar.set_position(done as u64);
            bar.set_message(case.to_owned());
        });
        bar.finish_and_clear();
        Ok(table)
    }
}

/// Removes a file, if it is there.
fn remove(path: &Path) -> anyhow::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        removed => removed.with_context(|| format!("cannot remove {}", path.display())),
    }
}
