//! The results of a drive, as a table, as JSON, and as CSV.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::time::Duration;

use serde_json::{Value, json};

use super::super::memory::mib;
use super::step::DriveStep;
use wildcity_scene::rig::RigCamera;
use wildcity_twin::residency::Stats;

/// Number of steps before a drive counts as warm: 3 s, in which the prefetcher measures the rig's
/// speed.
const WARM_UP: usize = 30;

/// A drive, and the jumps after it.
pub(super) struct Report {
    pub(super) twin: String,
    pub(super) gaussians: u64,
    pub(super) length_m: f64,
    pub(super) speed_m_s: f64,
    pub(super) backend: &'static str,
    /// Names and sizes of the cameras.
    pub(super) cameras: String,
    /// Memory that is reserved for the frame that needs the most.
    pub(super) reserved_bytes: u64,
    /// Time to open the session.
    pub(super) open: Duration,
    /// Time of the first frame.
    pub(super) first: Duration,
    pub(super) steps: Vec<DriveStep>,
    pub(super) jumps: Vec<DriveStep>,
    pub(super) peak_rss_bytes: u64,
    pub(super) stats: Stats,
}

/// Statistics over some steps: a row of the table.
#[derive(Clone, Debug, serde::Serialize)]
pub(super) struct Row {
    steps: usize,
    step_ms_p50: f64,
    step_ms_p99: f64,
    step_ms_max: f64,
    waits: usize,
    waited_ms: f64,
    waited_ms_max: f64,
    misses: u64,
    loads: u64,
    evictions: u64,
    held_bytes_max: u64,
    rss_bytes_max: u64,
}

impl Row {
    fn from_steps(steps: &[DriveStep]) -> Self {
        let mut steps_ms: Vec<f64> = steps.iter().map(|step| ms(step.step)).collect();
        steps_ms.sort_by(f64::total_cmp);
        let quantile_ms = |share: f64| {
            let last = steps_ms.len().saturating_sub(1) as f64;
            steps_ms.get((last * share).round() as usize).copied().unwrap_or(0.0)
        };
        let max = |of: fn(&DriveStep) -> u64| steps.iter().map(of).max().unwrap_or(0);
        let waited = steps.iter().map(|step| ms(step.waited));
        Self {
            steps: steps.len(),
            step_ms_p50: quantile_ms(0.5),
            step_ms_p99: quantile_ms(0.99),
            step_ms_max: quantile_ms(1.0),
            waits: steps.iter().filter(|step| step.misses > 0).count(),
            waited_ms: waited.clone().sum(),
            waited_ms_max: waited.fold(0.0, f64::max),
            misses: steps.iter().map(|step| step.misses).sum(),
            loads: steps.iter().map(|step| step.loads).sum(),
            evictions: steps.iter().map(|step| step.evictions).sum(),
            held_bytes_max: max(|step| step.held_bytes),
            rss_bytes_max: max(|step| step.rss_bytes),
        }
    }

    /// Names and sizes of cameras, as text.
    pub(super) fn cameras(cameras: &[RigCamera]) -> String {
        let one = |rig: &RigCamera| {
            format!("{} {}x{}", rig.name, rig.camera.width_px, rig.camera.height_px)
        };
        cameras.iter().map(one).collect::<Vec<_>>().join(", ")
    }
}

impl Report {
    /// Statistics of each kilometre.
    fn kilometres(&self) -> Vec<(u64, Row)> {
        let km = |step: &DriveStep| (1e-3 * step.station_m) as u64;
        let runs = self.steps.chunk_by(|a, b| km(a) == km(b));
        runs.map(|run| (km(&run[0]), Row::from_steps(run))).collect()
    }

