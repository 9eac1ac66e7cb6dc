//! The table of means.

use maud::{Markup, html};

use super::numbers::{decibels, mean_decibels, metres, share, signed};
use crate::evaluation::{Evaluation, LidarSubject};
use crate::kid::Kid;
use crate::lidar::{LidarMeans, NO_LIDAR_POINT};
use crate::means::{Gain, Means, ScoreMeans};

/// The columns of the table.
#[derive(Clone, Copy)]
struct Columns {
    lpips: bool,
    aligned: bool,
    repaired: bool,
}

/// The means of all images and of each camera. With a repair there are three rows for each:
/// rendered, repaired, gain.
pub(super) fn table(evaluation: &Evaluation) -> Markup {
    let rendered = &evaluation.all.rendered;
    let columns = Columns {
        lpips: rendered.lpips.is_some(),
        aligned: rendered.aligned.is_some(),
        repaired: evaluation.all.repaired.is_some(),
    };
    // One camera is the same as all.
    let has_cameras = evaluation.cameras.len() > 1;
    html! {
        div.wide {
            table {
                tr {
                    th { "mean of images" } th { "images" }
                    @if columns.repaired { th { "" } }
                    th { "PSNR, dB" } th { "SSIM" } th { "SSIM, mirrored" } th { "FLIP" }
                    @if columns.lpips { th { "LPIPS" } }
                    th { "pooled PSNR, dB" }
                    @if columns.aligned { th { "PSNR aligned, dB" } th { "SSIM aligned" } }
                }
                (rows("all", &evaluation.all, columns))
                @if has_cameras {
                    @for camera in &evaluation.cameras {
                        (rows(named(&camera.camera), &camera.means, columns))
                    }
                }
            }
        }
    }
}

fn named(camera: &str) -> &str {
    if camera.is_empty() { "." } else { camera }
}

fn rows(name: &str, means: &Means, columns: Columns) -> Markup {
    html! {
        tr {
            td { (name) } td { (means.images) }
            @if columns.repaired { td { "rendered" } }
            (cells(&means.rendered, columns))
        }
        @if let Some(repaired) = &means.repaired {
            tr { td { "" } td { "" } td { "repaired" } (cells(repaired, columns)) }
        }
        @if let Some(gain) = &means.gain {
            tr.gain { td { "" } td { "" } td { "gain" } (gains(gain, columns)) }
        }
    }
}

fn cells(means: &ScoreMeans, columns: Columns) -> Markup {
    html! {
        td { (mean_decibels(means.psnr_db)) } td { (share(means.ssim)) } td { (share(means.ssim_mirrored)) }
        td { (share(means.flip)) }
        @if columns.lpips { td { (share(means.lpips.unwrap_or(f64::NAN))) } }
        td { (decibels(means.pooled_psnr_db)) }
        @if columns.aligned {
            @let aligned = means.aligned.as_ref();
            td { (mean_decibels(aligned.map_or(f64::NAN, |aligned| aligned.psnr_db))) }
            td { (share(aligned.map_or(f64::NAN, |aligned| aligned.ssim))) }
        }
    }
}

fn gains(gain: &Gain, columns: Columns) -> Markup {
    html! {
        td { (signed(gain.psnr_db, 2)) } td { (signed(gain.ssim, 4)) } td { "" } td { (signed(gain.flip, 4)) }
        @if columns.lpips { td { (signed(gain.lpips.unwrap_or(f64::NAN), 4)) } }
        td { "" }
        @if columns.aligned { td { "" } td { "" } }
    }
}

/// The distances of features, if there are any.
pub(super) fn kid(evaluation: &Evaluation) -> Markup {
    let Some(kid) = &evaluation.kid else { return html! {} };
    let text =
        |kid: &Kid| format!("{:.5} (standard deviation {:.5})", kid.mean, kid.standard_deviation);
    let Kid { subsets, subset_size, seed, .. } = kid.rendered;
    html! {
        p {
            "KID by the network " code { (kid.network) } ": rendered " (text(&kid.rendered))
            @if let Some(repaired) = &kid.repaired { ", repaired " (text(repaired)) }
            ". " (subsets) " subsets of " (subset_size) " images, seed " (seed) "."
        }
    }
}

/// Depth against LiDAR, if it was compared.
pub(super) fn lidar(evaluation: &Evaluation) -> Markup {
    let Some(all) = &evaluation.all.lidar else { return html! {} };
    html! {
        h2 { "Depth against LiDAR" }
        p {
            "Absolute difference of the rendered depth and the point's, in metres, by the point's depth."
            @if let Some(LidarSubject { left_out, .. }) = &evaluation.subject.lidar && *left_out > 0 {
                " " (left_out) " points were left out: no two poses at most 0.2 s apart are around their time."
            }
        }
        @if all.points == 0 { p.miss { (NO_LIDAR_POINT) "." } }
        div.wide {
            table {
                tr {
                    th { "images" } th { "with points" } th { "points" } th { "mean, m" } th { "median, m" }
                    @for bin in &all.bins { th { (bin.from_m) " to " (bin.to_m) " m" } }
                }
                (lidar_row("all", all))
                @if evaluation.cameras.len() > 1 {
                    @for camera in &evaluation.cameras {
                        @if let Some(means) = &camera.means.lidar { (lidar_row(named(&camera.camera), means)) }
                    }
                }
            }
        }
    }
}

fn lidar_row(name: &str, means: &LidarMeans) -> Markup {
    html! {
        tr {
            td { (name) } td { (means.images) } td { (means.points) }
            td { (metres(means.mean_m)) } td { (metres(means.median_m)) }
            @for bin in &means.bins { td { (metres(bin.mean_m)) " (" (bin.points) ")" } }
        }
    }
}
