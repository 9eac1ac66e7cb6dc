//! A run, or several, as one HTML page that loads nothing else: pictures are data URLs.

mod comparison;
mod curves;
mod error;
mod pictures;

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::held_out::HeldOut;
use crate::history::Evaluation;
use crate::poses::PoseMoves;
use crate::settings::PoseMode;
use crate::trainer::Trainer;
pub use comparison::{Comparison, comparison_page, verdict as compared};
pub use error::PageError;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}.verdict{font-size:1.2em}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}
.pictures{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:6px;margin-bottom:1.5em}
figure{margin:0}figure img{width:100%;height:auto}figcaption{font-size:13px}
svg{max-width:100%;height:auto}.wide{overflow-x:auto}@media(max-width:760px){.wide svg{max-width:none;width:880px}}
pre{font-size:12px;overflow-x:auto}.command{font-size:14px;white-space:pre-wrap;overflow-wrap:anywhere;padding:.6em .8em;background:#f6f6f6}";

/// What a page shows.
#[derive(Clone, Copy, Debug)]
pub struct Contents<'a> {
    /// What the run has learned from, for a person.
    pub source: &'a str,
    pub trainer: &'a Trainer,
    /// Images that the run has learned from, and those that were held out.
    pub images: [usize; 2],
    pub held_out: &'a [HeldOut],
    /// Names of the rig's cameras.
    pub cameras: &'a [String],
}

/// The page of a run, without any other file.
///
/// # Errors
/// A plot or a picture cannot be made.
pub fn page(contents: &Contents<'_>) -> Result<String, PageError> {
    let Contents { source, trainer, held_out, cameras, .. } = *contents;
    let title = format!("Training on {source}");
    let history = trainer.history();
    let pictures = held_out.iter().map(beside).collect::<Result<Vec<_>, PageError>>()?;
    let settings = toml::to_string_pretty(trainer.settings())?;
    let first_whole = trainer.settings().first_whole_step();
    let body = html! {
        p.verdict { (verdict(contents)) }
        @if !pictures.is_empty() {
            h2 { "Images that were held out" }
            p {
                "From the one with the lowest PSNR to the one with the highest: as recorded, as the scene shows it, the depth of \
                 the scene (red is near, blue is " (pictures::FAR_M) " m away), and the normals of this depth."
            }
            @for picture in &pictures { (picture) }
        }
        h2 { "Curves" }
        @if !history.evaluations.is_empty() { (plot(curves::psnr(history)?)) }
        (plot(curves::losses(history)?))
        @if first_whole > 1 {
            p { "Losses before step " (first_whole) " are of images that were made smaller, if they were large enough." }
        }
        (plot(curves::gaussians(history)?))
        @if let Some(moves) = trainer.moves() { (poses(&moves, cameras, trainer.settings().poses.mode != PoseMode::Image)) }
        h2 { "Settings" }
        p { "As a file for " code { "--settings" } ":" }
        pre { (settings) }
    };
    Ok(document(&title, &body))
}

/// The frame that a run and a comparison share: title, style, and a body.
fn document(title: &str, body: &Markup) -> String {
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
                (body)
            }
        }
    };
    markup.into_string() + "\n"
}

/// A plot, which a phone shows at a size that one can read, and scrolls.
fn plot(svg: String) -> Markup {
    html! { div.wide { (PreEscaped(svg)) } }
}

fn verdict(contents: &Contents<'_>) -> String {
    let Contents { trainer, images: [learned, held_out], .. } = contents;
    let seconds = trainer.history().seconds();
    let made = format!(
        "{} Gaussians from {learned} images in {} steps and {seconds:.0} s",
        trainer.model().len(),
        trainer.steps_done(),
    );
    match trainer.history().evaluations.last() {
        Some(Evaluation { held_out_db, .. }) => {
            format!("{held_out_db:.2} dB on {held_out} images that were held out: {made}.")
        }
        None => format!("{made}. No image was held out, so that nothing judges them."),
    }
}

fn beside(image: &HeldOut) -> Result<Markup, PageError> {
    let HeldOut { name, recorded, drawn, psnr_db, .. } = image;
    let of_depth = pictures::depth(&image.depth_m);
    let of_normals = pictures::normals(&image.normals);
    let all =
        [("recorded", recorded), ("drawn", drawn), ("depth", &of_depth), ("normals", &of_normals)];
    let figures = all
        .into_iter()
        .map(|(what, rgb8)| figure(what, image.size_px, rgb8))
        .collect::<Result<Vec<Markup>, PageError>>()?;
    Ok(html! {
        p { b { (format!("{psnr_db:.2} dB")) } ", " (name) }
        div.pictures { @for figure in &figures { (figure) } }
    })
}

/// A picture with its caption.
fn figure(caption: &str, size_px: [u32; 2], rgb8: &[u8]) -> Result<Markup, PageError> {
    let address =
        format!("data:image/jpeg;base64,{}", BASE64.encode(&pictures::jpeg(size_px, rgb8)?));
    let [width, height] = size_px;
    Ok(html! {
        figure {
            img src=(address) width=(width) height=(height) alt=(caption);
            figcaption { (caption) }
        }
    })
}

fn poses(moves: &PoseMoves, cameras: &[String], of_rig: bool) -> Markup {
    let row = |name: &str, moved: &[[f64; 2]]| {
        let part = |axis: usize| -> [f64; 2] {
            let mut all: Vec<f64> = moved.iter().map(|moved| moved[axis]).collect();
            all.sort_by(f64::total_cmp);
            // Both are 0 if there is no pose of the kind.
            [all.len() / 2, all.len().saturating_sub(1)].map(|k| all.get(k).copied().unwrap_or(0.0))
        };
        let [middle_m, most_m] = part(0);
        let [middle, most] = part(1);
        html! {
            tr {
                td { (name) }
                td { (format!("{:.1}", 1e3 * middle_m)) } td { (format!("{:.1}", 1e3 * most_m)) }
                td { (format!("{:.3}", middle.to_degrees())) } td { (format!("{:.3}", most.to_degrees())) }
            }
        }
    };
    html! {
        h2 { "Poses: how far they have moved from the recorded ones" }
        table {
            tr { th { "pose" } th { "median, mm" } th { "most, mm" } th { "median, °" } th { "most, °" } }
            (row(if of_rig { "rig, at all times" } else { "images" }, &moves.egos))
            @if of_rig {
                @for (name, moved) in cameras.iter().zip(&moves.cameras) { (row(name, &[*moved])) }
            }
        }
    }
}
