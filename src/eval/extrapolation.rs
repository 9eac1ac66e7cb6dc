//! Off-trajectory views, for which there is no real image, and the metrics that need none.

use serde::Serialize;

use super::kid::KidScores;
use super::mean::mean;
use super::reprojection::Reprojection;
use wildcity_render::compare::json_numbers::serialize_number;

/// Scores of one view off the trajectory.
#[derive(Clone, Debug, Serialize)]
pub struct ExtrapolatedView {
    /// Name of the real image that it was moved from.
    pub name: String,
    /// Trust in the rendered view, 0 to 1.
    pub trust: f64,
    /// Share of its pixels with an opacity of at least 1/2.
    pub covered: f64,
    /// Scores of the view as it was rendered.
    pub rendered: ViewScores,
    /// Scores of the repaired view; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repaired: Option<ViewScores>,
}

/// Scores of a view that need no real image at its pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ViewScores {
    /// Error of the view after it is warped back onto the real image.
    pub reprojection: Reprojection,
    /// [Flicker](wildcity_render::compare::flicker::flicker) against the previous view at the same
    /// lateral offset.
    #[serde(serialize_with = "serialize_number")]
    pub flicker: f64,
}

/// The views at one distance from the drive.
#[derive(Clone, Debug, Serialize)]
pub struct Extrapolation {
    /// Lateral offset from the drive, in metres: positive to the left, negative to the right.
    pub offset_m: f64,
    #[serde(serialize_with = "serialize_number")]
    pub trust: f64,
    /// Mean share of pixels with an opacity of at least 1/2.
    #[serde(serialize_with = "serialize_number")]
    pub covered: f64,
    /// Means of the views as they were rendered.
    pub rendered: ViewMeans,
    /// Means of the repaired views; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repaired: Option<ViewMeans>,
    /// Flicker of the repaired views divided by that of the rendered ones.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flicker_ratio: Option<f64>,
    /// Distances of the features of the views from those of the real images, as [`Evaluation::kid`]
    /// has them.
    ///
    /// [`Evaluation::kid`]: super::Evaluation::kid
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kid: Option<KidScores>,
    /// The views, in the order of the images.
    pub views: Vec<ExtrapolatedView>,
    /// JPEG files for the page: the real image, the rendered view, and its pixels that were warped
    /// back; with a repair also the repaired view.
    #[serde(skip)]
    pub pictures: Vec<(&'static str, Vec<u8>)>,
}

/// Means over views. A view without a valid pixel is left out; NaN if no view is left.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ViewMeans {
    /// Mean PSNR of the reprojection, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub reprojection_psnr_db: f64,
    /// Mean FLIP of the reprojection.
    #[serde(serialize_with = "serialize_number")]
    pub reprojection_flip: f64,
    /// Mean share of the real image's pixels that came back.
    #[serde(serialize_with = "serialize_number")]
    pub reprojection_share: f64,
    /// Mean flicker, from 0 to 1.
    #[serde(serialize_with = "serialize_number")]
    pub flicker: f64,
}

impl Extrapolation {
    /// Computes the means of the views at one distance.
    pub fn new(offset_m: f64, views: Vec<ExtrapolatedView>) -> Self {
        let rendered: Vec<ViewScores> = views.iter().map(|view| view.rendered).collect();
        let repaired: Vec<ViewScores> = views.iter().filter_map(|view| view.repaired).collect();
        // A view without a repair is left out of the repaired means.
        let rendered = ViewMeans::from_views(&rendered);
        let repaired = (!repaired.is_empty()).then(|| ViewMeans::from_views(&repaired));
        // The quotient of means and not the mean of quotients, in which a still view would weigh
        // most.
        let ratio = repaired.map(|repaired| repaired.flicker / rendered.flicker);
        Self {
            offset_m,
            trust: mean(views.iter().map(|view| view.trust)),
            covered: mean(views.iter().map(|view| view.covered)),
            rendered,
            repaired,
            // 0/0, or a view that does not flicker at all: JSON has no infinity.
            flicker_ratio: ratio.filter(|ratio| ratio.is_finite()),
            kid: None,
            views,
            pictures: Vec::new(),
        }
    }
}

impl ViewMeans {
    fn from_views(views: &[ViewScores]) -> Self {
        let mean = |value: &dyn Fn(&ViewScores) -> f64| {
            // NaN marks a view without a valid pixel.
            mean(views.iter().map(value).filter(|value| !value.is_nan()))
        };
        Self {
            reprojection_psnr_db: mean(&|view| view.reprojection.psnr_db),
            reprojection_flip: mean(&|view| view.reprojection.flip),
            reprojection_share: mean(&|view| view.reprojection.share),
            flicker: mean(&|view| view.flicker),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_leave_out_what_has_no_pixel() {
        let scores = |psnr_db, flicker| ViewScores {
            reprojection: Reprojection { psnr_db, flip: 0.5, share: 0.25 },
            flicker,
        };
        let view = |trust, rendered, repaired| ExtrapolatedView {
            name: "a".into(),
            trust,
            covered: 0.9,
            rendered,
            repaired: Some(repaired),
        };
        let made = Extrapolation::new(
            3.0,
            vec![
                view(0.5, scores(20.0, 0.02), scores(24.0, 0.05)),
                view(0.7, scores(f64::NAN, 0.04), scores(26.0, 0.04)),
            ],
        );
        // The second view has no PSNR, and its trust counts: (0.5 + 0.7) / 2.
        assert_eq!((made.rendered.reprojection_psnr_db, made.trust), (20.0, 0.6));
        assert_eq!(made.repaired.unwrap().reprojection_psnr_db, 25.0);
        assert!((made.covered - 0.9).abs() < 1e-12, "{made:?}");
        let Reprojection { flip, share, .. } = scores(1.0, 1.0).reprojection;
        let means = [made.rendered.reprojection_flip, made.rendered.reprojection_share];
        assert_eq!(means, [flip, share]);
        // Means of flicker: 0.045 / 0.03 = 1.5.
        assert!((made.flicker_ratio.unwrap() - 1.5).abs() < 1e-12, "{made:?}");
        assert!(Extrapolation::new(1.0, Vec::new()).rendered.flicker.is_nan());
    }
}
