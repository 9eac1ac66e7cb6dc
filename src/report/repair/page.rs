//! The section "Repair: error against run time" of the HTML page.

use maud::{Markup, html};

use super::RepairReport;
use super::below::{Below, RecommendedBelow};
use super::row::{ImageKind, RepairRow};
use wildcity_session::limits::FRAME_M;

/// The section of the page about the repair.
pub fn section(report: &RepairReport) -> Markup {
    html! {
        h2 { "Repair: error against run time" }
        (introduction(report))
        (table(report))
        (recommendations(report))
    }
}

fn introduction(report: &RepairReport) -> Markup {
    let subject = &report.subject;
    let [width, height] = subject.size_px;
    // The word of `RepairSubject::references`.
    let images = match subject.references {
        "recorded" => "The twin's recorded images",
        _ => "The twin has no recorded images. Images of the twin itself, drawn on its drive,",
    };
    html! {
        p {
            "Images of " (subject.cameras) " cameras, the first of " (width) " x " (height) " px, at "
            (subject.sampling.stations) " stations. " (images) " are brought into each view by its depth; "
            b { "warped" } " shows them where they cover the view, and the rendered image elsewhere, without a model. "
            "A model has to be better than that. " (subject.read) " of these images were read, each in "
            (format!("{:.1}", subject.read_ms)) " ms; they stay in memory for the next steps."
        }
        @if let Some(truth) = &subject.truth {
            p {
                "PSNR and FLIP compare with the twin " (truth.twin) " version " (truth.version)
                ". They are means over the images; a gain below 0 is a loss."
            }
        } @else {
            p.miss {
                "There is no PSNR, FLIP or gain: how these views truly look is unknown. For a twin that was spoiled, "
                "--truth names the twin that it was made from."
            }
        }
        p {
            "Flicker is the mean absolute difference between an image and the one " (FRAME_M)
            " m before it, brought into its view by the rendered depth, where the depths agree. An image that is "
            "repaired is stable if its flicker is below 1.1 times that of the rendered one. Times are medians of one "
            "image in milliseconds, one after the other: rendering is that of all cameras, divided by their number."
        }
        @for model in &subject.models {
            p {
                "Model " (model.name) " " (model.version) " (" (model.licence) ") on " (model.provider) ", "
                (if model.deterministic { "repeats its bytes" } else { "does not repeat its bytes" })
                ", repair hash " code { (model.repair_hash) } "."
            }
        }
    }
}

fn table(report: &RepairReport) -> Markup {
    html! {
        div.wide {
            table {
                tr {
                    th { "beside the drive" } th { "image" } th { "trust" } th { "covered" }
                    th { "render ms" } th { "repair ms" } th { "warp" } th { "model" } th { "merge" }
                    @if report.subject.truth.is_some() {
                        th { "PSNR, dB" } th { "gain, dB" } th { "worse images" } th { "FLIP" }
                        th { "dB per 100 ms" }
                    }
                    th { "flicker" } th { "times rendered" }
                    @if report.subject.truth.is_some() { th { "true flicker" } }
                }
                @for row in &report.rows { (table_row(row, report.subject.truth.is_some())) }
            }
        }
    }
}

fn table_row(row: &RepairRow, has_truth: bool) -> Markup {
    let is_rendered = row.kind == ImageKind::Rendered;
    // The rendered image has no repair: empty cells, no zeros.
    let ms = |value: f64| if is_rendered { String::new() } else { format!("{value:.1}") };
    let parts = &row.repair_parts_ms;
    let gain_db = row.gain_db.filter(|_| !is_rendered);
    let is_loss = gain_db.is_some_and(|gain_db| gain_db < 0.0);
    // The bound of 1.1 is the one in the text above the table.
    let is_unstable = !is_rendered && row.flicker_ratio >= 1.1;
    let worse = row.worse.filter(|_| !is_rendered);
    html! {
        tr {
            td { (row.offset_m) " m" }
            td.text { (row.name) }
            td { (format!("{:.2}", row.trust)) }
            td { (format!("{:.0} %", 100.0 * row.covered)) }
            td { (format!("{:.1}", row.render_ms)) }
            td { (ms(row.repair_ms)) } td { (ms(parts.warp)) } td { (ms(parts.model)) } td { (ms(parts.merge)) }
            @if has_truth {
                td { (number(row.psnr_db, 2)) }
                td.miss[is_loss] { (signed(gain_db)) }
                td { @if let Some(worse) = worse { (worse) " of " (row.images) } }
                td { (number(row.flip, 4)) }
                td.miss[is_loss] { (signed(row.db_per_100_ms)) }
            }
            td { (format!("{:.4}", row.flicker)) }
            td.miss[is_unstable] { @if !is_rendered { (format!("{:.2}", row.flicker_ratio)) } }
            @if has_truth { td { (number(row.true_flicker, 4)) } }
        }
    }
}

fn recommendations(report: &RepairReport) -> Markup {
    html! {
        @for recommended in &report.below {
            @let text = recommended.text();
            @if recommended.below.is_some() { p { (text) } } @else { p.miss { (text) } }
        }
    }
}

impl RecommendedBelow {
    /// The recommendation in words, with the images that it was selected by and those that verify
    /// it.
    pub fn text(&self) -> String {
        let of = |at: &Option<Below>| at.as_ref().map_or("nothing".to_owned(), Below::text);
        let default = self.default.text();
        match (self.below, self.above, &self.unmet_reason) {
            // Both are there if one is recommended, and neither otherwise.
            (Some(below), Some(above), _) => format!(
                "{}: repair below a trust of {below:.2}, and until it is above {above:.2}. At the stations that \
                 this was selected by: {}. At the others, which verify it: {}. There, the default of {:.2} has: {default}.",
                self.model,
                of(&self.selection),
                of(&self.verification),
                self.default.below
            ),
            (_, _, reason) => format!(
                "{}: no trust is recommended: {}. The default of {:.2} has: {default}.",
                self.model,
                reason.as_deref().unwrap_or("it was not measured"),
                self.default.below
            ),
        }
    }
}

impl Below {
    /// The images that it repairs, in words.
    fn text(&self) -> String {
        let Self { images, repaired, worse, .. } = self;
        match self.gain_db {
            None => format!("none of {images} images is repaired"),
            Some(gain_db) => format!(
                "{repaired} of {images} images are repaired, {gain_db:+.2} dB on average; worse than rendered: {worse}"
            ),
        }
    }
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or(String::new(), |value| format!("{value:.decimals$}"))
}

fn signed(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| format!("{value:+.2}"))
}
