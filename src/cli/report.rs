//! `wildcity report`.

use std::cell::OnceCell;
use std::fs;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

use crate::cli::limits;
use wildcity_render::Backend;
use wildcity_render::gpu::Gpu;
use wildcity_report::recommend::{Goal, Recommendation};
use wildcity_report::repair::RepairSampling;
use wildcity_report::sample_points::Sampling;
use wildcity_report::settings::Skipped;
use wildcity_report::{Machine, Report, Settings, Twin, page};
use wildcity_scene::{Manifest, Rig};
use wildcity_stress::table::Candidate;
use wildcity_twin::residency::Cache;

use super::backend_options::HardwareOptions;
use super::dev::{BackendName, candidate};
use super::directories::{TwinVersion, Twins};
use super::repair_options::RepairOptions;
use super::twin::find_rig;
use super::{demo, output, progress};

/// Measure the run time and the error of each setting of the renderer, on one twin and this
/// machine.
///
/// Compares backends, levels of detail, record formats, antialiasing, the smallest alpha, the stop
/// transmittance, the sky map, lenses, image scale and encoding with the f64 reference. Sample
/// points lie on the recorded drive and 1, 3 and 5 m off it, or around a twin without a drive.
/// Windows of each image are compared at full focal length, and whole steps are timed. Settings
/// that cannot affect this twin are skipped, and the report lists them. The report also has the
/// trust of images off the drive, the stress table, and the cost of each feature of a scene.
///
/// Says first how long it will take. Writes report.html (a single self-contained file, which begins
/// with the setting to use), report.json and report.csv.
///
/// With --at-least-db or --at-most-ms it recommends a setting: selected at some sample points,
/// verified at the others, and written as profile.json for `wildcity serve --profile`. If no
/// setting can be recommended, the report says why, and the profile.json of an earlier report is
/// removed. The decibels and milliseconds of a recommendation apply to images before encoding,
/// because a profile does not choose the encoding; the report lists the error and the time that
/// each encoding adds.
///
/// The reference renders the whole twin at full detail and without a draw distance: it must fit
/// into memory.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Command {
    /// The twin: NAME, or NAME@NUMBER for an older version. `demo` is the demo street in record
    /// format f32, which is built on first use, so that all record formats can be compared.
    #[arg(value_name = "TWIN", default_value = demo::TWIN)]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// Directory for the report; created if it is missing.
    #[arg(long, value_name = "DIR", default_value = "wildcity-report")]
    out: PathBuf,

    /// Recommend the fastest setting with at least this PSNR in every camera's window at every
    /// sample point, in dB, before images are encoded.
    #[arg(long, value_name = "DB", value_parser = at_least_db, allow_negative_numbers = true)]
    at_least_db: Option<Goal>,

    /// Recommend the most exact setting whose 95th percentile of the step time is at most this, in
    /// milliseconds, before images are encoded.
    #[arg(long, value_name = "MS", value_parser = at_most_ms, allow_negative_numbers = true)]
    #[arg(conflicts_with = "at_least_db")]
    at_most_ms: Option<Goal>,

    /// Stations along the drive, each with a sample point on it and 1, 3 and 5 m off it; a twin
    /// without a drive has four times as many sample points around it. The reference takes about a
    /// second for each sample point and camera.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=limits::REPORT_STATIONS))]
    stations: u32,

    /// Width and height of the compared window of each image, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 96, value_parser = clap::value_parser!(u32).range(16..=limits::REPORT_WINDOW_PX))]
    window: u32,

    /// Steps to time at each sample point, after one that is not counted.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeat: u32,

    /// Cameras to use instead of the twin's own: a preset (see `wildcity twin rig show`), or a JSON
    /// file as `wildcity import --rig` reads it.
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,

    /// Backends to compare with the reference. The first one renders all settings.
    #[arg(long = "backend", value_name = "NAME", value_delimiter = ',', value_enum, default_values_t = [Measurable::Cpu, Measurable::Gpu])]
    backends: Vec<Measurable>,

    /// Leave out the stress table.
    #[arg(long)]
    no_stress: bool,

    #[command(flatten)]
    repair: RepairOptions,

    /// Lateral distances from the drive at which --repair is measured, in metres; it is always
    /// measured on the drive.
    #[arg(long, value_name = "M", value_delimiter = ',', default_values_t = [1.0, 3.0, 5.0], value_parser = offset_m)]
    #[arg(requires = "repair", allow_negative_numbers = true)]
    offsets: Vec<f64>,

    /// Twin with the ground truth, for --repair on a twin that was generated with --spoil: NAME, or
    /// NAME@NUMBER. Without it, there is no ground truth off the drive, and only times and flicker
    /// are measured.
    #[arg(long, value_name = "TWIN", requires = "repair")]
    truth: Option<TwinVersion>,

    /// Longest side of the images that --repair is measured with, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 360, requires = "repair")]
    #[arg(value_parser = clap::value_parser!(u32).range(16..=8192))]
    repair_side: u32,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity report
  wildcity report street --at-least-db 40 --out report
  wildcity report street --rig alpamayo2
  wildcity report worn --repair street-net.json --truth street --offsets 1,3,5
  wildcity report street --backend gpu --at-most-ms 20 && \\
    wildcity serve --backend gpu --profile wildcity-report/profile.json";

