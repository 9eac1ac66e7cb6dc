//! Plots of a report, as SVG.

use plotters::coord::ranged1d::{Ranged, ValueFormatter};
use plotters::prelude::*;

use super::confidence::Confidence;
use super::error::ReportError;
use super::measurement::Measurement;
use super::recommend::pareto_front;
use super::sample_points::OFFSETS_M;
use super::setting::Family;

/// Width of a plot including its labels, and its least height.
const SIZE_PX: (u32, u32) = (1060, 520);
/// Width of the column of labels on the right.
const LABELS_PX: i32 = 290;
/// Distance between the baselines of two labels: the height of a line of 12 px.
const LINE_PX: i32 = 14;
/// Exact images have an infinite PSNR. They are drawn at this value.
const MAX_DB: f64 = 140.0;
/// Colour of settings that are not on the Pareto front.
const GREY: RGBColor = RGBColor(190, 190, 190);
/// Colour of their labels.
const GREY_TEXT: RGBColor = RGBColor(150, 150, 150);

/// Label of the axis that shows errors.
const PSNR_AXIS: &str = "PSNR against the f64 reference, dB (higher is closer)";
/// Label of the axis that shows distances.
const OFFSET_AXIS: &str = "lateral distance from the recorded drive, m";

/// Colours that also differ in lightness (after Okabe and Ito 2008).
fn color(family: Family) -> RGBColor {
    match family {
        Family::AsServed => RGBColor(0, 0, 0),
        Family::Backend => RGBColor(230, 159, 0),
        Family::Detail => RGBColor(0, 114, 178),
        Family::DrawDistance => RGBColor(90, 90, 170),
        Family::Record => RGBColor(0, 158, 115),
        Family::Antialiasing => RGBColor(120, 94, 240),
        Family::AlphaCut => RGBColor(213, 94, 0),
        Family::Stop => RGBColor(204, 121, 167),
        Family::Lens => RGBColor(150, 150, 60),
        Family::Sky => RGBColor(0, 170, 200),
        Family::Rays => RGBColor(110, 70, 30),
        Family::Scale => RGBColor(86, 180, 233),
        Family::Encoding => RGBColor(160, 130, 40),
        Family::Combined => RGBColor(180, 30, 60),
    }
}

/// PSNR over step time. A line joins the Pareto front; the other settings are grey.
pub(super) fn error_against_time(all: &[Measurement]) -> Result<String, ReportError> {
    let on_front = pareto_front(all);
    let shown = || {
        let has_psnr = |(m, _): &(&Measurement, &bool)| {
            // Compared with another reference: its PSNR has no place on this axis.
            m.setting.family != Family::Rays && !m.errors.psnr_db.is_nan()
        };
        all.iter().zip(&on_front).filter(has_psnr)
    };
    let times_ms = || shown().map(|(m, _)| m.cost.step_ms);
    // The range of the axis. Two equal ends are kept apart by the margin below.
    let min_ms = times_ms().fold(f64::INFINITY, f64::min);
    let max_ms = times_ms().fold(0.0, f64::max);
    // From the clamped value down, so that an exact setting alone still gives a range.
    let min_db = shown().map(|(m, _)| m.errors.psnr_db).fold(MAX_DB, f64::min);
    plot(all.len(), |root| {
        // The time axis is logarithmic: its coordinate is the exponent of 10.
        let mut chart = with_label_column(root).build_cartesian_2d(
            min_ms.log10() - 0.05..max_ms.log10() + 0.05,
            (min_db - 4.0).floor()..MAX_DB + 4.0,
        )?;
        // Grid lines at tenths of the exponent: 10, 13, 16, 20, 25, 32, 40, 50, 63, 79 ms.
        let time_label = |exponent: &f64| match 10.0_f64.powf(*exponent) {
            ms if ms < 10.0 => format!("{ms:.1}"),
            ms => format!("{ms:.0}"),
        };
        let mut mesh = chart.configure_mesh();
        mesh.x_desc("median time per step of all cameras, ms (logarithmic)");
        mesh.y_desc(PSNR_AXIS).x_label_formatter(&time_label);
        mesh.light_line_style(WHITE).draw()?;

        let point = |m: &Measurement| (m.cost.step_ms.log10(), clamped_db(m.errors.psnr_db));
        let front = shown().filter(|(_, is_on_front)| **is_on_front);
        let mut front: Vec<(f64, f64)> = front.map(|(m, _)| point(m)).collect();
        // The line is drawn in the order of its points.
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart.draw_series(LineSeries::new(front, BLACK.stroke_width(1)))?;

        let mut labels = Vec::new();
        // Points over the line, and labels last, so that the front's line crosses no text.
        for (m, is_on_front) in shown() {
            let own = color(m.setting.family);
            let fill = if *is_on_front { own } else { GREY };
            let radius_px = if *is_on_front { 5 } else { 4 };
            chart.draw_series([Circle::new(point(m), radius_px, fill.filled())])?;
            labels.push(Label {
                at_px: chart.backend_coord(&point(m)),
                text: &m.setting.name,
                color: if *is_on_front { own } else { GREY_TEXT },
            });
        }
        draw_labels(root, labels)
    })
}

