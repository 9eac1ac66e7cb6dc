//! Error against run time of ways to integrate the same car, for BENCHMARKS.md: run by hand, as
//! `cargo test -p wildcity-sim --test sim study -- --ignored --nocapture`. Writes
//! `ego_integrators.csv` and the picture `ego_integrators.svg` to `$WILDCITY_STUDY`, or next to the
//! built program.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use plotters::coord::Shift;
use plotters::prelude::*;
use wildcity_sim::ego::{Setpoint, SingleTrackState, Vehicle};

use crate::integrators::{Law, packed, reference, unpacked};

/// A way to integrate.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    /// Ours.
    Exact,
    /// Runge and Kutta's, order 4.
    Rk4,
    /// The midpoint rule, order 2.
    Rk2,
    /// The midpoint rule, and below 5 m/s a model that pulls to rolling with a gain of 10 1/s, as
    /// AlpaSim does it.
    Rk2Switched,
}

const WAYS: [Way; 4] = [Way::Exact, Way::Rk4, Way::Rk2, Way::Rk2Switched];
const STEPS_MS: [f64; 7] = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0];
const SPEEDS_M_S: [f64; 13] =
    [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0];
/// How long is driven, in seconds.
const DRIVEN_S: f64 = 1.0;
/// An error, in m or rad, that is as bad as any.
const LOST: f64 = 1e3;

/// The result of one method at one speed with one step.
struct Sample {
    way: Way,
    speed_m_s: f64,
    step_ms: f64,
    /// The larger of the errors of place (m) and heading (rad) after a second, at most [`LOST`].
    error: f64,
    /// Time to compute a simulated second.
    run_time: Duration,
}

#[test]
#[ignore = "measures times: run it alone, by hand"]
fn study() {
    let samples: Vec<Sample> = SPEEDS_M_S.into_iter().flat_map(at_speed).collect();
    let mut csv = "way,speed_m_s,step_ms,error_m_or_rad,us_per_simulated_s\n".to_owned();
    for Sample { way, speed_m_s, step_ms, error, run_time } in &samples {
        let run_us = run_time.as_secs_f64() * 1e6;
        writeln!(csv, "{way:?},{speed_m_s},{step_ms},{error:.3e},{run_us:.3}").unwrap();
    }
    let folder = match std::env::var_os("WILDCITY_STUDY") {
        Some(folder) => PathBuf::from(folder),
        None => PathBuf::from(env!("CARGO_TARGET_TMPDIR")),
    };
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("ego_integrators.csv"), csv).unwrap();
    let picture = folder.join("ego_integrators.svg");
    draw(&samples, &picture);
    eprintln!("look at {}", picture.display());
    let worst_exact = samples.iter().filter(|s| s.way == Way::Exact).map(|s| s.error);
    assert!(worst_exact.fold(0.0, f64::max) < 1e-9);
    let lost = |way, speed| {
        let at = |s: &&Sample| s.way == way && s.speed_m_s == speed && s.step_ms == 10.0;
        samples.iter().find(at).is_some_and(|s| s.error >= LOST)
    };
    assert!(lost(Way::Rk4, 0.1) && lost(Way::Rk2, 0.1), "what is unstable must show");
}

fn at_speed(speed_m_s: f64) -> Vec<Sample> {
    let car = Vehicle::DEFAULT;
    // As tight as the tyres of a real car would hold, 4 m/s², and no tighter than 50 m.
    let curvature = (4.0 / (speed_m_s * speed_m_s)).min(0.02);
    let steering_rad = car.steering_rad(curvature, speed_m_s);
    let told = Setpoint { acceleration_m_s2: 0.0, steering_rad };
    let start = SingleTrackState { speed_m_s, ..SingleTrackState::default() };
    let tenth = |from: SingleTrackState, _| reference(&from, told, 0.1 * DRIVEN_S);
    let right = (0..10).fold(start, tenth);
    let mut samples = Vec::new();
    for way in WAYS {
        for step_ms in STEPS_MS {
            let steps = (1e3 * DRIVEN_S / step_ms).round() as u32;
            let drive =
                || (0..steps).fold(start, |from, _| stepped(way, &from, told, 1e-3 * step_ms));
            let end = drive();
            let off =
                end.position_m.distance(right.position_m).max((end.yaw_rad - right.yaw_rad).abs());
            let error = if off < LOST { off } else { LOST };
            let timed = |_| {
                let begun = Instant::now();
                std::hint::black_box(drive());
                begun.elapsed()
            };
            // The shortest: what else the machine does only ever adds.
            let run_time = (0..20).map(timed).min().unwrap_or_default();
            samples.push(Sample { way, speed_m_s, step_ms, error, run_time });
        }
    }
    samples
}

fn stepped(way: Way, from: &SingleTrackState, told: Setpoint, step_s: f64) -> SingleTrackState {
    let law = Law { told };
    let state = packed(from);
    let rate = |state: &[f64; 8]| match way {
        Way::Rk2Switched if state[3] < 5.0 => pulled(&law, state),
        _ => law.rate(state),
    };
    let moved = |rate: &[f64; 8], by_s: f64| -> [f64; 8] {
        std::array::from_fn(|k| state[k] + by_s * rate[k])
    };
    match way {
        Way::Exact => from.after(&Vehicle::DEFAULT, told, step_s, [-10.0, 60.0]),
        Way::Rk2 | Way::Rk2Switched => {
            unpacked(moved(&rate(&moved(&rate(&state), 0.5 * step_s)), step_s))
        }
        Way::Rk4 => {
            let first = rate(&state);
            let second = rate(&moved(&first, 0.5 * step_s));
            let third = rate(&moved(&second, 0.5 * step_s));
            let fourth = rate(&moved(&third, step_s));
            let mean = |k: usize| (first[k] + 2.0 * (second[k] + third[k]) + fourth[k]) / 6.0;
            unpacked(moved(&std::array::from_fn(mean), step_s))
        }
    }
}

