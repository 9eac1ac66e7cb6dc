//! A check as one HTML page that loads nothing else: pictures are data URLs.

mod picture;
mod plots;

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::check::{Finding, Level, Report, SampledImage, Stream};
use crate::error::LogError;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}
.pictures{display:grid;grid-template-columns:repeat(auto-fit,minmax(340px,1fr));gap:8px}
figure{margin:0}figure img{width:100%;height:auto}figcaption{font-size:13px}
.error{color:#b00020;font-weight:600}.warning{color:#8a5300}svg{max-width:100%;height:auto}";

/// The page of a report, without any other file.
///
/// # Errors
/// A plot or a picture cannot be made.
pub fn page(report: &Report) -> Result<String, LogError> {
    let title = format!("Log {}", report.name);
    let pictures = report.samples.iter().map(figure).collect::<Result<Vec<_>, LogError>>()?;
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
                (introduction(report))
                (findings(&report.findings))
                h2 { "Path" }
                @if report.lanes.is_some() { p { "Lanes of the map are grey; the drive begins at the green dot." } }
                (PreEscaped(plots::path(report)?))
                h2 { "Rows in time" }
                (PreEscaped(plots::timing(report)?))
                (streams(&report.streams))
                (coverage(report))
                @if !pictures.is_empty() {
                    h2 { "LiDAR in the images" }
                    p { "Of each camera the image with the most points: red is near, blue is 80 m away." }
                    div.pictures { @for picture in &pictures { (picture) } }
                    (alignment(report)?)
                }
            }
        }
    };
    Ok(markup.into_string() + "\n")
}

fn introduction(report: &Report) -> Markup {
    let path = &report.path;
    let [from_us, to_us] = path.span_us;
    let seconds = to_us.abs_diff(from_us) as f64 / 1e6;
    html! {
        p {
            (format!("{:.0} m in {seconds:.1} s, at most {:.1} m/s, standing for {:.1} s",
                path.length_m, path.top_speed_m_per_s, path.standing_s))
            @if let Some(tracks) = report.tracks { ", " (tracks) " tracks" }
            @if let Some(lanes) = report.lanes { ", " (lanes) " lanes" }
            "."
        }
        @if let Some(gps) = &report.gps {
            p {
                (format!("{} satellite fixes: {:.2} m from the poses on average, offset {:.2} m east and {:.2} m north, \
                    drift {:.2} m.", gps.fixes, gps.mean_m, gps.offset_m[0], gps.offset_m[1], gps.drift_m))
            }
        }
    }
}

fn findings(findings: &[Finding]) -> Markup {
    html! {
        h2 { "Findings" }
        @if findings.is_empty() { p { "Nothing is missing, and nothing looks wrong." } }
        ul {
            @for Finding { level, text } in findings {
                @let (class, word) = match level {
                    Level::Error => ("error", "error: "),
                    Level::Warning => ("warning", "warning: "),
                    Level::Note => ("note", ""),
                };
                li class=(class) { (word) (text) }
            }
        }
    }
}

fn streams(streams: &[Stream]) -> Markup {
    html! {
        table {
            tr { th { "sensor" } th { "rows" } th { "first, s" } th { "last, s" } th { "period, ms" } th { "gaps" } th { "missing" } th { "longest gap, s" } }
            @for Stream { sensor, rows, span_us, period_us, gaps, missing, longest, .. } in streams {
                tr {
                    td { (sensor) } td { (rows) }
                    @for time_us in span_us.unwrap_or_default() { td { (format!("{:.3}", time_us as f64 / 1e6)) } }
                    td { @if let Some(us) = period_us { (format!("{:.1}", us / 1e3)) } }
                    td { (gaps) } td { (missing) }
                    td { @if let Some(gap) = longest.first() { (format!("{:.3}", gap.length_us as f64 / 1e6)) } }
                }
            }
        }
    }
}

fn coverage(report: &Report) -> Markup {
    html! {
        h2 { "Images along the drive" }
        table {
            tr { th { "camera" } th { "images" } th { "without a pose" } th { "spacing, m" } th { "longest without, m" } th { "masks" } th { "ground" } th { "sky" } }
            @for one in &report.coverage {
                tr {
                    td { (one.camera) } td { (one.images) } td { (one.unplaced) }
                    td { (format!("{:.2}", one.spacing_m)) } td { (format!("{:.2}", one.longest_m)) }
                    td { (one.masks) } td { (one.ground_masks) } td { (one.sky_masks) }
                }
            }
        }
    }
}

fn figure(sample: &SampledImage) -> Result<Markup, LogError> {
    let jpeg = picture::jpeg(sample)?;
    let address = format!("data:image/jpeg;base64,{}", BASE64.encode(&jpeg));
    let [width, height] = sample.size_px;
    let image = &sample.image;
    Ok(html! {
        figure {
            figcaption { (image.camera) ", " (format!("{:.3} s", image.time_us as f64 / 1e6)) ", " (sample.points.len()) " points" }
            img src=(address) width=(width) height=(height) alt=(format!("LiDAR in {}", image.camera));
        }
    })
}

fn alignment(report: &Report) -> Result<Markup, LogError> {
    let curves = plots::curves(report)?;
    Ok(html! {
        p {
            "How many edges of the images are where the distance of the points leaps, if the LiDAR's clock were late by so much \
             (Levinson and Thrun 2013): the peak is the difference of the clocks. Without a clear peak, edges do not tell: the \
             vehicle stands, or there are too few."
        }
        (PreEscaped(curves))
        table {
            tr { th { "camera" } th { "images" } th { "points" } th { "shown, %" } th { "edges" } th { "LiDAR late, ms" } th { "moves to the right, px" } }
            @for one in &report.alignment {
                tr {
                    td { (one.camera) } td { (one.images) } td { (one.points) } td { (format!("{:.1}", 100.0 * one.shown)) } td { (one.edges) }
                    td { @if let Some(ms) = one.lidar_late_ms { (format!("{ms:.1}")) } @else { "not known" } }
                    td { @if let Some(px) = one.drift_px { (format!("{px:.0}")) } @else { "no" } }
                }
            }
        }
    })
}