/// PSNR over the distance from the recorded drive, with a line for each setting.
pub(super) fn error_by_offset(all: &[&Measurement]) -> Result<String, ReportError> {
    let all_db = || all.iter().flat_map(|m| m.psnr_db_by_offset.iter().map(|db| clamped_db(*db)));
    let min_db = all_db().fold(MAX_DB, f64::min);
    let max_db = all_db().fold(0.0, f64::max);
    plot(all.len(), |root| {
        let mut chart = with_label_column(root)
            .build_cartesian_2d(0.0..OFFSETS_M[3] + 0.2, (min_db - 3.0).floor()..max_db + 3.0)?;
        draw_axes(&mut chart, OFFSET_AXIS, PSNR_AXIS)?;
        let mut labels = Vec::new();
        for m in all {
            let decibels = m.psnr_db_by_offset.iter().map(|db| clamped_db(*db));
            let points: Vec<(f64, f64)> = OFFSETS_M.into_iter().zip(decibels).collect();
            let own = color(m.setting.family);
            chart.draw_series(LineSeries::new(points.clone(), own.stroke_width(2)))?;
            chart.draw_series(points.iter().map(|at| Circle::new(*at, 3, own.filled())))?;
            if let Some(last) = points.last() {
                let at_px = chart.backend_coord(last);
                labels.push(Label { at_px, text: &m.setting.name, color: own });
            }
        }
        draw_labels(root, labels)
    })
}

/// Trust over the distance from the recorded drive: the mean of all images, and the range from the
/// lowest to the highest.
pub(super) fn trust_by_offset(all: &[Confidence]) -> Result<String, ReportError> {
    plot(2, |root| {
        let mut chart =
            with_label_column(root).build_cartesian_2d(0.0..OFFSETS_M[3] + 0.2, 0.0..1.05)?;
        draw_axes(&mut chart, OFFSET_AXIS, "trust, from 0 to 1")?;
        let own = color(Family::Detail);
        // Along the lower edge, and back along the upper one.
        let lowest = all.iter().map(|c| (c.offset_m, c.min));
        let highest = all.iter().rev().map(|c| (c.offset_m, c.max));
        let range: Vec<(f64, f64)> = lowest.chain(highest).collect();
        chart.draw_series([Polygon::new(range, own.mix(0.15).filled())])?;
        let means: Vec<(f64, f64)> = all.iter().map(|c| (c.offset_m, c.mean)).collect();
        chart.draw_series(LineSeries::new(means.clone(), own.stroke_width(2)))?;
        chart.draw_series(means.iter().map(|at| Circle::new(*at, 4, own.filled())))?;
        let mut labels = Vec::new();
        if let Some(last) = all.last() {
            for (value, text) in
                [(last.mean, "mean of all images"), (last.max, "lowest to highest")]
            {
                let at_px = chart.backend_coord(&(last.offset_m, value));
                labels.push(Label { at_px, text, color: own });
            }
        }
        draw_labels(root, labels)
    })
}

