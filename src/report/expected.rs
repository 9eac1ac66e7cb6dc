//! How long a report will take, from one window of the reference and one step of each backend.

use std::time::Instant;

use wildcity_render::Backend;
use wildcity_render::compare::images::render_images;
use wildcity_render::reference::Reference;
use wildcity_scene::RenderProfile;

use super::error::ReportError;
use super::measure::Benchmark;
use super::setting::Setting;
use super::timing::Step;

/// What a report is expected to take without repair, trust, costs of features and extreme scenes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expected {
    /// The images of the reference, in seconds.
    pub reference_s: f64,
    /// Errors and times of all settings, in seconds.
    pub settings_s: f64,
    /// How many settings are measured in that time.
    pub settings: usize,
}

/// Seconds of a backend at the first sample point.
struct Tried {
    step_s: f64,
    windows_s: f64,
}

impl Expected {
    /// Renders one window with the reference, and one step with each backend. `references` is the
    /// number of sets of images that the reference renders.
    pub(super) fn new(
        benchmark: &Benchmark<'_>,
        settings: &[Setting],
        references: usize,
    ) -> Result<Self, ReportError> {
        let points = benchmark.sample_points;
        let windows: usize = points.iter().map(|point| point.windows.len()).sum();
        let timed = points.iter().filter(|point| point.offset_m == 0.0).count();
        let reference_s = window_s(benchmark)? * (windows * references) as f64;
        let tried = benchmark
            .backends
            .iter()
            .map(|backend| tried(benchmark, &**backend))
            .collect::<Result<Vec<Tried>, ReportError>>()?;
        let steps = timed as f64 * f64::from(benchmark.repeat + 1);
        let setting_s = |setting: &Setting| {
            let Tried { step_s, windows_s } = tried[setting.backend];
            // Each step in turn with one of the first backend.
            points.len() as f64 * windows_s + steps * (step_s + tried[0].step_s)
        };
        let settings_s = settings.iter().map(setting_s).sum();
        Ok(Self { reference_s, settings_s, settings: settings.len() })
    }
}

/// Seconds of the reference for one window.
fn window_s(benchmark: &Benchmark<'_>) -> Result<f64, ReportError> {
    let point = benchmark.sample_points.first().ok_or(ReportError::NoSamplePoints)?;
    let profile = RenderProfile { tau_px: 0.0, reach_m: None, ..benchmark.profile() };
    let scene = benchmark.scene(&point.views, &profile)?;
    let begun = Instant::now();
    render_images(&Reference, &scene, &profile, &point.windows[..1])?;
    Ok(begun.elapsed().as_secs_f64())
}

fn tried(benchmark: &Benchmark<'_>, backend: &dyn Backend) -> Result<Tried, ReportError> {
    let point = benchmark.sample_points.first().ok_or(ReportError::NoSamplePoints)?;
    let profile = benchmark.profile();
    let scene = benchmark.scene(&point.views, &profile)?;
    let views = &point.views;
    let step = Step { backend, scene: &scene, profile: &profile, views, encoding: None };
    // The first one allocates buffers, and compiles shaders.
    step.render()?;
    let begun = Instant::now();
    step.render()?;
    let step_s = begun.elapsed().as_secs_f64();
    render_images(backend, &scene, &profile, &point.windows)?;
    Ok(Tried { step_s, windows_s: begun.elapsed().as_secs_f64() - step_s })
}

impl std::fmt::Display for Expected {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "about {}: {} for the reference, {} for {} settings",
            duration(self.reference_s + self.settings_s),
            duration(self.reference_s),
            duration(self.settings_s),
            self.settings
        )
    }
}

/// A time in the unit in which it has few digits.
fn duration(seconds: f64) -> String {
    match seconds {
        ..100.0 => format!("{:.0} s", seconds.max(1.0)),
        ..6_000.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.1} h", seconds / 3_600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_is_said_in_few_digits() {
        let expected = Expected { reference_s: 40.2, settings_s: 700.0, settings: 38 };
        let text = "about 12 min: 40 s for the reference, 12 min for 38 settings";
        assert_eq!(expected.to_string(), text);
        assert_eq!([0.2, 99.4, 101.0, 7_200.0].map(duration), ["1 s", "99 s", "2 min", "2.0 h"]);
    }
}
