//! Small images: of at most 0.45 of the native sides, each pixel is the mean of 2 x 2 samples.
//!
//! The samples are the pixels of the same camera with twice the size ([`sample_view`]), which its
//! own [`PixelFilter`](crate::layout::PixelFilter) filters. Splats are projected, sorted, binned
//! and blended there; the sums of each pixel are the means of those of its samples, and everything
//! that follows (background, exposure, overlay, mask, normals) has the pixels of the image.
//!
//! **Why.** The filter makes each splat as wide as a pixel, and the sum of wide splats is the mean
//! of native pixels only if they do not hide each other. Many splats smaller than a pixel do: each
//! covers its own part of the pixel, but blending multiplies what they let through as if each
//! covered all of it a little. No filter of single splats changes this. Samples are closer to
//! native pixels, and have less of it: 45 to 62 dB in place of 37 to 50 at a quarter of the native
//! size (BENCHMARKS.md, "Small images").
//!
//! **Depth** is that of the mean sums, and so weighted by opacity. **The owner of a pixel** is the
//! one that most of its samples have, of equally many the first (row by row). So is its class,
//! which may be that of another sample.
//!
//! Larger images have one sample a pixel: the filter alone reaches 40 dB, and samples, nearly as
//! many as native pixels, would take the time of a native image. Gradients have one sample a pixel,
//! too, whatever the profile says.

use std::borrow::Cow;

use crate::{Frame, View};
use wildcity_scene::{RenderProfile, Shrink, ViewSet};

/// Samples of a pixel along each axis.
pub(crate) const SAMPLES: u32 = 2;

/// Largest share of the native sides at which a pixel has several samples: 576 x 320 px of a camera
/// of 1920 x 1080 px are 0.3.
const MOST_SHARE: f64 = 0.45;

/// Number of samples of the images of some views with a profile: what they cost.
pub fn sample_count(views: &[View], profile: &RenderProfile) -> u64 {
    let samples = |view: &View| {
        let camera = sample_view(view, profile).map_or(view.camera, |samples| samples.camera);
        camera.pixels() as u64
    };
    views.iter().map(samples).sum()
}

/// The view whose pixels are the samples of another one's, row by row; `None` if that has one
/// sample a pixel.
pub(crate) fn sample_view(view: &View, profile: &RenderProfile) -> Option<View> {
    let camera = &view.camera;
    let is_small = camera.native_scale().max_element() <= MOST_SHARE;
    if !is_small || profile.shrink == Shrink::Filter {
        return None;
    }
    let [width, height] = [camera.width_px, camera.height_px].map(|px| u64::from(SAMPLES * px));
    // Twice 0.45 of a native size is a size that a camera may have.
    let camera = camera.scaled(width, height).ok()?;
    Some(View { camera, ..*view })
}

/// Whether a view has the samples of the view of an image, and not its pixels.
pub(crate) fn is_sampled(view: &View, shown: &View) -> bool {
    view.camera.width_px != shown.camera.width_px
}

/// The views of a frame as their splats are drawn.
#[derive(Clone, Debug)]
pub(crate) struct SampledViews<'a> {
    views: Cow<'a, [View]>,
    /// The views with several samples a pixel.
    pub(crate) sampled: ViewSet,
}

impl<'a> SampledViews<'a> {
    pub(crate) fn new(frame: &Frame<'a>) -> Self {
        let Frame { views, profile, .. } = *frame;
        let samples: Vec<Option<View>> =
            views.iter().map(|view| sample_view(view, profile)).collect();
        let sampled = (0..).zip(&samples).filter_map(|(view, samples)| samples.and(Some(view)));
        let sampled: ViewSet = sampled.collect();
        // Most frames have no small image.
        if sampled == ViewSet::default() {
            return Self { views: Cow::Borrowed(views), sampled };
        }
        let of_each = samples.into_iter().zip(views);
        let views = of_each.map(|(samples, view)| samples.unwrap_or(*view)).collect();
        Self { views, sampled }
    }

    /// The frame with these views in place of its own.
    pub(crate) fn frame<'b>(&'b self, frame: &Frame<'b>) -> Frame<'b> {
        Frame { views: &self.views, ..*frame }
    }
}

/// The value that most samples of a pixel have, of equally many the first.
pub(crate) fn most_frequent<T: Copy + PartialEq>(samples: [T; 4]) -> T {
    let count = |value: T| samples.iter().filter(|&&other| other == value).count();
    let [first, ..] = samples;
    samples
        .into_iter()
        // Strictly more, so that the first of equally frequent ones stays.
        .fold(first, |best, value| if count(value) > count(best) { value } else { best })
}