    pub(super) fn print(&self, json: bool) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        if json {
            writeln!(out, "{}", self.json())?;
            return Ok(());
        }
        let Stats { limit_bytes, load_p50, load_p99, .. } = self.stats;
        writeln!(
            out,
            "{}: {} Gaussians, {:.2} km at {} m/s, {}, {}",
            self.twin,
            self.gaussians,
            1e-3 * self.length_m,
            self.speed_m_s,
            self.backend,
            self.cameras
        )?;
        writeln!(
            out,
            "opened in {:.0} ms, first frame {:.0} ms; {:.0} MiB for the worst frame of {:.0} MiB; \
             loads {:.1} ms, p99 {:.1} ms",
            ms(self.open),
            ms(self.first),
            mib(self.reserved_bytes),
            mib(limit_bytes),
            ms(load_p50),
            ms(load_p99),
        )?;
        writeln!(
            out,
            "{:>9} {:>6} {:>8} {:>8} {:>8} {:>6} {:>9} {:>8} {:>8} {:>8} {:>8}",
            "km",
            "steps",
            "p50 ms",
            "p99 ms",
            "max ms",
            "waits",
            "waited ms",
            "loads",
            "dropped",
            "held MiB",
            "RSS MiB"
        )?;
        let mut line = |name: &str, row: &Row| {
            writeln!(
                out,
                "{name:>9} {:>6} {:>8.1} {:>8.1} {:>8.1} {:>6} {:>9.0} {:>8} {:>8} {:>8.0} {:>8.0}",
                row.steps,
                row.step_ms_p50,
                row.step_ms_p99,
                row.step_ms_max,
                row.waits,
                row.waited_ms,
                row.loads,
                row.evictions,
                mib(row.held_bytes_max),
                mib(row.rss_bytes_max),
            )
        };
        for (km, row) in self.kilometres() {
            line(&km.to_string(), &row)?;
        }
        let warm = WARM_UP.min(self.steps.len());
        line("all", &Row::from_steps(&self.steps))?;
        line("warm", &Row::from_steps(&self.steps[warm..]))?;
        if !self.jumps.is_empty() {
            line("teleports", &Row::from_steps(&self.jumps))?;
        }
        writeln!(out, "most memory {:.0} MiB", mib(self.peak_rss_bytes))?;
        Ok(())
    }

    fn json(&self) -> Value {
        let Stats { limit_bytes, load_p50, load_p99, retries, prefetches_dropped, .. } = self.stats;
        let kilometres: Vec<_> = self.kilometres().into_iter().map(|(_, row)| row).collect();
        json!({
            "twin": self.twin,
            "gaussians": self.gaussians,
            "length_m": self.length_m,
            "speed_m_s": self.speed_m_s,
            "backend": self.backend,
            "cameras": self.cameras,
            "open_ms": ms(self.open),
            "first_ms": ms(self.first),
            "limit_bytes": limit_bytes,
            "reserved_bytes": self.reserved_bytes,
            "load_ms_p50": ms(load_p50),
            "load_ms_p99": ms(load_p99),
            "retries": retries,
            "prefetches_dropped": prefetches_dropped,
            "peak_rss_bytes": self.peak_rss_bytes,
            "kilometres": kilometres,
            "all": Row::from_steps(&self.steps),
            "warm": Row::from_steps(&self.steps[WARM_UP.min(self.steps.len())..]),
            "teleports": Row::from_steps(&self.jumps),
        })
    }

    /// CSV with a line for every step and every jump.
    pub(super) fn csv(&self) -> String {
        let mut csv = String::from(
            "kind,station_m,step_ms,waited_ms,misses,loads,evictions,held_bytes,rss_bytes\n",
        );
        let steps = self.steps.iter().map(|step| ("step", step));
        for (kind, step) in steps.chain(self.jumps.iter().map(|jump| ("teleport", jump))) {
            let DriveStep { station_m, misses, loads, evictions, held_bytes, rss_bytes, .. } = step;
            let step_ms = ms(step.step);
            let waited_ms = ms(step.waited);
            // Writing to a string cannot fail.
            let _ = writeln!(
                csv,
                "{kind},{station_m:.3},{step_ms:.3},{waited_ms:.3},{misses},{loads},{evictions},\
                 {held_bytes},{rss_bytes}"
            );
        }
        csv
    }
}

fn ms(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}
