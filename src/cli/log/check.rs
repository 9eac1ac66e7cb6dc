//! `wildcity log check`.

use std::io::{self, Write};
use std::path::PathBuf;

use wildcity_log::check::{CheckSettings, Level, Report, check};
use wildcity_log::{Log, page};

use crate::cli::exit::Exit;
use crate::cli::{output, progress};

/// Measure a log, and say what a twin needs and the log lacks.
///
/// Looks for times that run backwards, gaps of each sensor, leaps of the poses, files that are
/// missing, images without a pose, distances without an image, and drift against satellite fixes.
/// Projects LiDAR into some images of each camera: the difference of the two clocks is the one at
/// which most leaps of the distance are at edges of the image, and a mount drifts if the edges
/// move against the points.
///
/// Writes one HTML page with pictures. Exit code 1 if a twin of the log would be wrong.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity log check log
  wildcity log check log --out check.html --json > check.json")]
pub(super) struct Check {
    /// Folder of the log.
    #[arg(value_name = "LOG")]
    log: PathBuf,

    /// HTML page to write.
    #[arg(long, value_name = "FILE", default_value = "log-check.html")]
    out: PathBuf,

    /// Print all numbers as JSON.
    #[arg(long)]
    json: bool,

    /// Images of each camera that are compared with LiDAR, spread over the log.
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(1..=1000))]
    images: u16,
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = Log::open(&self.log)?;
        let settings = CheckSettings { images_per_camera: self.images.into() };
        let bar = progress::count("comparing");
        let report = check(&log, &settings, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        // The page is written also if there are errors, because it shows where they are.
        output::write(&self.out, page(&report)?.as_bytes())?;
        let mut out = output::stdout();
        if self.json {
            writeln!(out, "{:#}", serde_json::to_value(&report)?)?;
        } else {
            print(&mut out, &report)?;
            writeln!(out, "{}", self.out.display())?;
        }
        if report.has_errors() {
            let log = self.log.display();
            return Err(
                Exit::finding(1, format!("{log}: a twin of this log would be wrong")).into()
            );
        }
        Ok(())
    }
}

fn print(out: &mut impl Write, report: &Report) -> io::Result<()> {
    let path = &report.path;
    let [from_us, to_us] = path.span_us;
    let seconds = to_us.abs_diff(from_us) as f64 / 1e6;
    let speed = path.top_speed_m_per_s;
    writeln!(
        out,
        "{}: {:.1} m in {seconds:.1} s, at most {speed:.1} m/s",
        report.name, path.length_m
    )?;
    for stream in &report.streams {
        let rate = stream.period_us.map_or(String::new(), |us| format!(" at {:.1} Hz", 1e6 / us));
        writeln!(out, "{}: {}{rate}", stream.sensor, output::counted(stream.rows, "row"))?;
    }
    for one in &report.alignment {
        let late = one.lidar_late_ms.map_or("not known".to_owned(), |ms| format!("{ms:.1} ms"));
        let shown = 100.0 * one.shown;
        writeln!(
            out,
            "camera {}: shows {shown:.1} % of the LiDAR, which is late by: {late}",
            one.camera
        )?;
    }
    for finding in &report.findings {
        let word = match finding.level {
            Level::Error => "error: ",
            Level::Warning => "warning: ",
            Level::Note => "note: ",
        };
        writeln!(out, "{word}{}", finding.text)?;
    }
    Ok(())
}
