//! The trust below which a model should repair: the threshold with the largest gain.
//!
//! Each threshold in hundredths is tried at every other station. The one with the largest total
//! gain is the recommendation, if images of the other stations gain by it as well. Of thresholds
//! with equal gains the least is taken, so that no image is repaired whose gain was not measured.

use serde::Serialize;

use wildcity_repair::Selection;

/// The gain of repair in one image, and the trust by which the image is selected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Trust in the rendered image.
    pub trust: f64,
    /// PSNR of the repaired image minus that of the rendered one, in dB.
    pub gain_db: f64,
}

/// The effect of a threshold on some images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Below {
    pub below: f64,
    pub images: usize,
    /// Number of images that it repairs: their trust is less.
    pub repaired: usize,
    /// Mean gain of the repaired images, in dB; `None` if it repairs none.
    pub gain_db: Option<f64>,
    /// Number of repaired images that are worse than rendered.
    pub worse: usize,
    /// Gain summed over all images, in dB.
    #[serde(skip)]
    pub total_db: f64,
}

/// The recommended thresholds for a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RecommendedBelow {
    /// Name of the model.
    pub model: String,
    /// Value for `repair.below` of a session; `None` if repair is not recommended.
    pub below: Option<f64>,
    /// Value for `repair.above` of a session.
    pub above: Option<f64>,
    /// Why no threshold is recommended.
    #[serde(rename = "unmet")]
    pub unmet_reason: Option<String>,
    /// Its effect at the stations by which it was selected.
    #[serde(rename = "chosen_by")]
    pub selection: Option<Below>,
    /// Its effect at the other stations.
    #[serde(rename = "verified")]
    pub verification: Option<Below>,
    /// The effect of the default threshold at the other stations.
    pub default: Below,
}

/// Why no threshold is recommended.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum BelowError {
    /// There is no image, or none with ground truth.
    #[error("no image has a true one to compare with")]
    NoImages,
    /// No threshold gains.
    #[error(
        "no threshold gains at the stations that it would be selected by; with trust below 1 the model changes PSNR \
         by {mean_db:+.2} dB there"
    )]
    NoGain {
        /// Mean over all images with a trust below 1.
        mean_db: f64,
    },
    /// It does not gain at other stations.
    #[error(
        "below {below:.2} was selected, but at the other stations it changes PSNR by {verified_db:+.2} dB: measure \
         more --stations"
    )]
    NotVerified {
        below: f64,
        /// Mean gain of the images that it repairs there; 0 if it repairs none.
        verified_db: f64,
    },
}

/// Difference between the thresholds at which repair begins and ends, as in the default.
const HYSTERESIS: f64 = 0.1;

impl Below {
    /// The effect of a threshold on some images. None is repaired whose trust is below the default
    /// `at_least`.
    pub fn new(below: f64, images: &[Gains]) -> Self {
        let Selection { at_least, .. } = Selection::default();
        // As `Selection::is_candidate` for a camera that is not in repair yet.
        let is_repaired = |image: &&Gains| image.trust < below && image.trust >= at_least;
        let repaired: Vec<f64> =
            images.iter().filter(is_repaired).map(|image| image.gain_db).collect();
        let total_db: f64 = repaired.iter().sum();
        Self {
            below,
            images: images.len(),
            repaired: repaired.len(),
            // No mean over nothing: the page then says that none is repaired.
            gain_db: (!repaired.is_empty()).then(|| total_db / repaired.len() as f64),
            worse: repaired.iter().filter(|gain_db| **gain_db < 0.0).count(),
            total_db,
        }
    }
}

/// Recommends a threshold for a model: selected by some images, and verified by others.
pub fn recommend_below(
    model: String,
    selection: &[Gains],
    verification: &[Gains],
) -> RecommendedBelow {
    // At the verification stations, where the recommended threshold is judged, too.
    let default = Below::new(Selection::default().below, verification);
    let mut recommended = RecommendedBelow {
        model,
        below: None,
        above: None,
        unmet_reason: None,
        selection: None,
        verification: None,
        default,
    };
    match best(selection) {
        Err(error) => recommended.unmet_reason = Some(error.to_string()),
        Ok(best) => {
            let verified = Below::new(best.below, verification);
            recommended.selection = Some(best);
            recommended.verification = Some(verified);
            // A threshold that repairs nothing there has gained nothing.
            let verified_db = verified.gain_db.unwrap_or(0.0);
            if verified_db > 0.0 {
                recommended.below = Some(best.below);
                // Rounded, since 0.82 + 0.1 is not 0.92 in binary.
                let above = (100.0 * (best.below + HYSTERESIS)).round() / 100.0;
                recommended.above = Some(above.min(1.0));
            } else {
                let error = BelowError::NotVerified { below: best.below, verified_db };
                recommended.unmet_reason = Some(error.to_string());
            }
        }
    }
    recommended
}