/// Backends that can be measured. The reference is missing: they are compared with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Measurable {
    Cpu,
    Gpu,
}

fn at_least_db(text: &str) -> Result<Goal, String> {
    match text.parse() {
        Ok(db) if (0.0..=1000.0).contains(&db) => Ok(Goal::AtLeastDb(db)),
        _ => Err("expected 0 to 1000 dB, for example 40".to_owned()),
    }
}

fn at_most_ms(text: &str) -> Result<Goal, String> {
    match text.parse() {
        Ok(ms) if ms > 0.0 && f64::is_finite(ms) => Ok(Goal::AtMostMs(ms)),
        _ => Err("expected milliseconds above 0, for example 20".to_owned()),
    }
}

fn offset_m(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(offset_m) if (0.0..=100.0).contains(&offset_m) => Ok(offset_m),
        _ => Err("expected 0 to 100 m, for example 3".to_owned()),
    }
}

/// The backends that this machine has, and those that it does not have, with the reason.
struct Backends {
    present: Vec<Box<dyn Backend>>,
    absent: Vec<Skipped>,
}

impl Command {
    pub(super) fn run(mut self) -> anyhow::Result<()> {
        let is_repeated = |(index, name)| self.backends[..index].contains(name);
        let has_repeated = self.backends.iter().enumerate().any(is_repeated);
        ensure!(!has_repeated, "--backend: the same backend is given twice; name each once");
        if self.twin.name == demo::TWIN {
            self.twin.name = demo::exact_twin(&self.twins.dir()?)?.manifest.twin;
        }
        let report = self.measure()?;
        self.write(&report)?;
        // The files are written and contain the reason, but without a recommendation the command
        // has failed.
        report.unmet_reason.map_or(Ok(()), |reason| bail!(reason))
    }

    /// Writes the report's files, and a summary on standard output.
    fn write(&self, report: &Report) -> anyhow::Result<()> {
        output::create_dir(&self.out)?;
        let mut files = vec![
            ("report.html", page::render(report)?),
            ("report.json", format!("{:#}\n", serde_json::to_value(report)?)),
            ("report.csv", report.csv()),
        ];
        // A profile of an earlier report would not belong to this one.
        let profile = self.out.join("profile.json");
        remove_if_present(&profile)?;
        if let Some(recommendation) = &report.recommendation {
            let changes = serde_json::to_value(recommendation.changes()?)?;
            files.push(("profile.json", format!("{changes:#}\n")));
        }
        let mut out = output::stdout();
        for (name, text) in files {
            let path = self.out.join(name);
            output::write(&path, text.as_bytes())?;
            writeln!(out, "{}", path.display())?;
        }
        for Skipped { what, reason } in &report.skipped {
            writeln!(out, "not compared: {what} ({reason})")?;
        }
        writeln!(out, "{}", report.answer())?;
        for recommended in report.repair.iter().flat_map(|repair| &repair.below) {
            writeln!(out, "{}", recommended.text())?;
        }
        if let Some(recommendation) = &report.recommendation {
            print_recommendation(&mut out, recommendation, &profile)?;
        }
        Ok(())
    }

