//! The report as one HTML page that needs nothing else.

use std::fmt::Write as _;

use data_encoding::BASE64;

use super::error_images::{ErrorImages, HEAT_RGB, HEAT_STEPS};
use super::measure::Measurement;
use super::recommend::{Goal, pareto_front};
use super::sample_points::OFFSETS_M;
use super::settings::{Family, Skipped};
use super::{Report, ReportError, feature_costs, plots};
use wildcity_stress::Verdict;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child,td.text{text-align:left;vertical-align:top}.cases th{text-align:left}tr.beaten td{color:#999}
tr.front td:first-child{font-weight:600}.miss{color:#b00020;font-weight:600}.off{color:#999}
figure{display:inline-block;margin:0 12px 14px 0}figcaption{font-size:12px}
img{image-rendering:pixelated;margin-right:3px}.believed{width:272px}.believed img{image-rendering:auto;width:272px}svg{max-width:100%;height:auto}.wide{overflow-x:auto}
.key span{display:inline-block;padding:1px 8px;font-size:12px}";

/// The whole page.
///
/// # Errors
/// A plot cannot be drawn.
pub fn html(report: &Report) -> Result<String, ReportError> {
    let mut page = String::new();
    let subject = &report.subject;
    let _ = write!(
        page,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><title>{0}: error against run \
         time</title><style>{STYLE}</style></head><body><h1>{0}: error against run time</h1><p>Twin \
         {0} version {1}, {2} Gaussians of SH degree {3}, record {4}. Every setting is compared with the \
         f64 reference at full detail and however far, at {5} places and {6} px of each camera, at full \
         focal length. Times are of whole steps of {7} cameras as they are rendered; only rows of what is \
         as sent have encoding in them. Each is the median of all steps at all places on the drive (around \
         a twin without one, at all places), {8} at each, in turn with steps of the twin as served on {9}, \
         and scaled to the speed at which those took their median time: times of another backend, too, are \
         scaled by those on {9}.</p>",
        text(&subject.twin),
        subject.version,
        subject.gaussians,
        subject.sh_degree,
        subject.record,
        report.sample_points.len(),
        report.sampling.window_px.map(|px| px.to_string()).join(" x "),
        subject.cameras,
        subject.repeat,
        text(report.backends.first().map_or("the first backend", |column| column.backend)),
    );
    for column in &report.backends {
        let _ = write!(page, "<p>{}: {}</p>", text(column.backend), text(&column.detail));
    }
    let _ = write!(
        page,
        "<p>A whole step of the reference would take {:.0} s: of what was drawn, scaled to all pixels.</p>",
        1e-3 * report.reference_ms
    );
    recommendation(&mut page, report);
    page.push_str("<h2>Error against time</h2><p>On the line is what nothing else beats in both; what is \
                   beaten is grey. Values are compared before they are rounded to 8 bits, which alone \
                   leaves 59 dB, but for what is as sent. Least is the \
                   PSNR of one camera's window at one place, where it is least.</p>");
    page.push_str(&plots::error_against_time(&report.settings)?);
    table(&mut page, &report.settings);
    left_out(&mut page, report);
    beside_the_drive(&mut page, &report.settings)?;
    believed(&mut page, report)?;
    worst(&mut page, &report.settings);
    if !report.stress.rows.is_empty() {
        stress(&mut page, report);
    }
    only_what_is_needed(&mut page, report);
    page.push_str("</body></html>\n");
    Ok(page)
}

fn recommendation(page: &mut String, report: &Report) {
    if let Some(r) = &report.recommendation {
        let unit = match r.wanted {
            Goal::AtLeastDb(_) => "dB",
            Goal::AtMostMs(_) => "ms",
        };
        let _ = write!(
            page,
            "<p><b>{}</b>: {} on {}: {:.1} {unit} at the worst place where it was chosen, with a margin of \
             {:.1} {unit} for what places differ by, and {:.1} {unit} at the worst of those that were not \
             used to choose it, {}. To draw so: <code>{}</code></p>",
            text(&r.wanted.to_string()),
            text(&r.setting),
            text(&r.backend),
            r.chosen_by,
            r.margin,
            r.verified,
            text(&r.of_what()),
            text(&r.serve("profile.json"))
        );
    }
    if let (Some(wanted), Some(why)) = (report.goal, &report.unmet_reason) {
        let (wanted, why) = (text(&wanted.to_string()), text(why));
        let _ =
            write!(page, "<p class=\"miss\"><b>{wanted}</b>: nothing is recommended: {why}.</p>");
    }
}

fn table(page: &mut String, all: &[Measurement]) {
    page.push_str(
        "<div class=\"wide\"><table><tr><th>setting</th><th>of</th><th>ms a step</th><th>95 %, ms</th><th>PSNR, dB</th>\
         <th>least, dB</th><th>SSIM</th><th>largest</th><th>99.9 %</th><th>depth, m</th>\
         <th>Gaussians</th><th>MB, host</th><th>MB, device</th><th>B each, stored</th><th>kB sent</th></tr>",
    );
    for (m, is_on) in all.iter().zip(pareto_front(all)) {
        let (e, cost) = (&m.errors, &m.cost);
        let _ = write!(
            page,
            "<tr class=\"{}\"><td>{}</td><td class=\"text\">{}</td><td>{:.1}</td><td>{:.1}</td><td>{}</td>\
             <td>{}</td><td>{:.5}</td><td>{:.5}</td><td>{:.5}</td><td>{:.4}</td><td>{}</td><td>{:.1}</td>\
             <td>{}</td><td>{:.1}</td><td>{}</td></tr>",
            if is_on { "front" } else { "beaten" },
            text(&m.setting.name),
            m.setting.family.name(),
            cost.step_ms,
            m.p95_ms(),
            decibels(e.psnr_db),
            decibels(m.least_db()),
            e.ssim,
            e.max,
            e.p99_9,
            e.depth_l1_m,
            cost.gaussians,
            cost.scene_bytes as f64 / 1e6,
            cost.device_bytes
                .map_or("none".to_owned(), |bytes| format!("{:.1}", bytes as f64 / 1e6)),
            cost.stored_bytes_each,
            cost.sent_bytes / 1000,
        );
    }
    page.push_str("</table></div>");
}

fn left_out(page: &mut String, report: &Report) {
    if let Some(exact_ms) = report.exact_rays_ms {
        let _ = write!(
            page,
            "<p>Splats of bent cameras are compared with every pixel's own ray in a row of their own, and \
             all else with splats. A whole step of such rays would take the reference {:.0} s.</p>",
            1e-3 * exact_ms
        );
    }
    page.push_str("<p>Not compared:</p><ul>");
    for Skipped { what, why } in &report.skipped {
        let _ = write!(page, "<li>{}: {}</li>", text(what), text(why));
    }
    page.push_str("</ul>");
}

fn beside_the_drive(page: &mut String, all: &[Measurement]) -> Result<(), ReportError> {
    let shown = [Family::AsServed, Family::Detail, Family::Record, Family::Combined];
    let lines: Vec<&Measurement> = all
        .iter()
        .filter(|m| {
            shown.contains(&m.setting.family) && m.psnr_db_by_offset.len() == OFFSETS_M.len()
        })
        .collect();
    if !lines.is_empty() {
        page.push_str("<h2>Beside the recorded drive</h2>");
        page.push_str(&plots::error_beside_the_drive(&lines)?);
    }
    Ok(())
}

fn believed(page: &mut String, report: &Report) -> Result<(), ReportError> {
    if report.confidence.is_empty() {
        return Ok(());
    }
    page.push_str(
        "<h2>How far images may be believed</h2><p>Trust as observations carry it: 1 where and as it was \
         recorded, less with the distance from there, with holes, and with ground that was never \
         trained.</p>",
    );
    page.push_str(&plots::trust_beside_the_drive(&report.confidence)?);
    for b in &report.confidence {
        let _ = write!(
            page,
            "<figure class=\"believed\"><img alt=\"\" src=\"data:image/jpeg;base64,{}\"><figcaption>{}: \
             trust {:.2} ({:.2} to {:.2}), {:.2} m and {:.3} rad from a keyframe, holes {:.3}, untrained \
             {:.3}</figcaption></figure>",
            BASE64.encode(&b.picture.file),
            text(&b.picture.place),
            b.mean,
            b.least,
            b.most,
            b.distance_m,
            b.angle_rad,
            b.low_coverage,
            b.outside
        );
    }
    Ok(())
}

fn worst(page: &mut String, all: &[Measurement]) {
    page.push_str(
        "<h2>Where each setting is worst</h2><p>Drawn, by definition, and the largest error of \
                   a pixel's three values:</p><p class=\"key\">",
    );
    for (step, [r, g, b]) in HEAT_STEPS.iter().zip(HEAT_RGB) {
        let ink = if u32::from(r) + u32::from(g) > 250 { "#000" } else { "#fff" };
        let _ =
            write!(page, "<span style=\"background:rgb({r},{g},{b});color:{ink}\">{step}</span>");
    }
    page.push_str("</p>");
    for m in all {
        let ErrorImages { place, size_px: [width, height], files } = &m.worst;
        page.push_str("<figure>");
        for file in files.iter().filter(|file| !file.is_empty()) {
            let _ = write!(
                page,
                "<img width=\"{width}\" height=\"{height}\" alt=\"\" src=\"data:image/png;base64,{}\">",
                BASE64.encode(file)
            );
        }
        let name = text(&m.setting.name);
        let _ = write!(page, "<figcaption>{name}, at {}</figcaption></figure>", text(place));
    }
}

fn stress(page: &mut String, report: &Report) {
    page.push_str(
        "<h2>At the extremes</h2><p>Each case with what must hold; for each backend how it went, and what \
         came closest to its bound.</p><div class=\"wide\"><table class=\"cases\"><tr><th>case</th><th>what \
         is drawn</th><th>what must hold</th>",
    );
    for column in &report.stress.backends {
        let _ = write!(page, "<th>{}</th>", text(column.backend));
    }
    page.push_str("</tr>");
    for row in &report.stress.rows {
        let _ = write!(
            page,
            "<tr><td>{}</td><td class=\"text\">{}</td><td class=\"text\">{}</td>",
            row.case,
            text(row.what),
            text(row.bound)
        );
        for outcome in &row.outcomes {
            let class = match outcome.verdict {
                Verdict::Held => "text",
                Verdict::Missed => "text miss",
                Verdict::Refused | Verdict::NotRun => "text off",
            };
            let (word, told) = (outcome.word(), text(&outcome.detail));
            let _ = write!(page, "<td class=\"{class}\"><b>{word}</b><br>{told}</td>");
        }
        page.push_str("</tr>");
    }
    page.push_str("</table></div>");
}

fn only_what_is_needed(page: &mut String, report: &Report) {
    page.push_str("<h2>Only what is needed</h2><p>One step of one small street, with and without each \
                   feature. Counts, so that they are the same on every machine.</p><div class=\"wide\"><table><tr><th>street</th>");
    for column in feature_costs::COLUMNS {
        let _ = write!(page, "<th>{}</th>", text(column));
    }
    page.push_str("</tr>");
    for row in &report.feature_costs {
        let _ = write!(page, "<tr><td>{}</td>", text(row.with));
        for count in row.counts.texts() {
            let _ = write!(page, "<td>{}</td>", text(&count));
        }
        page.push_str("</tr>");
    }
    let _ = write!(page, "</table></div><p>{}</p>", feature_costs::ABSENT);
}

fn decibels(db: f64) -> String {
    if db == f64::INFINITY { "exact".to_owned() } else { format!("{db:.1}") }
}

/// Text as HTML has it.
fn text(plain: &str) -> String {
    plain.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