/// The threshold in hundredths with the largest total gain; the least of equal ones.
fn best(images: &[Gains]) -> Result<Below, BelowError> {
    if images.is_empty() {
        return Err(BelowError::NoImages);
    }
    // Below 0 nothing is repaired: a total of 0, which a threshold has to exceed.
    let mut best = Below::new(0.0, images);
    for hundredths in 1..=100 {
        let tried = Below::new(f64::from(hundredths) / 100.0, images);
        // `>` and not `>=`: the least of equal thresholds stays.
        if tried.total_db > best.total_db {
            best = tried;
        }
    }
    if best.repaired == 0 {
        // Below 1: all images but those on the drive, for the message.
        let mean_db = Below::new(1.0, images).gain_db.unwrap_or(0.0);
        return Err(BelowError::NoGain { mean_db });
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn images(values: &[(f64, f64)]) -> Vec<Gains> {
        values.iter().map(|&(trust, gain_db)| Gains { trust, gain_db }).collect()
    }

    #[test]
    fn repair_begins_where_it_begins_to_gain() {
        let selection =
            images(&[(1.0, -3.0), (0.904, -0.5), (0.818, 1.0), (0.55, 2.0), (0.36, 0.5)]);
        let others = images(&[(0.9, -0.4), (0.81, 0.8), (0.54, -0.2), (0.35, 0.6)]);
        let found = recommend_below("net".into(), &selection, &others);
        // 0.82 is the least that repairs the image of trust 0.818; 0.91 would add a loss of 0.5 dB.
        assert_eq!((found.below, found.above), (Some(0.82), Some(0.92)));
        let [chosen, verified] = [found.selection, found.verification].map(Option::unwrap);
        assert_eq!((chosen.repaired, chosen.images, chosen.worse), (3, 5, 0));
        // 0.81, 0.54 and 0.35 are below: (0.8 - 0.2 + 0.6)/3 = 0.4.
        assert_eq!((verified.repaired, verified.worse), (3, 1), "a loss is told");
        assert!((verified.gain_db.unwrap() - 0.4).abs() < 1e-12);
        assert_eq!((found.default.below, found.default.repaired), (0.75, 2));
    }

    #[test]
    fn a_model_that_loses_is_not_recommended_and_says_so() {
        let loses = images(&[(1.0, -1.0), (0.8, -2.0), (0.5, -3.0)]);
        let found = recommend_below("net".into(), &loses, &loses);
        assert_eq!((found.below, found.selection), (None, None));
        // The images at 0.8 and 0.5; the one on the drive does not count.
        assert!(found.unmet_reason.unwrap().contains("-2.50 dB"));
        let gains = images(&[(0.8, 2.0)]);
        let found = recommend_below("net".into(), &gains, &loses);
        assert_eq!((found.below, found.above), (None, None));
        let told = found.unmet_reason.unwrap();
        assert!(told.contains("below 0.81") && told.contains("-2.50 dB"), "{told}");
        assert_eq!(found.verification.unwrap().worse, 2);
        let found = recommend_below("net".into(), &[], &gains);
        assert!(found.unmet_reason.unwrap().contains("no image"));
    }

    #[test]
    fn what_would_be_invented_is_not_repaired() {
        // 0.05 is below `at_least`, so that its gain of 5 dB does not count.
        let far = images(&[(0.05, 5.0), (0.3, 1.0)]);
        let found = recommend_below("net".into(), &far, &far);
        assert_eq!(found.below, Some(0.31));
        assert_eq!(found.selection.unwrap().repaired, 1);
    }

    #[test]
    fn the_drive_itself_is_never_repaired() {
        // Even if it would gain: a trust of 1 is not below 1.
        let found = recommend_below("net".into(), &images(&[(1.0, 5.0)]), &images(&[(1.0, 5.0)]));
        assert_eq!(found.below, None);
    }
}
