//! Plots of a driven episode, as SVG: the drive from above, and the speed over time.

use std::fmt::Write as _;
use std::path::Path;

use glam::DVec2;

use wildcity_episode::{EpisodeFile, drive_record};
use wildcity_score::DriveRecord;

use crate::entry::EpisodeEntry;

/// Colours of the plots.
const DRIVEN: &str = "#0072b2";
const RECORDED: &str = "#bbb";
const ACTORS: &str = "#d55e00";
const FAULT: &str = "#b00020";
const TEXT: &str = "#444";

/// Width and height of a plot, and its margin, in pixels.
const SIZE_PX: DVec2 = DVec2::new(420.0, 220.0);
const MARGIN_PX: f64 = 28.0;

/// Both plots of an episode as SVG; `None` if its record cannot be read.
pub(crate) fn plots(episode: &EpisodeEntry, episodes: &Path) -> Option<String> {
    let record = EpisodeFile::read(&episodes.join(&episode.record)).ok()?;
    let drive = drive_record(&record)?;
    // The samples by index, which both plots share.
    let faults: Vec<usize> =
        episode.faults.iter().filter_map(|fault| sample_at(&drive, fault.time_us)).collect();
    Some(from_above(&drive, &faults) + &speed(&drive, &faults))
}

/// Maps values to pixels, with the same scale on both axes if `is_even`.
struct Frame {
    least: DVec2,
    scale: DVec2,
}

impl Frame {
    fn around(points: &[DVec2], is_even: bool) -> Self {
        let least = points.iter().fold(DVec2::INFINITY, |least, point| least.min(*point));
        let most = points.iter().fold(DVec2::NEG_INFINITY, |most, point| most.max(*point));
        // A standing ego has no extent; then a metre, or a second, is shown.
        let extent = (most - least).max(DVec2::ONE);
        let room_px = SIZE_PX - 2.0 * MARGIN_PX;
        let scale = room_px / extent;
        // An even scale keeps angles; the smaller one fits both axes.
        let scale = if is_even { DVec2::splat(scale.min_element()) } else { scale };
        Self { least, scale }
    }

    fn at(&self, point: DVec2) -> DVec2 {
        let px = (point - self.least) * self.scale;
        // In SVG y points down.
        DVec2::new(MARGIN_PX + px.x, SIZE_PX.y - MARGIN_PX - px.y)
    }
}

/// The drive from above, with a dot at the samples of faults.
fn from_above(drive: &DriveRecord, faults: &[usize]) -> String {
    let ego: Vec<DVec2> = drive.ego.iter().map(|sample| sample.origin_m).collect();
    let route = drive.reference.as_ref().map_or(Vec::new(), |drive| drive.line.points_m().to_vec());
    // Around the drive and the recording only: an actor far away would make both a dot.
    let all: Vec<DVec2> = ego.iter().chain(&route).copied().collect();
    let frame = Frame::around(&all, true);
    let legend =
        [(DRIVEN, "driven"), (RECORDED, "recorded"), (ACTORS, "actors"), (FAULT, "faults")];
    let mut svg = begin("from above", &legend);
    scale_bar(&mut svg, &frame);
    // Drawn from the back to the front: the recording is the widest and lies below the drive.
    line(&mut svg, &frame, &route, RECORDED, 4.0);
    let tracks = drive.tracks.iter().flatten();
    for track in tracks {
        // `flatten` leaves out the steps at which the actor is absent.
        let there: Vec<DVec2> =
            track.samples.iter().flatten().map(|sample| sample.footprint.center_m).collect();
        line(&mut svg, &frame, &there, ACTORS, 1.5);
    }
    line(&mut svg, &frame, &ego, DRIVEN, 2.0);
    for &at in faults {
        dot(&mut svg, frame.at(ego[at]));
    }
    svg + "</svg>"
}

fn speed(drive: &DriveRecord, faults: &[usize]) -> String {
    let step_s = drive.dt_us as f64 * 1e-6;
    let points: Vec<DVec2> = drive
        .ego
        .iter()
        .enumerate()
        .map(|(step, sample)| DVec2::new(step as f64 * step_s, sample.speed_mps()))
        .collect();
    // With the origin, so that standstill is at the bottom and not the lowest speed.
    let with_zero: Vec<DVec2> = points.iter().copied().chain([DVec2::ZERO]).collect();
    let frame = Frame::around(&with_zero, false);
    let most = points.iter().map(|point| point.y).fold(0.0, f64::max);
    let end_s = points.last().map_or(0.0, |point| point.x);
    let mut svg = begin(&format!("speed, 0 to {most:.1} m/s over {end_s:.1} s"), &[]);
    let axis = [DVec2::ZERO, DVec2::new(end_s, 0.0)];
    line(&mut svg, &frame, &axis, RECORDED, 1.0);
    line(&mut svg, &frame, &points, DRIVEN, 2.0);
    for &at in faults {
        dot(&mut svg, frame.at(points[at]));
    }
    svg + "</svg>"
}

/// The sample at a time, in microseconds; that of a contact within a step is the one before it.
fn sample_at(drive: &DriveRecord, time_us: i64) -> Option<usize> {
    let last = drive.ego.len() as i64 - 1;
    // Rounded down: the sample before the time.
    let step = time_us / drive.dt_us.max(1);
    usize::try_from(step.clamp(0, last)).ok()
}

// Writing into a text cannot fail.

/// The head of a plot: what it shows, and the name of each colour. At 12 px a character takes 7 px
/// on average at most, and a plot is 420 px wide.
fn begin(title: &str, legend: &[(&str, &str)]) -> String {
    let DVec2 { x, y } = SIZE_PX;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{x}\" height=\"{y}\" viewBox=\"0 0 {x} {y}\">\
         <text x=\"6\" y=\"14\" font-size=\"12\" fill=\"{TEXT}\">{title}"
    );
    for (color, name) in legend {
        let _ = write!(svg, " <tspan dx=\"6\" fill=\"{color}\">\u{25cf}</tspan> {name}");
    }
    svg + "</text>"
}

fn line(svg: &mut String, frame: &Frame, points: &[DVec2], color: &str, width: f64) {
    if points.len() < 2 {
        return;
    }
    let _ = write!(
        svg,
        "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\" points=\""
    );
    for point in points {
        let DVec2 { x, y } = frame.at(*point);
        let _ = write!(svg, "{x:.1},{y:.1} ");
    }
    svg.push_str("\"/>");
}

/// A bar of 1, 10, 100 .. m, as long as fits into a third of the plot.
fn scale_bar(svg: &mut String, frame: &Frame) {
    let most_m = SIZE_PX.x / 3.0 / frame.scale.x;
    // The largest power of ten that is not longer.
    let bar_m = 10.0_f64.powf(most_m.log10().floor());
    let from = DVec2::new(MARGIN_PX, SIZE_PX.y - 8.0);
    let to_x = from.x + bar_m * frame.scale.x;
    let _ = write!(
        svg,
        "<path d=\"M{:.1} {:.1}H{to_x:.1}\" stroke=\"{TEXT}\" stroke-width=\"2\"/>\
         <text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\" fill=\"{TEXT}\">{bar_m} m</text>",
        from.x,
        from.y,
        to_x + 6.0,
        from.y + 4.0
    );
}

fn dot(svg: &mut String, at: DVec2) {
    let DVec2 { x, y } = at;
    let _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\" fill=\"{FAULT}\"/>");
}
