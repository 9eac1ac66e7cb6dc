//! Runs with several settings as one page: what to use, PSNR over time, all runs, and what they
//! show of one image.

use std::error::Error;

use maud::{Markup, html};
use plotters::prelude::*;

use super::curves::{COLORS, LABEL};
use super::{PageError, document, figure, plot};
use crate::compare::{Advice, ComparedRun, SMALL_LOSS_DB, advice, pareto_front};
use crate::held_out::HeldOut;

/// What a page about several runs shows.
#[derive(Clone, Copy, Debug)]
pub struct Comparison<'a> {
    /// What the runs have learned from, for a person.
    pub source: &'a str,
    /// The command of a run, but for its size, steps and cap.
    pub command: &'a str,
    /// The backend that they ran on.
    pub backend: &'a str,
    /// Number of images that judge them, and their width as a fraction of the recorded one.
    pub judged_by: (usize, f64),
    pub runs: &'a [ComparedRun],
    /// What each run shows in the place of one image.
    pub images: &'a [HeldOut],
}

/// The page of a comparison, without any other file.
///
/// # Errors
/// The plot or a picture cannot be made.
pub fn comparison_page(comparison: &Comparison<'_>) -> Result<String, PageError> {
    let Comparison { source, command, backend, judged_by: (count, size), runs, images } =
        *comparison;
    let on_front = pareto_front(runs);
    let body = html! {
        @match answers(command, runs).as_slice() {
            [] => { p.verdict { (NO_ANSWER) } }
            all => {
                @for (answer, line) in all { p.verdict { (answer) ":" } pre.command { (line) } }
            }
        }
        h2 { "Error against time" }
        (plot(error_against_time(runs, &on_front)?))
        p {
            "Mean PSNR of " (count) " images that were held out, at " (size) " x their recorded width, over the time of all \
             steps on backend " (backend) ". A line joins runs of the same size and cap. Filled, and ● in the table: no other \
             run is as good in less time."
        }
        (table(runs, &on_front))
        @if !images.is_empty() {
            h2 { "One image that was held out" }
            (pictures(runs, images)?)
        }
    };
    Ok(document(&format!("Training on {source}: settings compared"), &body))
}

const NO_ANSWER: &str = "No run has made a scene that can be judged.";

/// What to use, in a sentence or two.
pub fn verdict(command: &str, runs: &[ComparedRun]) -> String {
    let sentences: Vec<String> = answers(command, runs)
        .into_iter()
        .map(|(answer, line)| format!("{answer}: {line}."))
        .collect();
    if sentences.is_empty() { NO_ANSWER.to_owned() } else { sentences.join(" ") }
}

/// The best run and, if it is another one, the quick one: what is said of it, and its command.
fn answers(command: &str, runs: &[ComparedRun]) -> Vec<(String, String)> {
    let Some(Advice { best, quick }) = advice(runs) else { return Vec::new() };
    let answer = |run: &ComparedRun, what: &str| {
        let ComparedRun { size, steps, cap, held_out_db, seconds, .. } = run;
        (
            format!("{held_out_db:.2} dB in {seconds:.0} s is {what}"),
            format!("{command} --size {size} --steps {steps} --cap {cap}"),
        )
    };
    let quickest = format!("the quickest within {SMALL_LOSS_DB} dB");
    let mut all = vec![answer(best, "the best")];
    all.extend(quick.map(|quick| answer(quick, &quickest)));
    all
}

fn table(runs: &[ComparedRun], on_front: &[bool]) -> Markup {
    html! {
        table {
            tr {
                th { "size" } th { "steps" } th { "cap" } th { "Gaussians" } th { "time, s" } th { "held out, dB" }
            }
            @for (run, on_front) in runs.iter().zip(on_front) {
                tr {
                    td { (run.size) } td { (run.steps) } td { (run.cap) } td { (run.gaussians) }
                    td { (format!("{:.1}", run.seconds)) }
                    td { @if *on_front { "●\u{a0}" } (format!("{:.2}", run.held_out_db)) }
                }
            }
        }
    }
}