    fn measure(&self) -> anyhow::Result<Report> {
        let devices = Devices { hardware: &self.hardware, first: OnceCell::new() };
        let Backends { present, absent } = self.open_backends(&devices)?;
        let cache = Cache::new(self.twins.catalog()?);
        let resident = cache.open(&self.twin.name, self.twin.number)?;
        let truth = self.truth.as_ref().map(|TwinVersion { name, number }| {
            Cache::new(self.twins.catalog()?)
                .open(name, *number)
                .with_context(|| format!("--truth {name}"))
        });
        let twin = Twin {
            rig: self.rig(&resident.version.manifest)?,
            resident,
            catalog: self.twins.catalog()?,
            models: self.repair.models()?,
            truth: truth.transpose()?,
        };
        let is_wanted = self.backends.contains(&Measurable::Gpu);
        let open_device = || if is_wanted { devices.open().ok() } else { None };
        let machine = Machine {
            backends: present,
            absent,
            cpu: self.hardware.cpu()?,
            open_device: &open_device,
            stress: self.stress_candidates(&devices)?,
        };
        let settings = Settings {
            sampling: Sampling { stations: self.stations, window_px: [self.window; 2] },
            repeat: self.repeat,
            goal: self.at_least_db.or(self.at_most_ms),
            repair: RepairSampling::new(self.stations, &self.offsets, self.repair_side),
        };
        let expected = wildcity_report::expect(&settings, &twin, &machine)?;
        let stress = if self.no_stress { "" } else { ", extreme scenes" };
        writeln!(
            io::stderr(),
            "this takes {expected}; then come trust and costs of features{stress}"
        )?;
        let bar = progress::state();
        let report = wildcity_report::run(&settings, &twin, &machine, &mut |what, done, all| {
            bar.set_length(all);
            bar.set_position(done);
            bar.set_message(what.to_owned());
        })?;
        bar.finish_and_clear();
        Ok(report)
    }

    /// Opens the backends of `--backend`; at least one must be there.
    fn open_backends(&self, devices: &Devices<'_>) -> anyhow::Result<Backends> {
        let mut present = Vec::new();
        let mut absent = Vec::new();
        for name in &self.backends {
            match self.candidate(*name, devices)? {
                Ok(backend) => present.push(backend),
                Err((name, why)) => absent.push(Skipped::new(format!("backend {name}"), why)),
            }
        }
        let reasons: Vec<&str> = absent.iter().map(|skipped| skipped.reason.as_str()).collect();
        ensure!(
            !present.is_empty(),
            "--backend: this machine has none of them ({}); add --backend cpu",
            reasons.join("; ")
        );
        Ok(Backends { present, absent })
    }

    /// The rig of `--rig`, the twin's own, or the default preset.
    fn rig(&self, manifest: &Manifest) -> anyhow::Result<Rig> {
        let named = self.rig.as_deref().map(find_rig).transpose()?;
        let own = || manifest.rig.clone();
        let default = || Rig::preset(wildcity_session::limits::RIG);
        named.or_else(own).or_else(default).context("the default rig preset is missing")
    }

    /// Backends of the stress table: the reference, and every backend of the report.
    fn stress_candidates(&self, devices: &Devices<'_>) -> anyhow::Result<Vec<Candidate>> {
        if self.no_stress {
            return Ok(Vec::new());
        }
        let reference = candidate(BackendName::Reference, &self.hardware);
        let others = self.backends.iter().map(|name| self.candidate(*name, devices));
        [reference].into_iter().chain(others).collect()
    }

    /// A backend, or why this machine does not have it.
    fn candidate(&self, name: Measurable, devices: &Devices<'_>) -> anyhow::Result<Candidate> {
        match name {
            Measurable::Cpu => candidate(BackendName::Cpu, &self.hardware),
            Measurable::Gpu => Ok(match devices.open() {
                Ok(gpu) => Ok(Box::new(gpu)),
                Err(reason) => Err(("gpu", reason)),
            }),
        }
    }
}

/// Devices that have rendered nothing yet. They are looked for once: each time a driver may print a
/// warning.
struct Devices<'a> {
    hardware: &'a HardwareOptions,
    first: OnceCell<Result<Gpu, String>>,
}

impl Devices<'_> {
    fn open(&self) -> Result<Gpu, String> {
        let find = || self.hardware.gpu().map_err(|error| error.to_string());
        let first = self.first.get_or_init(find).as_ref().map_err(String::clone)?;
        first.another().map_err(|error| error.to_string())
    }
}

fn print_recommendation(
    out: &mut impl Write,
    recommendation: &Recommendation,
    profile: &Path,
) -> io::Result<()> {
    let Recommendation {
        goal, setting, backend, selection_worst, margin, verification_worst, ..
    } = recommendation;
    writeln!(
        out,
        "{goal}: {setting} on {backend}, {selection_worst:.1} at the worst sample point for selection, \
         with a margin of {margin:.1}, and {verification_worst:.1} at the worst one for verification, {}",
        recommendation.explanation()
    )?;
    writeln!(out, "{}", recommendation.serve_command(&profile.display().to_string()))
}

fn remove_if_present(path: &Path) -> anyhow::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        removed => removed.with_context(|| format!("cannot remove {}", path.display())),
    }
}
