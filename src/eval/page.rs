//! The evaluation as one HTML page that loads nothing else: pictures are data URLs.

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::evaluation::{EvaluatedImage, Evaluation, Means};
use wildcity_render::compare::heat::HEAT_RGB;

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}.wide{overflow-x:auto}
figure{margin:0 0 18px}figure div{display:flex;gap:4px}figure img{width:33.3%;min-width:0;height:auto;align-self:flex-start}
figcaption{font-size:13px;margin-bottom:3px}.key span{display:inline-block;padding:1px 8px;font-size:12px}
.miss{color:#b00020;font-weight:600}";

/// Share of covered pixels below which the page says that the camera may look past the scene.
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
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                (introduction(evaluation))
                (means_table(evaluation))
                (meanings(evaluation))
                (pictures(&worst_first))
                (images_table(evaluation, &worst_first))
            }
        }
    };
    markup.into_string() + "\n"
}

fn introduction(evaluation: &Evaluation) -> Markup {
    let subject = &evaluation.subject;
    let total = evaluation.images.len();
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
        @if uncounted > 0 {
            p.miss { "Of " (uncounted) " images no pixel counts: they are in no mean." }
        }
        @if past > 0 {
            p.miss {
                "In " (past) " images the scene covers less than " (100.0 * BARELY_COVERED) " % of the pixels. If it \
                 should be there, the poses have other axes or another unit than the scene: see --axes and --scale."
            }
        }
    }
}

fn means_table(evaluation: &Evaluation) -> Markup {
    let has_cameras = evaluation.cameras.len() > 1;
    let has_aligned = evaluation.all.aligned.is_some();
    html! {
        div.wide {
            table {
                tr {
                    th { "mean of images" } th { "images" }
                    th { "PSNR, dB" } th { "SSIM" } th { "SSIM, mirrored" } th { "FLIP" } th { "pooled PSNR, dB" }
                    @if has_aligned { th { "PSNR aligned, dB" } th { "SSIM aligned" } }
                }
                (means_row("all", &evaluation.all))
                @if has_cameras {
                    @for camera in &evaluation.cameras {
                        (means_row(if camera.camera.is_empty() { "." } else { &camera.camera }, &camera.means))
                    }
                }
            }
        }
    }
}

fn means_row(name: &str, means: &Means) -> Markup {
    html! {
        tr {
            td { (name) } td { (means.images) }
            td { (decibels(means.psnr_db)) } td { (share(means.ssim)) } td { (share(means.ssim_mirrored)) }
            td { (share(means.flip)) } td { (decibels(means.pooled_psnr_db)) }
            @if let Some(aligned) = &means.aligned {
                td { (decibels(aligned.psnr_db)) } td { (share(aligned.ssim)) }
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
            @if evaluation.all.aligned.is_some() {
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
    let last = HEAT_RGB.len() - 1;
    html! {
        h2 { "The worst images" }
        p { "From left to right: real, rendered, and FLIP of each pixel, grey where pixels do not count. Colours of FLIP:" }
        p.key {
            @for (step, [r, g, b]) in HEAT_RGB.iter().enumerate() {
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
                    @for (file, what) in thumbnails.files.iter().zip(["real", "rendered", "error"]) {
                        img alt=(what) src=(format!("data:image/jpeg;base64,{}", BASE64.encode(file)));
                    }
                }
            }
        }
    }
}

fn caption(image: &EvaluatedImage) -> String {
    let scores = &image.scores;
    let mut text = format!(
        "{}, SSIM {}, FLIP {}",
        with_unit(scores.psnr_db),
        share(scores.ssim),
        share(scores.flip)
    );
    if let Some(aligned) = &scores.aligned {
        text += &format!("; aligned {}", with_unit(aligned.psnr_db));
    }
    text
}

fn images_table(evaluation: &Evaluation, worst_first: &[&EvaluatedImage]) -> Markup {
    let has_aligned = evaluation.all.aligned.is_some();
    html! {
        h2 { "All images" }
        div.wide {
            table {
                tr {
                    th { "image" } th { "size, px" } th { "PSNR, dB" } th { "SSIM" } th { "SSIM, mirrored" } th { "FLIP" }
                    @if has_aligned { th { "PSNR aligned, dB" } th { "SSIM aligned" } }
                    th { "counted, %" } th { "covered, %" }
                }
                @for image in worst_first {
                    @let scores = &image.scores;
                    @let [width, height] = image.size_px;
                    tr {
                        td { (image.name) } td { (width) " x " (height) }
                        td { (decibels(scores.psnr_db)) } td { (share(scores.ssim)) }
                        td { (share(scores.ssim_mirrored)) } td { (share(scores.flip)) }
                        @if let Some(aligned) = &scores.aligned {
                            td { (decibels(aligned.psnr_db)) } td { (share(aligned.ssim)) }
                        }
                        td { (format!("{:.1}", 100.0 * scores.counted)) }
                        td { (format!("{:.1}", 100.0 * image.covered)) }
                    }
                }
            }
        }
    }
}

fn decibels(db: f64) -> String {
    match db {
        f64::INFINITY => "exact".to_owned(),
        db if db.is_nan() => "none".to_owned(),
        db => format!("{db:.2}"),
    }
}

fn with_unit(db: f64) -> String {
    if db.is_finite() { format!("{db:.2} dB") } else { decibels(db) }
}

fn share(value: f64) -> String {
    if value.is_nan() { "none".to_owned() } else { format!("{value:.4}") }
}
