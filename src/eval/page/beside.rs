//! Off-trajectory views, as a table and a row of pictures for each distance.

use data_encoding::BASE64;
use maud::{Markup, html};

use super::numbers::{mean_decibels, percent, share};
use crate::evaluation::Evaluation;
use crate::extrapolation::{Extrapolation, ViewMeans};

/// The table and the pictures; empty if no such view was requested.
pub(super) fn section(evaluation: &Evaluation) -> Markup {
    let all = &evaluation.extrapolation;
    if all.is_empty() {
        return html! {};
    }
    let has_kid = all.iter().any(|one| one.kid.is_some());
    html! {
        h2 { "Beside the drive" }
        p {
            "There is no real image there. Trust is 1 on the drive. Reprojection brings the view back onto the real image that \
             it was moved from, where the rendered depths agree: PSNR, FLIP, and the share of the pixels that came back. \
             Flicker is the mean change to the view 0.8 m further back, from 0 to 1, where it shows the same surface."
        }
        div.wide {
            table {
                tr {
                    th { "beside" } th { "views" } th { "trust" } th { "covered, %" } th { "" }
                    th { "reprojection, dB" } th { "FLIP" } th { "came back, %" } th { "flicker" } th { "ratio" }
                    @if has_kid { th { "KID" } }
                }
                @for one in all { (rows(one, has_kid)) }
            }
        }
        @for one in all { (pictures(one)) }
    }
}

fn rows(one: &Extrapolation, has_kid: bool) -> Markup {
    html! {
        tr {
            td { (format!("{} m", one.offset_m)) } td { (one.views.len()) } td { (share(one.trust)) }
            td { (percent(one.covered)) } td { "rendered" } (cells(&one.rendered)) td { "" }
            @if has_kid { td { (one.kid.as_ref().map_or(String::new(), |kid| share(kid.rendered.mean))) } }
        }
        @if let Some(repaired) = &one.repaired {
            tr {
                td { "" } td { "" } td { "" } td { "" } td { "repaired" } (cells(repaired))
                td { (one.flicker_ratio.map_or(String::new(), |ratio| format!("{ratio:.2}"))) }
                @if has_kid {
                    @let kid = one.kid.as_ref().and_then(|kid| kid.repaired.as_ref());
                    td { (kid.map_or(String::new(), |kid| share(kid.mean))) }
                }
            }
        }
    }
}

fn cells(means: &ViewMeans) -> Markup {
    html! {
        td { (mean_decibels(means.reprojection_psnr_db)) } td { (share(means.reprojection_flip)) }
        td { (percent(means.reprojection_share)) } td { (share(means.flicker)) }
    }
}

fn pictures(one: &Extrapolation) -> Markup {
    if one.pictures.is_empty() {
        return html! {};
    }
    html! {
        figure {
            figcaption {
                b { (format!("{} m", one.offset_m)) } " "
                (one.pictures.iter().map(|(what, _)| *what).collect::<Vec<_>>().join(", "))
            }
            div.row {
                @for (what, file) in &one.pictures {
                    img alt=(what) src=(format!("data:image/jpeg;base64,{}", BASE64.encode(file)));
                }
            }
        }
    }
}
