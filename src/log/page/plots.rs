//! The plots of the page, as SVG.

use std::error::Error;

use plotters::prelude::*;

use crate::check::{Report, Stream};
use crate::error::LogError;

const WIDTH_PX: u32 = 1100;

/// Height of a sensor in the timing plot, in pixels.
const ROW_PX: u32 = 18;

const MISSING: RGBColor = RGBColor(230, 150, 60);

const LABEL: (&str, i32) = ("sans-serif", 13);

type Drawn = Result<(), Box<dyn Error>>;

/// A plot, or the reason why there is none.
fn svg(draw: impl FnOnce(&mut String) -> Drawn) -> Result<String, LogError> {
    let mut text = String::new();
    draw(&mut text).map_err(|error| LogError::malformed("page".as_ref(), error))?;
    Ok(text)
}

/// The path from above, x to the right and y upwards, with equal scales.
pub(super) fn path(report: &Report) -> Result<String, LogError> {
    svg(|text| draw_path(&report.path.points_m, &report.lane_lines_m, text))
}

fn draw_path(points_m: &[[f64; 2]], lanes_m: &[Vec<[f64; 2]>], text: &mut String) -> Drawn {
    let range = |axis: usize| {
        let values = points_m.iter().map(|point| point[axis]);
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    };
    let (left, right) = range(0);
    let (below, above) = range(1);
    let middle_x = 0.5 * (left + right);
    let middle_y = 0.5 * (below + above);
    let height_px = 500;
    // A margin, and a path of one point has a size, too.
    let across = 1.1 * (right - left).max(1.0);
    let up = 1.1 * (above - below).max(1.0);
    let m_per_px = (across / f64::from(WIDTH_PX)).max(up / f64::from(height_px));
    let half_x = 0.5 * m_per_px * f64::from(WIDTH_PX);
    let half_y = 0.5 * m_per_px * f64::from(height_px);
    let area = SVGBackend::with_string(text, (WIDTH_PX, height_px)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(8)
        .x_label_area_size(24)
        .y_label_area_size(60)
        .build_cartesian_2d(
        middle_x - half_x..middle_x + half_x,
        middle_y - half_y..middle_y + half_y,
    )?;
    chart.configure_mesh().x_desc("x, m").y_desc("y, m").label_style(LABEL).draw()?;
    for lane_m in lanes_m {
        let lane = lane_m.iter().map(|[x, y]| (*x, *y));
        chart.draw_series(LineSeries::new(lane, RGBColor(190, 190, 190).stroke_width(1)))?;
    }
    let line = points_m.iter().map(|[x, y]| (*x, *y));
    chart.draw_series(LineSeries::new(line, BLUE.stroke_width(2)))?;
    let start = points_m.first().map(|[x, y]| Circle::new((*x, *y), 5, GREEN.filled()));
    chart.draw_series(start)?;
    area.present()?;
    Ok(())
}

/// A bar for each sensor: dark where its rows are, light where some are missing.
pub(super) fn timing(report: &Report) -> Result<String, LogError> {
    let spans = report.streams.iter().filter_map(|stream| stream.span_us);
    let from_us = spans.clone().map(|[from_us, _]| from_us).min().unwrap_or(0);
    let to_us = spans.map(|[_, to_us]| to_us).max().unwrap_or(1);
    svg(|text| draw_timing(&report.streams, [from_us, to_us].map(|us| us as f64 / 1e6), text))
}

fn draw_timing(streams: &[Stream], [from_s, to_s]: [f64; 2], text: &mut String) -> Drawn {
    let count = streams.len() as u32;
    let size = (WIDTH_PX, ROW_PX * count + 60);
    let area = SVGBackend::with_string(text, size).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(8)
        .x_label_area_size(30)
        .y_label_area_size(130)
        // Downwards, so that the first sensor is on top; a single row has a range of time, too.
        .build_cartesian_2d(from_s..to_s.max(from_s + 1e-3), f64::from(count)..0.0)?;
    chart.configure_mesh().disable_mesh().disable_y_axis().x_desc("s").label_style(LABEL).draw()?;
    for (index, stream) in streams.iter().enumerate() {
        let top = index as f64 + 0.15;
        let bars = runs(stream).into_iter().map(|(begin_s, end_s, is_full)| {
            let color = if is_full { RGBColor(40, 90, 160) } else { MISSING };
            Rectangle::new([(begin_s, top), (end_s, top + 0.7)], color.filled())
        });
        chart.draw_series(bars)?;
        let gaps = stream.longest.iter().map(|gap| {
            let begin_s = gap.from_us as f64 / 1e6;
            let corners = [(begin_s, top), (begin_s + gap.length_us as f64 / 1e6, top + 0.7)];
            Rectangle::new(corners, MISSING.filled())
        });
        chart.draw_series(gaps)?;
        let (_, y) = chart.backend_coord(&(from_s, top));
        let at = (4, y);
        area.draw(&Text::new(stream.sensor.clone(), at, LABEL))?;
    }
    area.present()?;
    Ok(())
}

/// Runs of columns with rows: from, to, in seconds, and whether no row is missing.
fn runs(stream: &Stream) -> Vec<(f64, f64, bool)> {
    let Some([first_us, last_us]) = stream.span_us else { return Vec::new() };
    let columns = stream.columns.len().max(1) as f64;
    let column_us = last_us.abs_diff(first_us) as f64 / columns;
    let expected = stream.period_us.map_or(1.0, |us| (column_us / us).floor().max(1.0));
    // A column that a period can miss by chance is full, too.
    let is_full = |rows: u32| f64::from(rows) >= expected - 1.0;
    let mut all = Vec::new();
    let mut begin = 0;
    for run in stream.columns.chunk_by(|a, b| is_full(*a) == is_full(*b)) {
        let second = |column: usize| (first_us as f64 + column as f64 * column_us) / 1e6;
        let end = begin + run.len();
        all.push((second(begin), second(end), is_full(run[0])));
        begin = end;
    }
    all
}

/// The fit of LiDAR to the images of each camera at differences of the clocks.
pub(super) fn curves(report: &Report) -> Result<String, LogError> {
    svg(|text| draw_curves(report, text))
}

fn draw_curves(report: &Report, text: &mut String) -> Drawn {
    let points = report.alignment.iter().flat_map(|one| &one.curve);
    let fits = points.map(|[_, fit]| *fit);
    let (low, high) =
        fits.fold((f64::INFINITY, 0.0_f64), |(low, high), fit| (low.min(fit), high.max(fit)));
    // Without any curve `low` is still infinite.
    let low = low.min(high);
    let area = SVGBackend::with_string(text, (WIDTH_PX, 320)).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(8)
        .x_label_area_size(30)
        .y_label_area_size(60)
        // The differences that are tried, in milliseconds; above, a margin, so that a level curve
        // has a range as well.
        .build_cartesian_2d(-100.0..100.0, low..high + 0.01)?;
    chart.configure_mesh().x_desc("LiDAR late, ms").y_desc("fit").label_style(LABEL).draw()?;
    for (index, one) in report.alignment.iter().enumerate() {
        let color = Palette99::pick(index).stroke_width(2);
        let line = one.curve.iter().map(|[ms, fit]| (*ms, *fit));
        let series = chart.draw_series(LineSeries::new(line, color))?;
        series.label(one.camera.clone()).legend(move |(x, y)| {
            PathElement::new([(x, y), (x + 16, y)], Palette99::pick(index).stroke_width(2))
        });
    }
    chart.configure_series_labels().background_style(WHITE).label_font(LABEL).draw()?;
    area.present()?;
    Ok(())
}