fn clamped_db(db: f64) -> f64 {
    db.min(MAX_DB)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type PlotResult<T> = Result<T, Box<dyn std::error::Error>>;

/// Draws on a white area that is high enough for `labels` labels.
fn plot(
    labels: usize,
    draw: impl FnOnce(&Area<'_>) -> PlotResult<()>,
) -> Result<String, ReportError> {
    let mut svg = String::new();
    let drawn = {
        let (width, height) = SIZE_PX;
        // Room for all labels below each other, and for the axes.
        let size_px = (width, height.max(60 + LINE_PX as u32 * labels as u32));
        let root = SVGBackend::with_string(&mut svg, size_px).into_drawing_area();
        // plotters has another error type for each call; all are boxed here.
        root.fill(&WHITE).map_err(Into::into).and_then(|()| draw(&root)).and_then(|()| {
            root.present()?;
            Ok(())
        })
    };
    drawn.map_err(|error| ReportError::Plot { reason: error.to_string() })?;
    Ok(svg)
}

/// A chart that leaves the right side to the column of labels.
fn with_label_column<'a, 'b>(root: &'a Area<'b>) -> ChartBuilder<'a, 'b, SVGBackend<'b>> {
    let mut builder = ChartBuilder::on(root);
    builder.margin(14).margin_right(LABELS_PX).x_label_area_size(44).y_label_area_size(56);
    builder
}

/// The name of a point in a plot.
struct Label<'a> {
    /// The point that it names.
    at_px: (i32, i32),
    text: &'a str,
    color: RGBColor,
}

/// Writes labels in a column on the right, in the vertical order of their points and without
/// overlap. A thin line joins each label to its point.
fn draw_labels(root: &Area<'_>, mut labels: Vec<Label<'_>>) -> PlotResult<()> {
    // By height, then from left to right: lines of equal heights do not cross.
    labels.sort_by_key(|label| (label.at_px.1, label.at_px.0));
    let (width_px, height_px) = root.dim_in_pixel();
    let wanted_px: Vec<i32> = labels.iter().map(|label| label.at_px.1).collect();
    let column_px = width_px as i32 - LABELS_PX + 26;
    let heights_px = spread(&wanted_px, height_px as i32 - LINE_PX);
    for (y, label) in heights_px.into_iter().zip(labels) {
        let line = [label.at_px, (column_px - 22, y), (column_px - 4, y)];
        root.draw(&PathElement::new(line, label.color.mix(0.35).stroke_width(1)))?;
        let style = ("sans-serif", 12).into_font().color(&label.color);
        // A text is placed by its upper left corner: half a line above the end of its line.
        root.draw(&Text::new(label.text.to_owned(), (column_px, y - 7), style))?;
    }
    Ok(())
}

/// Moves rising heights apart, so that each is at least a line below the previous one and the last
/// is at most `bottom_px`. Moves them as little as possible.
fn spread(heights_px: &[i32], bottom_px: i32) -> Vec<i32> {
    let mut spread = heights_px.to_vec();
    // Down: each label at least a line below the one above.
    for i in 1..spread.len() {
        spread[i] = spread[i].max(spread[i - 1] + LINE_PX);
    }
    // Then up from the bottom: what was pushed out of the page moves back, and others with it.
    let mut below = bottom_px + LINE_PX;
    for y in spread.iter_mut().rev() {
        *y = (*y).min(below - LINE_PX);
        below = *y;
    }
    spread
}

fn draw_axes<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    x: &str,
    y: &str,
) -> PlotResult<()>
where
    X: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    chart.configure_mesh().x_desc(x).y_desc(y).light_line_style(WHITE).draw()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_do_not_overlap_and_stay_on_the_page() {
        // Three crowds: at the top, in the middle and at the lower edge.
        let heights = [10, 11, 11, 12, 200, 201, 390, 395, 399];
        let spread = spread(&heights, 400);
        assert!(spread.windows(2).all(|pair| pair[1] - pair[0] >= LINE_PX), "{spread:?}");
        // The first of the upper two crowds stays where it was; the last label is pushed to the
        // end.
        assert_eq!((spread[0], spread[4], spread[8]), (10, 200, 400));
        assert_eq!(super::spread(&[5, 300], 400), [5, 300]);
    }
}
