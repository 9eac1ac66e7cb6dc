//! The curves of a page, as SVG.

use std::error::Error;

use plotters::prelude::*;

use super::error::PageError;
use crate::history::{CurvePoint, History};

const SIZE_PX: (u32, u32) = (1_100, 300);

pub(super) const LABEL: (&str, i32) = ("sans-serif", 13);

/// Colours that also differ in lightness (Okabe and Ito 2008).
pub(super) const COLORS: [RGBColor; CURVES] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
];

/// Most curves of a plot.
const CURVES: usize = 5;

/// What a curve shows of a point.
type Value = fn(&CurvePoint) -> f64;

/// A line with its name.
type Curve<'a> = (&'a str, Vec<(f64, f64)>);

/// PSNR of the images that are held out, over time.
pub(super) fn psnr(history: &History) -> Result<String, PageError> {
    let points = history.evaluations.iter().map(|at| (at.seconds, at.held_out_db));
    svg("time, s", "PSNR, dB", &[("images that were held out", points.collect())])
}

/// The losses over the steps.
pub(super) fn losses(history: &History) -> Result<String, PageError> {
    let values: [(&str, Value); CURVES] = [
        ("L1", |point| point.l1),
        ("D-SSIM", |point| point.dssim),
        ("disparity, 1/m", |point| point.disparity),
        ("opacity of the sky", |point| point.sky),
        ("ground, weighted", |point| point.ground),
    ];
    let curve = |(name, value): (&'static str, Value)| -> Curve<'_> {
        let points = history.points.iter().map(|point| (point.step as f64, value(point)));
        (name, points.collect())
    };
    // What a run has no term of is 0 at all steps.
    let has_term = |(_, points): &Curve<'_>| points.iter().any(|&(_, value)| value != 0.0);
    let curves: Vec<Curve<'_>> = values.into_iter().map(curve).filter(has_term).collect();
    svg("step", "loss", &curves)
}

/// The number of Gaussians over the steps.
pub(super) fn gaussians(history: &History) -> Result<String, PageError> {
    let points = history.points.iter().map(|point| (point.step as f64, point.gaussians as f64));
    svg("step", "Gaussians", &[("Gaussians", points.collect())])
}

/// A number of an axis: 0.05, 20, 500 k.
fn tick(value: &f64) -> String {
    // Without the sign of a zero.
    let rounded = (1e6 * value).round() / 1e6 + 0.0;
    if rounded.abs() < 1e4 { rounded.to_string() } else { format!("{} k", rounded / 1e3) }
}

fn svg(x: &str, y: &str, curves: &[Curve<'_>]) -> Result<String, PageError> {
    let mut text = String::new();
    draw(x, y, curves, &mut text).map_err(|error| PageError::Plot(error.to_string().into()))?;
    Ok(text)
}

fn draw(x: &str, y: &str, curves: &[Curve<'_>], text: &mut String) -> Result<(), Box<dyn Error>> {
    let all = || curves.iter().flat_map(|(_, points)| points).copied();
    let is_number = |&(x, y): &(f64, f64)| x.is_finite() && y.is_finite();
    let last_x = all().filter(is_number).map(|(x, _)| x).fold(1.0, f64::max);
    let (low, high) = all()
        .filter(is_number)
        .map(|(_, y)| y)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), y| (low.min(y), high.max(y)));
    // One value, or none, has a range, too.
    let spread = if high > low { high - low } else { high.abs() };
    let margin = (0.05 * spread).max(1e-6);
    let range = if low <= high { low - margin..high + margin } else { 0.0..1.0 };
    let area = SVGBackend::with_string(text, SIZE_PX).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(8)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(0.0..last_x, range)?;
    let mut mesh = chart.configure_mesh();
    mesh.x_label_formatter(&tick).y_label_formatter(&tick);
    mesh.x_desc(x).y_desc(y).label_style(LABEL).light_line_style(WHITE).draw()?;
    for ((name, points), color) in curves.iter().zip(COLORS) {
        let points: Vec<(f64, f64)> = points.iter().copied().filter(is_number).collect();
        chart
            .draw_series(LineSeries::new(points, color.stroke_width(2)))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
    }
    if curves.len() > 1 {
        chart
            .configure_series_labels()
            .label_font(LABEL)
            .background_style(WHITE.mix(0.8))
            .draw()?;
    }
    area.present()?;
    Ok(())
}
