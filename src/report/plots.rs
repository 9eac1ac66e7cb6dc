//! Plots of a report, as SVG.

use plotters::coord::ranged1d::{Ranged, ValueFormatter};
use plotters::prelude::*;

use super::ReportError;
use super::confidence::Confidence;
use super::measure::Measurement;
use super::recommend::pareto_front;
use super::sample_points::OFFSETS_M;
use super::settings::Family;

/// Width of a plot with its names, and its least height.
const SIZE_PX: (u32, u32) = (1060, 520);
/// What the names take on the right.
const NAMES_PX: i32 = 290;
/// From one name to the next: the height of a line of 12 px.
const LINE_PX: i32 = 14;
/// Where nothing differs PSNR has no end: such a setting is drawn here.
const MOST_DB: f64 = 140.0;
const GREY: RGBColor = RGBColor(190, 190, 190);

/// Colours that differ in lightness too (after Okabe and Ito 2008).
fn color(family: Family) -> RGBColor {
    match family {
        Family::AsServed => RGBColor(0, 0, 0),
        Family::Backend => RGBColor(230, 159, 0),
        Family::Detail => RGBColor(0, 114, 178),
        Family::Reach => RGBColor(90, 90, 170),
        Family::Record => RGBColor(0, 158, 115),
        Family::Antialiasing => RGBColor(120, 94, 240),
        Family::AlphaCut => RGBColor(213, 94, 0),
        Family::Stop => RGBColor(204, 121, 167),
        Family::Sky => RGBColor(0, 170, 200),
        Family::Rays => RGBColor(110, 70, 30),
        Family::Scale => RGBColor(86, 180, 233),
        Family::Sent => RGBColor(160, 130, 40),
        Family::Combined => RGBColor(180, 30, 60),
    }
}

/// Error against time: the Pareto front joined by a line, and what is beaten in grey.
pub(super) fn error_against_time(all: &[Measurement]) -> Result<String, ReportError> {
    let on_front = pareto_front(all);
    let shown = || {
        let asked = |(m, _): &(&Measurement, &bool)| {
            m.setting.family != Family::Rays && !m.errors.psnr_db.is_nan()
        };
        all.iter().zip(&on_front).filter(asked)
    };
    let (least, most) = shown()
        .map(|(m, _)| m.cost.step_ms)
        .fold((f64::INFINITY, 0.0_f64), |(low, high), ms| (low.min(ms), high.max(ms)));
    let lowest = shown().map(|(m, _)| m.errors.psnr_db).fold(MOST_DB, f64::min);
    plot(all.len(), |root| {
        let mut chart = with_room_for_names(root).build_cartesian_2d(
            least.log10() - 0.05..most.log10() + 0.05,
            (lowest - 4.0).floor()..MOST_DB + 4.0,
        )?;
        // Powers of 10 at tenths: 10, 13, 16, 20, 25, 32, 40, 50, 63, 79.
        let time = |exponent: &f64| match 10.0_f64.powf(*exponent) {
            ms if ms < 10.0 => format!("{ms:.1}"),
            ms => format!("{ms:.0}"),
        };
        let y = "PSNR against f64, dB";
        let mut mesh = chart.configure_mesh();
        mesh.x_desc("milliseconds a step").y_desc(y).x_label_formatter(&time);
        mesh.light_line_style(WHITE).draw()?;
        let at = |m: &Measurement| (m.cost.step_ms.log10(), shown_db(m.errors.psnr_db));
        let mut line: Vec<(f64, f64)> =
            shown().filter(|(_, is_on)| **is_on).map(|(m, _)| at(m)).collect();
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart.draw_series(LineSeries::new(line, BLACK.stroke_width(1)))?;
        let mut names = Vec::new();
        for (m, is_on) in shown() {
            let own = if *is_on { color(m.setting.family) } else { GREY };
            chart.draw_series([Circle::new(at(m), if *is_on { 5 } else { 4 }, own.filled())])?;
            let ink = if *is_on { own } else { RGBColor(150, 150, 150) };
            names.push((chart.backend_coord(&at(m)), m.setting.name.as_str(), ink));
        }
        name(root, names)
    })
}

/// PSNR over the distance from the recorded drive, a line for each setting of a family.
pub(super) fn error_beside_the_drive(all: &[&Measurement]) -> Result<String, ReportError> {
    let all_db = || all.iter().flat_map(|m| m.psnr_db_by_offset.iter().map(|db| shown_db(*db)));
    let (low, high) = (all_db().fold(MOST_DB, f64::min), all_db().fold(0.0, f64::max));
    plot(all.len(), |root| {
        let mut chart = with_room_for_names(root)
            .build_cartesian_2d(0.0..OFFSETS_M[3] + 0.2, (low - 3.0).floor()..high + 3.0)?;
        axes(&mut chart, "metres beside the recorded drive", "PSNR against f64, dB")?;
        let mut names = Vec::new();
        for m in all {
            let points: Vec<(f64, f64)> = (OFFSETS_M.into_iter())
                .zip(m.psnr_db_by_offset.iter().map(|db| shown_db(*db)))
                .collect();
            let own = color(m.setting.family);
            chart.draw_series(LineSeries::new(points.clone(), own.stroke_width(2)))?;
            chart.draw_series(points.iter().map(|at| Circle::new(*at, 3, own.filled())))?;
            if let Some(last) = points.last() {
                names.push((chart.backend_coord(last), m.setting.name.as_str(), own));
            }
        }
        name(root, names)
    })
}

