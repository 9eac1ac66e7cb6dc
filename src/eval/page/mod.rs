//! The evaluation as one HTML page that loads nothing else: pictures are data URLs.

mod beside;
mod means;
mod numbers;

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use self::numbers::{decibels, mean_with_unit, metres, percent, share, signed, with_unit};
use super::evaluated_image::EvaluatedImage;
use super::evaluation::Evaluation;
use super::means::ScoreMeans;
use super::scores::Scored;
use super::thumbnails::Thumbnails;
use wildcity_render::compare::heat::HEAT_RGB;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left;position:sticky;left:0;background:#fff}.wide{overflow-x:auto}
figure{margin:0 0 18px}figure div{display:grid;grid-template-columns:repeat(3,1fr);gap:4px;align-items:start}
@media(max-width:600px){figure div{grid-template-columns:repeat(2,1fr)}}
figure div.row{grid-template-columns:repeat(auto-fit,minmax(180px,1fr))}figure img{width:100%;min-width:0;height:auto}
.gain td{font-weight:600}
figcaption{font-size:13px;margin-bottom:3px}.key span{display:inline-block;padding:1px 8px;font-size:12px}
.miss{color:#b00020;font-weight:600}
.verdict{font-size:1.25em;padding:.6em .8em;border-left:6px solid;background:#f6f6f6;overflow-wrap:anywhere}";

/// Share of covered pixels below which the page warns that the camera may look past the scene.
const BARELY_COVERED: f64 = 0.05;

/// The whole page. Images with thumbnails are shown, the worst first.
pub fn render(evaluation: &Evaluation) -> String {
    let title = format!("{}: rendered against real images", evaluation.subject.scene);
    let worst_first = evaluation.worst_first();
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
                p.verdict { (verdict(evaluation, &worst_first)) }
                (introduction(evaluation))
                (means::table(evaluation))
                (pictures(&worst_first))
                (means::kid(evaluation))
                (meanings(evaluation))
                (means::lidar(evaluation))
                (beside::section(evaluation))
                (images_table(evaluation, &worst_first))
            }
        }
    };
    markup.into_string() + "\n"
}

/// The answer to the question that the page is opened for, in one sentence: how close the images
/// are, where they are worst, and what a repair gains.
fn verdict(evaluation: &Evaluation, worst_first: &[&EvaluatedImage]) -> String {
    let means = &evaluation.all;
    let Some(worst) = worst_first.first().filter(|_| means.images > 0) else {
        return "Nothing is compared: no pixel of the images counts.".to_owned();
    };
    let ScoreMeans { psnr_db, ssim, flip, .. } = means.rendered;
    let mut text = format!(
        "On average a rendered image has {} against the real one (more is closer), SSIM {}, FLIP {}; the worst is {} with {}",
        mean_with_unit(psnr_db),
        share(ssim),
        share(flip),
        worst.name,
        with_unit(worst.rendered.scores.psnr_db)
    );
    let by_camera = evaluation.cameras.iter().map(|one| (&one.camera, one.means.rendered.psnr_db));
    let weakest = by_camera.filter(|(_, db)| db.is_finite()).min_by(|a, b| a.1.total_cmp(&b.1));
    if let Some((camera, db)) = weakest.filter(|_| evaluation.cameras.len() > 1) {
        text += &format!(", and the worst camera {camera} with {}", with_unit(db));
    }
    if let Some(gain) = &means.gain {
        text += &format!("; the repair gains {} dB", signed(gain.psnr_db, 2));
    }
    text + "."
}

