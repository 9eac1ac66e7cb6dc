//! The report as one HTML page that loads nothing else: plots are inline SVG, images are data URLs.

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::error::ReportError;
use super::error_images::{ErrorImages, HEAT_STEPS};
use super::measurement::Measurement;
use super::recommend::{Goal, Recommendation, pareto_front};
use super::report::Report;
use super::sample_points::OFFSETS_M;
use super::setting::Family;
use super::{feature_costs, plots};
use wildcity_render::compare::heat::HEAT_RGB;
use wildcity_stress::Verdict;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}td,th{padding:2px 5px;border-bottom:1px solid #ddd;text-align:right;vertical-align:top}th{vertical-align:bottom}
td:first-child,th:first-child{position:sticky;left:0;background:#fff}td:first-child,th:first-child,.text{text-align:left}.cases th{text-align:left}tr.dominated td{color:#6b6b6b}
tr.front td:first-child{font-weight:600}.miss{color:#b00020;font-weight:600}.off{color:#6b6b6b}
figure{display:inline-block;margin:0 12px 14px 0}figcaption{font-size:12px}
img{image-rendering:pixelated;margin-right:3px}figure:not(.view) img{width:104px;height:auto}.view{width:272px}.view img{image-rendering:auto;width:272px}svg{max-width:100%;height:auto}.wide{overflow-x:auto}@media(max-width:760px){.wide svg{max-width:none;width:760px}}
.key span{display:inline-block;padding:1px 8px;font-size:12px}
.verdict{font-size:1.25em;padding:.6em .8em;border-left:6px solid;background:#f6f6f6;overflow-wrap:anywhere}";

/// A number of steps.
fn counted(steps: u32) -> String {
    format!("{steps} {}", if steps == 1 { "step" } else { "steps" })
}

/// The whole page.
///
/// # Errors
/// A plot cannot be drawn.
pub fn render(report: &Report) -> Result<String, ReportError> {
    let title = format!("{}: error against run time", report.subject.twin);
    // What can fail comes first: markup cannot return an error.
    let plot = plots::error_against_time(&report.settings)?;
    let by_offset = by_offset(&report.settings)?;
    let confidence = confidence(report)?;
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                p.verdict { b { "Which setting should I use? " } (capitalized(&report.answer())) "." }
                @if let Some(found) = &report.recommendation { (recommended(found)) }
                (introduction(report))
                h2 { "Error against time" }
                (error_against_time_caption())
                div.wide { (PreEscaped(plot)) }
                (settings_table(&report.settings))
                (not_compared(report))
                (by_offset)
                (confidence)
                @if let Some(repair) = &report.repair { (super::repair::section(repair)) }
                (worst_windows(&report.settings))
                @if !report.stress.rows.is_empty() { (stress(report)) }
                (feature_table(report))
            }
        }
    };
    // A text file ends with a line feed.
    Ok(markup.into_string() + "\n")
}

/// The subject of the report, and how it was measured.
fn introduction(report: &Report) -> Markup {
    let subject = &report.subject;
    let [window_width, window_height] = report.sampling.window_px;
    let points = report.sample_points.len();
    let baseline = report.backends.first().map_or("the first backend", |column| column.backend);
    html! {
        p {
            "Twin " (subject.twin) " version " (subject.version) ": " (subject.gaussians)
            " Gaussians of SH degree " (subject.sh_degree) ", stored in record format "
            (subject.record) "."
        }
        p {
            b { "Errors. " }
            "Each setting is compared with the f64 reference, which renders full detail at any \
             distance. The comparison uses " (points) " sample points, with a window of "
            (window_width) " x " (window_height) " px of each camera at full focal length."
        }
        p {
            b { "Times. " }
            "A time is the median over whole steps (cameras: " (subject.cameras) "), with "
            (counted(subject.repeat)) " at each sample point on the drive (at all sample points, for a \
             twin without a drive). It covers rendering; only settings that change the encoding \
             include encoding. Each step was timed in turn with a step of the twin as it is served \
             on " (baseline) ", and all times are scaled to the machine speed at which those steps \
             took their median time. This also holds for settings of another backend."
        }
        @for column in &report.backends {
            p { "Backend " (column.backend) ": " (column.detail) }
        }
        p {
            "A whole step of the reference would take " (seconds(report.reference_ms))
            ", scaled from the time of the windows to all pixels."
        }
    }
}

/// A sentence with its first letter in upper case.
fn capitalized(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

fn recommended(recommendation: &Recommendation) -> Markup {
    let unit = match recommendation.goal {
        Goal::AtLeastDb(_) => "dB",
        Goal::AtMostMs(_) => "ms",
    };
    let value = |value: f64| format!("{value:.1} {unit}");
    html! {
        p {
            b { (recommendation.goal) } ": " (recommendation.setting) " on "
            (recommendation.backend) ". It has " (value(recommendation.selection_worst))
            " at the worst sample point that it was selected by, with a margin of "
            (value(recommendation.margin)) " for the spread between sample points, and "
            (value(recommendation.verification_worst))
            " at the worst of the other points, which verify the selection. These values are "
            (recommendation.explanation()) ". To render so: "
            code { (recommendation.serve_command("profile.json")) }
        }
    }
}

fn error_against_time_caption() -> Markup {
    html! {
        p {
            "Each point is one setting. The line joins the Pareto front: the settings that no other \
             setting beats in both error and time. Settings that another one beats are grey. Values \
             are compared before they are rounded to 8 bits, which alone leaves 59 dB; settings that \
             change the encoding are compared after decoding. In the table, least PSNR is that of \
             one camera's window at one sample point, where it is least. SSIM is that of RGB, over \
             windows within the image (scikit-image with Gaussian weights)."
        }
    }
}

fn settings_table(all: &[Measurement]) -> Markup {
    html! {
        div.wide {
            table {
                tr {
                    th { "setting" } th.text { "what it changes" }
                    th { "step time, ms" } th { "95th percentile, ms" }
                    th { "PSNR, dB" } th { "least PSNR, dB" } th { "SSIM" }
                    th { "largest error (0 to 1)" } th { "99.9th percentile of the error" }
                    th { "depth error, m" } th { "Gaussians rendered" } th { "host memory, MB" }
                    th { "device memory, MB" } th { "stored, B per Gaussian" }
                    th { "images sent, kB per step" }
                }
                @for (measurement, is_on_front) in all.iter().zip(pareto_front(all)) {
                    (settings_row(measurement, is_on_front))
                }
            }
        }
    }
}

fn settings_row(measurement: &Measurement, is_on_front: bool) -> Markup {
    let errors = &measurement.errors;
    let cost = &measurement.cost;
    let device_mb = cost.device_bytes.map_or("none".to_owned(), megabytes);
    html! {
        tr class=(if is_on_front { "front" } else { "dominated" }) {
            td { (measurement.setting.name) }
            td.text { (measurement.setting.family.label()) }
            td { (format!("{:.1}", cost.step_ms)) }
            td { (format!("{:.1}", measurement.p95_ms())) }
            td { (decibels(errors.psnr_db)) }
            td { (decibels(measurement.min_db())) }
            td { (format!("{:.5}", errors.ssim)) }
            td { (format!("{:.5}", errors.max)) }
            td { (format!("{:.5}", errors.p99_9)) }
            td { (format!("{:.4}", errors.depth_l1_m)) }
            td { (cost.gaussians) }
            td { (megabytes(cost.scene_bytes)) }
            td { (device_mb) }
            td { (format!("{:.1}", cost.stored_bytes_per_gaussian)) }
            td { (cost.sent_bytes / 1000) }
        }
    }
}

fn not_compared(report: &Report) -> Markup {
    html! {
        @if let Some(exact_ms) = report.exact_rays_ms {
            p {
                "This rig has cameras that are not pinholes at rest. One row compares their splats \
                 with a ray for every pixel; all other rows are compared with splats. A whole step \
                 with a ray for every pixel would take the reference " (seconds(exact_ms)) "."
            }
        }
        p { "Not compared:" }
        ul {
            @for skipped in &report.skipped { li { (skipped.what) ": " (skipped.reason) } }
        }
    }
}

fn by_offset(all: &[Measurement]) -> Result<Markup, ReportError> {
    let families = [Family::AsServed, Family::Detail, Family::Record, Family::Combined];
    // Only twins with a drive have a value for each distance.
    let is_shown = |m: &&Measurement| {
        families.contains(&m.setting.family) && m.psnr_db_by_offset.len() == OFFSETS_M.len()
    };
    let shown: Vec<&Measurement> = all.iter().filter(is_shown).collect();
    if shown.is_empty() {
        return Ok(html! {});
    }
    let plot = plots::error_by_offset(&shown)?;
    Ok(html! {
        h2 { "Error beside the recorded drive" }
        p {
            "Each line is one setting, compared with the f64 reference at the same poses. Levels of \
             detail, record formats, and combinations are shown."
        }
        div.wide { (PreEscaped(plot)) }
    })
}

fn confidence(report: &Report) -> Result<Markup, ReportError> {
    if report.confidence.is_empty() {
        return Ok(html! {});
    }
    let plot = plots::trust_by_offset(&report.confidence)?;
    Ok(html! {
        h2 { "How far images can be trusted" }
        p {
            "Trust is the value that observations carry. It is 1 at the poses that were recorded. It \
             falls with the distance from them, with the share of pixels without content (holes), \
             and with the share of rays to ground that was never trained. The line is the mean of all \
             images at one distance; the area reaches from the lowest to the highest. The images are \
             the rig's first camera at the middle station."
        }
        div.wide { (PreEscaped(plot)) }
        @for confidence in &report.confidence {
            figure.view {
                img alt="" src=(data_url("image/jpeg", &confidence.image.jpeg));
                figcaption {
                    (confidence.image.sample_point) ": trust "
                    (format!(
                        "{:.2} ({:.2} to {:.2}), {:.2} m and {:.3} rad from the nearest keyframe, \
                         holes {:.3}, untrained {:.3}",
                        confidence.mean,
                        confidence.min,
                        confidence.max,
                        confidence.distance_m,
                        confidence.angle_rad,
                        confidence.low_coverage,
                        confidence.outside
                    ))
                }
            }
        }
    })
}

fn worst_windows(all: &[Measurement]) -> Markup {
    html! {
        h2 { "The worst window of each setting" }
        p {
            "From left to right: the setting, the f64 reference, and the error of each pixel, which \
             is the largest of its three channels. Colours of the error (values from 0 to 1):"
        }
        p.key {
            @for (step, [r, g, b]) in HEAT_STEPS.iter().zip(HEAT_RGB) {
                // Black on light colours, white on dark ones; blue adds little to lightness.
                @let text = if u32::from(r) + u32::from(g) > 250 { "#000" } else { "#fff" };
                span style=(format!("background:rgb({r},{g},{b});color:{text}")) { (step) }
            }
        }
        @for measurement in all {
            @let ErrorImages { sample_point, size_px: [width, height], files } = &measurement.worst;
            figure {
                // A setting without any error has no images.
                @for file in files.iter().filter(|file| !file.is_empty()) {
                    img width=(width) height=(height) alt="" src=(data_url("image/png", file));
                }
                figcaption { (measurement.setting.name) ", at " (sample_point) }
            }
        }
    }
}

fn stress(report: &Report) -> Markup {
    html! {
        h2 { "Extreme scenes" }
        p {
            "Each case renders an extreme scene and compares it with a bound. For each backend the \
             table has the result, and the value that came closest to its bound."
        }
        div.wide {
            table.cases {
                tr {
                    th { "case" } th { "scene" } th { "bound" }
                    @for column in &report.stress.backends { th { (column.backend) } }
                }
                @for row in &report.stress.rows {
                    tr {
                        td { (row.case) }
                        td.text { (row.what) }
                        td.text { (row.bound) }
                        @for outcome in &row.outcomes {
                            td class=(verdict_class(outcome.verdict)) {
                                b { (outcome.word()) } br; (outcome.detail)
                            }
                        }
                    }
                }
            }
        }
    }
}

fn verdict_class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Held => "text",
        Verdict::Missed => "text miss",
        Verdict::Refused | Verdict::NotRun => "text off",
    }
}

fn feature_table(report: &Report) -> Markup {
    html! {
        h2 { "What each feature costs" }
        p {
            "One step of one small street, with each feature and without. The numbers are counts, so \
             they are the same on every machine. A feature that a scene does not have should cost it \
             nothing: compare each row with the first."
        }
        div.wide {
            table {
                tr {
                    th { "street with" }
                    @for column in feature_costs::COLUMNS { th { (column) } }
                }
                @for row in &report.feature_costs {
                    tr {
                        td { (row.feature) }
                        @for cell in row.counts.cells() { td { (cell) } }
                    }
                }
            }
        }
        p { (feature_costs::WITHOUT_REPAIR) }
    }
}

fn decibels(db: f64) -> String {
    if db == f64::INFINITY { "exact".to_owned() } else { format!("{db:.1}") }
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1}", bytes as f64 / 1e6)
}

fn seconds(ms: f64) -> String {
    format!("{:.0} s", 1e-3 * ms)
}

fn data_url(media_type: &str, file: &[u8]) -> String {
    format!("data:{media_type};base64,{}", BASE64.encode(file))
}
