//! Plots of a report, as SVG.

use plotters::coord::ranged1d::{Ranged, ValueFormatter};
use plotters::prelude::*;

use super::ReportError;
use super::choose::front;
use super::ladder::Family;
use super::measure::Measured;
use super::places::OFFSETS_M;

const SIZE_PX: (u32, u32) = (900, 520);
/// Where nothing differs PSNR has no end: such a setting is drawn here.
const MOST_DB: f64 = 140.0;
const GREY: RGBColor = RGBColor(190, 190, 190);

/// Colours that differ in lightness too (after Okabe and Ito 2008).
fn color(family: Family) -> RGBColor {
    match family {
        Family::AsServed => RGBColor(0, 0, 0),
        Family::Backend => RGBColor(230, 159, 0),
        Family::Detail => RGBColor(0, 114, 178),
        Family::Record => RGBColor(0, 158, 115),
        Family::Antialiasing => RGBColor(120, 94, 240),
        Family::AlphaCut => RGBColor(213, 94, 0),
        Family::Stop => RGBColor(204, 121, 167),
        Family::Scale => RGBColor(86, 180, 233),
        Family::Sent => RGBColor(160, 130, 40),
        Family::Combined => RGBColor(180, 30, 60),
    }
}

/// Error against time: the Pareto front joined by a line, and what is beaten in grey.
pub(super) fn error_against_time(all: &[Measured]) -> Result<String, ReportError> {
    let (on_front, times) = (front(all), all.iter().map(|m| m.cost.step_ms));
    let (least, most) =
        times.fold((f64::INFINITY, 0.0_f64), |(low, high), ms| (low.min(ms), high.max(ms)));
    let lowest = all.iter().map(|m| m.errors.psnr_db).fold(MOST_DB, f64::min);
    plot(|root| {
        let mut chart = ChartBuilder::on(root)
            .margin(14)
            .x_label_area_size(44)
            .y_label_area_size(56)
            .build_cartesian_2d(
                (0.8 * least..1.6 * most).log_scale(),
                (lowest - 4.0).floor()..MOST_DB + 4.0,
            )?;
        axes(&mut chart, "milliseconds a step (log)", "PSNR against f64, dB")?;
        let mut line: Vec<(f64, f64)> = (all.iter().zip(&on_front))
            .filter(|(_, is_on)| **is_on)
            .map(|(m, _)| (m.cost.step_ms, shown_db(m.errors.psnr_db)))
            .collect();
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart.draw_series(LineSeries::new(line, BLACK.stroke_width(1)))?;
        for (m, is_on) in all.iter().zip(on_front) {
            let at = (m.cost.step_ms, shown_db(m.errors.psnr_db));
            let own = if is_on { color(m.setting.family) } else { GREY };
            chart.draw_series([Circle::new(at, if is_on { 5 } else { 4 }, own.filled())])?;
            let text = ("sans-serif", 12).into_font().color(&if is_on { BLACK } else { GREY });
            let label = EmptyElement::at(at) + Text::new(m.setting.name.clone(), (7, -5), text);
            chart.draw_series([label])?;
        }
        Ok(())
    })
}

/// PSNR over the distance from the recorded drive, a line for each setting of a family.
pub(super) fn error_beside_the_drive(all: &[&Measured]) -> Result<String, ReportError> {
    let all_db = || all.iter().flat_map(|m| m.psnr_db_by_offset.iter().map(|db| shown_db(*db)));
    let (low, high) = (all_db().fold(MOST_DB, f64::min), all_db().fold(0.0, f64::max));
    plot(|root| {
        let mut chart = ChartBuilder::on(root)
            .margin(14)
            .x_label_area_size(44)
            .y_label_area_size(56)
            .build_cartesian_2d(0.0..OFFSETS_M[3] + 1.2, (low - 3.0).floor()..high + 3.0)?;
        axes(&mut chart, "metres beside the recorded drive", "PSNR against f64, dB")?;
        for m in all {
            let points =
                OFFSETS_M.into_iter().zip(m.psnr_db_by_offset.iter().map(|db| shown_db(*db)));
            let points: Vec<(f64, f64)> = points.collect();
            let own = color(m.setting.family);
            chart.draw_series(LineSeries::new(points.clone(), own.stroke_width(2)))?;
            chart.draw_series(points.iter().map(|at| Circle::new(*at, 3, own.filled())))?;
            if let Some(last) = points.last() {
                let text = ("sans-serif", 12).into_font().color(&BLACK);
                let label =
                    EmptyElement::at(*last) + Text::new(m.setting.name.clone(), (8, -6), text);
                chart.draw_series([label])?;
            }
        }
        Ok(())
    })
}

fn shown_db(db: f64) -> f64 {
    db.min(MOST_DB)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

/// Draws on a white page.
fn plot(
    draw: impl FnOnce(&Area<'_>) -> Result<(), Box<dyn std::error::Error>>,
) -> Result<String, ReportError> {
    let mut svg = String::new();
    let drawn = {
        let root = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
        root.fill(&WHITE).map_err(Into::into).and_then(|()| draw(&root)).and_then(|()| {
            root.present()?;
            Ok(())
        })
    };
    drawn.map_err(|error: Box<dyn std::error::Error>| ReportError::Plot {
        reason: error.to_string(),
    })?;
    Ok(svg)
}

fn axes<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    x: &str,
    y: &str,
) -> Result<(), Box<dyn std::error::Error>>
where
    X: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    chart.configure_mesh().x_desc(x).y_desc(y).light_line_style(WHITE).draw()?;
    Ok(())
}