fn introduction(evaluation: &Evaluation) -> Markup {
    let subject = &evaluation.subject;
    let total = evaluation.images.len();
    // Images that are in no mean.
    let uncounted = total - evaluation.all.images;
    let past = evaluation.images.iter().filter(|image| image.covered < BARELY_COVERED).count();
    html! {
        p {
            (subject.scene)
            @if let Some(version) = subject.version { " version " (version) }
            ", rendered by the backend " (subject.backend) ", against " (total) " images of "
            code { (subject.images) } "."
            @if subject.every > 1 { " Every " (subject.every) "th image in the order of their names." }
        }
        @if let Some(repair) = &subject.repair {
            p {
                "Repaired by " code { (repair.model) } " " (repair.version) ", every image, whatever its trust."
                @match repair.references {
                    Some("recorded") => { " It compares with recorded images of the twin." }
                    Some(_) => { " The twin has no other recorded images, so it compares with the twin as drawn on its drive." }
                    None => {}
                }
                @if repair.left_out > 0 {
                    " " (repair.left_out) " recorded images are compared here, and were not shown to it."
                }
            }
        }
        @if uncounted > 0 {
            p.miss { "Of " (uncounted) " images no pixel counts: they are in no mean." }
        }
        @if past > 0 {
            p.miss {
                "The scene covers less than " (100.0 * BARELY_COVERED) " % of the pixels of " (past) " of the images. If \
                 it should be there, the poses have other axes or another unit than the scene: see --axes and --scale."
            }
        }
    }
}

fn meanings(evaluation: &Evaluation) -> Markup {
    html! {
        ul {
            li { "PSNR of 8-bit sRGB values. The mean is that of the images; pooled is that of all their pixels." }
            li {
                "SSIM of RGB with a Gaussian window of 11 px, over windows within the image (Wang et al. 2004; scikit-image \
                 with Gaussian weights). Mirrored: over all pixels, with mirrored edges (torchmetrics, gsplat)."
            }
            li { "FLIP (LDR, 67 pixels per degree): 0 if no difference is visible, 1 at most." }
            li { "Masked pixels and those outside of the lens' field do not count, except in mirrored SSIM." }
            @if let Some(network) = &evaluation.subject.lpips_network {
                li {
                    "LPIPS by the network " code { (network) } ": values of different networks cannot be compared. Pixels that do \
                     not count are the real image's."
                }
            }
            @if evaluation.subject.boxes.is_some() {
                li { "Pixels within boxes that move faster than 1 m/s, grown by 3 px, do not count." }
            }
            @if evaluation.all.rendered.aligned.is_some() {
                li {
                    "Aligned: after the gain and the offset of each channel that bring the rendered image closest to the \
                     real one. It takes away differences of exposure and white balance, and some errors of the scene."
                }
            }
        }
    }
}

fn pictures(worst_first: &[&EvaluatedImage]) -> Markup {
    let shown: Vec<_> =
        worst_first.iter().filter_map(|image| Some((image, image.thumbnails.as_ref()?))).collect();
    if shown.is_empty() {
        return html! {};
    }
    // The last colour stands for an error of 1.
    let last = HEAT_RGB.len() - 1;
    html! {
        h2 { "The worst images" }
        @if evaluated_repaired(&shown) {
            p {
                "In this order: real, rendered, repaired; then FLIP of each pixel of the rendered and of the repaired image, \
                 grey where pixels do not count. Colours of FLIP:"
            }
        } @else {
            p { "In this order: real, rendered, and FLIP of each pixel, grey where pixels do not count. Colours of FLIP:" }
        }
        p.key {
            @for (step, [r, g, b]) in HEAT_RGB.iter().enumerate() {
                // Black on bright colours, white on dark ones; blue hardly adds to brightness.
                @let text = if u32::from(*r) + u32::from(*g) > 250 { "#000" } else { "#fff" };
                span style=(format!("background:rgb({r},{g},{b});color:{text}")) {
                    (format!("{:.1}", step as f64 / last as f64))
                }
            }
        }
        @for (image, thumbnails) in shown {
            figure {
                figcaption { b { (image.name) } " " (caption(image)) }
                div {
                    @let [real, rendered, error] = &thumbnails.files;
                    (picture("real", real))
                    (picture("rendered", rendered))
                    @if let Some([repaired, error_after]) = &thumbnails.repaired {
                        (picture("repaired", repaired))
                        span {}
                        (picture("error", error))
                        (picture("error after the repair", error_after))
                    } @else {
                        (picture("error", error))
                    }
                }
            }
        }
    }
}

fn evaluated_repaired(shown: &[(&&EvaluatedImage, &Thumbnails)]) -> bool {
    shown.iter().any(|(_, thumbnails)| thumbnails.repaired.is_some())
}

fn picture(what: &str, file: &[u8]) -> Markup {
    html! { img alt=(what) src=(format!("data:image/jpeg;base64,{}", BASE64.encode(file))); }
}