/// The model below the switch: lateral velocity and yaw rate are pulled to rolling without slip,
/// and the rear axle does not slip.
fn pulled(law: &Law, state: &[f64; 8]) -> [f64; 8] {
    let car = Vehicle::DEFAULT;
    let [_, _, yaw, speed, lateral, yaw_rate, steering, _] = *state;
    let rolls = speed * steering / car.wheelbase_m;
    let mut rate = law.rate(state);
    (rate[0], rate[1]) = (speed * yaw.cos(), speed * yaw.sin());
    rate[4] = 10.0 * (rolls * car.rear_to_cg_m - lateral);
    rate[5] = 10.0 * (rolls - yaw_rate);
    rate
}

fn label(way: Way) -> (&'static str, RGBColor) {
    match way {
        Way::Exact => ("exact", RGBColor(0, 90, 160)),
        Way::Rk4 => ("RK4", RGBColor(200, 80, 0)),
        Way::Rk2 => ("RK2", RGBColor(130, 130, 130)),
        Way::Rk2Switched => ("RK2, kinematic below 5 m/s", RGBColor(20, 140, 60)),
    }
}

/// Error by speed at steps of 10 ms, and error by run time at three speeds.
fn draw(samples: &[Sample], path: &std::path::Path) {
    let area = SVGBackend::new(path, (1280, 480)).into_drawing_area();
    area.fill(&WHITE).unwrap();
    let (left, right) = area.split_horizontally(520);
    by_speed(samples, &left);
    for (speed_m_s, panel) in [1.0, 5.0, 20.0].into_iter().zip(right.split_evenly((1, 3))) {
        by_run_time(samples, speed_m_s, &panel);
    }
    area.present().unwrap();
}

type Panel<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Values without any error are drawn at the bottom.
const LEAST: f64 = 1e-17;

fn by_speed(samples: &[Sample], panel: &Panel<'_>) {
    let mut chart = ChartBuilder::on(panel)
        .caption("Error after 1 s, in steps of 10 ms", ("sans-serif", 17))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(58)
        .build_cartesian_2d((8e-4..80.0).log_scale(), (LEAST..3.0 * LOST).log_scale())
        .unwrap();
    let labels = |value: &f64| format!("{value:.0e}");
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc("speed, m/s")
        .y_desc("m or rad")
        .x_label_formatter(&labels)
        .y_label_formatter(&labels)
        .draw()
        .unwrap();
    // |1 + z + z²/2| <= 1 ends at z = -2, with the next two terms at -2.785; z = -438 / v 0.01 s.
    for (limit, way) in [(437.9 * 0.01 / 2.785, Way::Rk4), (437.9 * 0.01 / 2.0, Way::Rk2)] {
        let line = [(limit, LEAST), (limit, 3.0 * LOST)];
        let (name, colour) = label(way);
        chart.draw_series(LineSeries::new(line, colour.mix(0.6).stroke_width(2))).unwrap();
        let text = format!("{name} is stable from {limit:.1} m/s on");
        // Below the errors, right of both lines.
        let height = if way == Way::Rk4 { 2e-15 } else { 1e-16 };
        let style = ("sans-serif", 12).into_font().color(&colour);
        chart.draw_series([Text::new(text, (2.5, height), style)]).unwrap();
    }
    for way in WAYS {
        let (name, colour) = label(way);
        let points: Vec<(f64, f64)> = samples
            .iter()
            .filter(|s| s.way == way && s.step_ms == 10.0)
            .map(|s| (s.speed_m_s, s.error.max(LEAST)))
            .collect();
        chart
            .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))
            .unwrap()
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
        chart
            .draw_series(points.into_iter().map(|at| Circle::new(at, 3, colour.filled())))
            .unwrap();
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::Coordinate(20, 235))
        .background_style(WHITE.mix(0.8))
        .draw()
        .unwrap();
}

fn by_run_time(samples: &[Sample], speed_m_s: f64, panel: &Panel<'_>) {
    let mut chart = ChartBuilder::on(panel)
        .caption(format!("{speed_m_s} m/s, steps 1 to 100 ms"), ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(52)
        .build_cartesian_2d((0.3..3e4).log_scale(), (LEAST..3.0 * LOST).log_scale())
        .unwrap();
    let labels = |value: &f64| format!("{value:.0e}");
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_labels(5)
        .x_desc("µs for a simulated second")
        .x_label_formatter(&labels)
        .y_label_formatter(&labels)
        .draw()
        .unwrap();
    for way in WAYS {
        let colour = label(way).1;
        let points: Vec<(f64, f64)> = samples
            .iter()
            .filter(|s| s.way == way && s.speed_m_s == speed_m_s)
            .map(|s| (s.run_time.as_secs_f64() * 1e6, s.error.max(LEAST)))
            .collect();
        chart.draw_series(LineSeries::new(points.clone(), colour.stroke_width(2))).unwrap();
        chart
            .draw_series(points.into_iter().map(|at| Circle::new(at, 3, colour.filled())))
            .unwrap();
    }
}