fn pictures(runs: &[ComparedRun], images: &[HeldOut]) -> Result<Markup, PageError> {
    let mut figures = Vec::new();
    // All runs show the same recorded image, so that the first one's copy serves for all.
    if let Some(HeldOut { name, size_px, recorded, .. }) = images.first() {
        figures.push(figure(&format!("recorded: {name}"), *size_px, recorded)?);
    }
    for (run, image) in runs.iter().zip(images) {
        let ComparedRun { size, steps, cap, seconds, .. } = run;
        let caption = format!(
            "size {size}, {steps} steps, cap {cap}: {:.2} dB here, {seconds:.0} s",
            image.psnr_db
        );
        figures.push(figure(&caption, image.size_px, &image.drawn)?);
    }
    Ok(html! { div.pictures { @for figure in &figures { (figure) } } })
}

const SIZE_PX: (u32, u32) = (1_100, 420);

/// PSNR over time, as SVG.
fn error_against_time(runs: &[ComparedRun], on_front: &[bool]) -> Result<String, PageError> {
    let mut text = String::new();
    draw(runs, on_front, &mut text).map_err(|error| PageError::Plot(error.to_string().into()))?;
    Ok(text)
}

fn draw(runs: &[ComparedRun], on_front: &[bool], text: &mut String) -> Result<(), Box<dyn Error>> {
    // The time axis is logarithmic: its coordinate is the exponent of 10.
    // A run of no time counts as one of 1 ms: 0 has no logarithm.
    let point = |run: &ComparedRun| (run.seconds.max(1e-3).log10(), run.held_out_db);
    let judged = || runs.iter().zip(on_front).filter(|(run, _)| run.is_judged());
    let range = |values: &mut dyn Iterator<Item = f64>, margin: f64| {
        let ends = (f64::INFINITY, f64::NEG_INFINITY);
        let (low, high) = values.fold(ends, |(low, high), v| (low.min(v), high.max(v)));
        // Without any run that is judged, `low` is infinite, which is no range for an axis.
        if low <= high { low - margin..high + margin } else { 0.0..1.0 }
    };
    // Margins of 12 % in time (10^0.05) and of 0.5 dB keep the circles off the frame.
    let x = range(&mut judged().map(|(run, _)| point(run).0), 0.05);
    let y = range(&mut judged().map(|(run, _)| point(run).1), 0.5);
    let area = SVGBackend::with_string(text, SIZE_PX).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(8)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_desc("time of all steps, s (logarithmic)")
        .y_desc("PSNR of images that were held out, dB")
        .x_label_formatter(&|exponent| match 10.0_f64.powf(*exponent) {
            seconds if seconds < 10.0 => format!("{seconds:.1}"),
            seconds => format!("{seconds:.0}"),
        })
        .label_style(LABEL)
        // White on white: only the lines that have a label are seen.
        .light_line_style(WHITE)
        .draw()?;
    // In the order of the runs and not of a hash, so that the same runs have the same colours on
    // every page.
    let mut lines: Vec<(f64, usize)> = Vec::new();
    for run in runs {
        if !lines.contains(&(run.size, run.cap)) {
            lines.push((run.size, run.cap));
        }
    }
    for ((size, cap), color) in lines.into_iter().zip(COLORS.into_iter().cycle()) {
        let is_own = |(run, _): &(&ComparedRun, &bool)| (run.size, run.cap) == (size, cap);
        let own = || judged().filter(is_own);
        let mut points: Vec<(f64, f64)> = own().map(|(run, _)| point(run)).collect();
        // A line leads from the quick runs to the slow ones, in whatever order they were made.
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart
            .draw_series(LineSeries::new(points, color.stroke_width(2)))?
            .label(format!("size {size}, cap {cap}"))
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
        chart.draw_series(own().map(|(run, on_front)| {
            let fill = if *on_front { color } else { WHITE };
            // The filling comes first: below its outline it hides the line through the circle.
            EmptyElement::at(point(run))
                + Circle::new((0, 0), 5, fill.filled())
                + Circle::new((0, 0), 5, color.stroke_width(2))
        }))?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .label_font(LABEL)
        .background_style(WHITE.mix(0.8))
        .draw()?;
    area.present()?;
    Ok(())
}