fn caption(image: &EvaluatedImage) -> String {
    let scores = &image.rendered.scores;
    let mut text = format!(
        "{}, SSIM {}, FLIP {}",
        with_unit(scores.psnr_db),
        share(scores.ssim),
        share(scores.flip)
    );
    if let Some(aligned) = &scores.aligned {
        text += &format!("; aligned {}", with_unit(aligned.psnr_db));
    }
    if let Some(Scored { scores, .. }) = &image.repaired {
        text += &format!(
            "; repaired {}, SSIM {}, FLIP {}",
            with_unit(scores.psnr_db),
            share(scores.ssim),
            share(scores.flip)
        );
    }
    text
}

/// The columns of the table of images.
#[derive(Clone, Copy)]
struct Columns {
    lpips: bool,
    aligned: bool,
    repaired: bool,
    moving: bool,
    lidar: bool,
}

fn images_table(evaluation: &Evaluation, worst_first: &[&EvaluatedImage]) -> Markup {
    let columns = Columns {
        lpips: evaluation.all.rendered.lpips.is_some(),
        aligned: evaluation.all.rendered.aligned.is_some(),
        repaired: evaluation.all.repaired.is_some(),
        moving: evaluation.subject.boxes.is_some(),
        lidar: evaluation.all.lidar.is_some(),
    };
    let Columns { repaired, .. } = columns;
    html! {
        h2 { "All images" }
        @if repaired { p { "Each number as rendered, then repaired." } }
        div.wide {
            table {
                tr {
                    th { "image" } th { "size, px" } (header("PSNR, dB", repaired)) @if repaired { th { "gain" } }
                    (header("SSIM", repaired)) (header("SSIM, mirrored", repaired)) (header("FLIP", repaired))
                    @if columns.lpips { (header("LPIPS", repaired)) }
                    @if columns.aligned { (header("PSNR aligned, dB", repaired)) (header("SSIM aligned", repaired)) }
                    th { "counted, %" } th { "covered, %" }
                    @if columns.moving { th { "moving, %" } }
                    @if columns.lidar { th { "LiDAR points" } th { "mean, m" } th { "median, m" } }
                }
                @for image in worst_first { (image_row(image, columns)) }
            }
        }
    }
}

fn header(name: &str, repaired: bool) -> Markup {
    html! {
        th { (name) }
        @if repaired { th { "repaired" } }
    }
}

fn image_row(image: &EvaluatedImage, columns: Columns) -> Markup {
    let [width, height] = image.size_px;
    // Rendered, and repaired if requested.
    let both: Vec<&Scored> = std::iter::once(&image.rendered).chain(&image.repaired).collect();
    let aligned_db = |of: &Scored| of.scores.aligned.map_or(f64::NAN, |aligned| aligned.psnr_db);
    let aligned_ssim = |of: &Scored| of.scores.aligned.map_or(f64::NAN, |aligned| aligned.ssim);
    html! {
        tr {
            td { (image.name) } td { (width) " x " (height) }
            @for of in &both { td { (decibels(of.scores.psnr_db)) } }
            @if let [before, after] = both[..] {
                td { (signed(after.scores.psnr_db - before.scores.psnr_db, 2)) }
            }
            @for of in &both { td { (share(of.scores.ssim)) } }
            @for of in &both { td { (share(of.scores.ssim_mirrored)) } }
            @for of in &both { td { (share(of.scores.flip)) } }
            @if columns.lpips { @for of in &both { td { (share(of.scores.lpips.unwrap_or(f64::NAN))) } } }
            @if columns.aligned {
                @for of in &both { td { (decibels(aligned_db(of))) } }
                @for of in &both { td { (share(aligned_ssim(of))) } }
            }
            td { (percent(image.rendered.scores.counted)) }
            td { (percent(image.covered)) }
            @if columns.moving { td { (image.moving.map_or("no time".to_owned(), percent)) } }
            @if columns.lidar {
                @match &image.lidar {
                    Some(lidar) => {
                        td { (lidar.points) } td { (metres(lidar.mean_m)) } td { (metres(lidar.median_m)) }
                    }
                    None => { td { "none" } td { "" } td { "" } }
                }
            }
        }
    }
}