/// Trust over the distance from the recorded drive: of an image on average, and from the least to the most.
pub(super) fn trust_beside_the_drive(all: &[Confidence]) -> Result<String, ReportError> {
    plot(2, |root| {
        let mut chart =
            with_room_for_names(root).build_cartesian_2d(0.0..OFFSETS_M[3] + 0.2, 0.0..1.05)?;
        axes(&mut chart, "metres beside the recorded drive", "trust")?;
        let (own, mut names) = (RGBColor(0, 114, 178), Vec::new());
        let span = all.iter().map(|b| (b.offset_m, b.least));
        let span: Vec<_> = span.chain(all.iter().rev().map(|b| (b.offset_m, b.most))).collect();
        chart.draw_series([Polygon::new(span, own.mix(0.15).filled())])?;
        let points: Vec<(f64, f64)> = all.iter().map(|b| (b.offset_m, b.mean)).collect();
        chart.draw_series(LineSeries::new(points.clone(), own.stroke_width(2)))?;
        chart.draw_series(points.iter().map(|at| Circle::new(*at, 4, own.filled())))?;
        if let Some(last) = all.last() {
            let [mean, most] =
                [last.mean, last.most].map(|y| chart.backend_coord(&(last.offset_m, y)));
            names.push((mean, "mean of all images", own));
            names.push((most, "from the least to the most", own));
        }
        name(root, names)
    })
}

fn shown_db(db: f64) -> f64 {
    db.min(MOST_DB)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Drawn<T> = Result<T, Box<dyn std::error::Error>>;

/// Draws on a white page that has room for so many names.
fn plot(names: usize, draw: impl FnOnce(&Area<'_>) -> Drawn<()>) -> Result<String, ReportError> {
    let mut svg = String::new();
    let drawn = {
        let (width, height) = SIZE_PX;
        let size_px = (width, height.max(60 + LINE_PX as u32 * names as u32));
        let root = SVGBackend::with_string(&mut svg, size_px).into_drawing_area();
        root.fill(&WHITE).map_err(Into::into).and_then(|()| draw(&root)).and_then(|()| {
            root.present()?;
            Ok(())
        })
    };
    drawn.map_err(|error| ReportError::Plot { reason: error.to_string() })?;
    Ok(svg)
}

/// A chart that leaves the right side to the names of what is on it.
fn with_room_for_names<'a, 'b>(root: &'a Area<'b>) -> ChartBuilder<'a, 'b, SVGBackend<'b>> {
    let mut builder = ChartBuilder::on(root);
    builder.margin(14).margin_right(NAMES_PX).x_label_area_size(44).y_label_area_size(56);
    builder
}

/// Writes names at the right, in the order of the heights of what they name and none over another, each
/// with a thin line to it.
fn name(root: &Area<'_>, mut names: Vec<((i32, i32), &str, RGBColor)>) -> Drawn<()> {
    names.sort_by_key(|((x, y), ..)| (*y, *x));
    let (width, height) = root.dim_in_pixel();
    let heights: Vec<i32> = names.iter().map(|((_, y), ..)| *y).collect();
    let column_px = width as i32 - NAMES_PX + 26;
    for (y, (at, text, ink)) in spread(&heights, height as i32 - LINE_PX).into_iter().zip(names) {
        let line = [at, (column_px - 22, y), (column_px - 4, y)];
        root.draw(&PathElement::new(line, ink.mix(0.35).stroke_width(1)))?;
        let style = ("sans-serif", 12).into_font().color(&ink);
        root.draw(&Text::new(text.to_owned(), (column_px, y - 7), style))?;
    }
    Ok(())
}

/// Rising heights, moved so that each is at least a line below the one before and the last is at most
/// `bottom_px`: as little as that takes.
fn spread(heights_px: &[i32], bottom_px: i32) -> Vec<i32> {
    let mut spread = heights_px.to_vec();
    for i in 1..spread.len() {
        spread[i] = spread[i].max(spread[i - 1] + LINE_PX);
    }
    let mut below = bottom_px + LINE_PX;
    for y in spread.iter_mut().rev() {
        *y = (*y).min(below - LINE_PX);
        below = *y;
    }
    spread
}

fn axes<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    x: &str,
    y: &str,
) -> Drawn<()>
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
    fn names_keep_apart_and_on_the_page() {
        let heights = [10, 11, 11, 12, 200, 201, 390, 395, 399];
        let spread = spread(&heights, 400);
        assert!(spread.windows(2).all(|pair| pair[1] - pair[0] >= LINE_PX), "{spread:?}");
        assert_eq!((spread[0], spread[4], spread[8]), (10, 200, 400));
        assert_eq!(super::spread(&[5, 300], 400), [5, 300]);
    }
}
