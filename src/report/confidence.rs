//! Trust in images on the recorded drive and at lateral offsets from it, with an image from each
//! distance.

use std::sync::Arc;

use serde::Serialize;

use super::error::ReportError;
use super::sample_points::{OFFSETS_M, SamplePoint, scaled};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::geometry::CameraError;
use wildcity_session::{TrainingCoverage, Trust};
use wildcity_twin::residency::Resident;

/// Trust in the images at one distance from the recorded drive: statistics over all cameras at all
/// stations.
#[derive(Clone, Debug, Serialize)]
pub struct Confidence {
    /// Lateral distance from the drive, in metres.
    pub offset_m: f64,
    /// Mean trust of an image, from 0 to 1.
    pub mean: f64,
    /// Trust of the image with the lowest trust.
    #[serde(rename = "least")]
    pub min: f64,
    /// Trust of the image with the highest trust.
    #[serde(rename = "most")]
    pub max: f64,
    /// Mean distance from the rig to the nearest recorded keyframe, in metres.
    pub distance_m: f64,
    /// Mean angle between the rig and that keyframe, in radians.
    pub angle_rad: f64,
    /// Mean share of pixels without content, from 0 to 1.
    pub low_coverage: f64,
    /// Mean share of rays that leave the trained blocks, from 0 to 1.
    pub outside: f64,
    /// Image of the rig's first camera at the middle station.
    #[serde(skip)]
    pub image: ViewImage,
}

/// An image at a sample point.
#[derive(Clone, Debug, Default)]
pub struct ViewImage {
    /// Name of the sample point.
    pub sample_point: String,
    pub jpeg: Vec<u8>,
}

/// Widest image that is rendered, in pixels. Trust counts shares of pixels, which a small image has
/// too, and the page shows small images.
const WIDTH_PX: f64 = 360.0;
/// JPEG quality of the images on the page.
const JPEG_QUALITY: u8 = 85;

/// Trust at each distance of [`OFFSETS_M`]. Empty if the twin has no recorded drive.
///
/// # Errors
/// The twin cannot be read, a frame cannot be rendered, or an image cannot be encoded.
pub fn confidence_by_offset(
    resident: &Arc<Resident>,
    backend: &dyn Backend,
    sample_points: &[SamplePoint],
) -> Result<Vec<Confidence>, ReportError> {
    let Some(coverage) = TrainingCoverage::new(&resident.version.manifest) else {
        return Ok(Vec::new());
    };
    let mut all = Vec::new();
    for offset_m in OFFSETS_M {
        // Points carry one of the constants of `OFFSETS_M`, so that equality of f64 is safe.
        let at_offset = sample_points.iter().filter(|point| point.offset_m == offset_m);
        let at_offset: Vec<&SamplePoint> = at_offset.collect();
        let mut trusts = Vec::new();
        let mut image = ViewImage::default();
        for (station, point) in at_offset.iter().enumerate() {
            let observed = Observed::new(resident, backend, point, &coverage)?;
            // One image per distance is enough for the page; encoding all would make it
            // megabytes larger.
            if station == at_offset.len() / 2 {
                image = observed.image(point)?;
            }
            trusts.extend(observed.trusts);
        }
        all.push(summarize(offset_m, &trusts, image));
    }
    Ok(all)
}

/// The observation of all cameras at one sample point.
struct Observed {
    /// Trust of each camera's image.
    trusts: Vec<Trust>,
    /// The view of the first camera.
    first_view: View,
    /// The image of the first camera.
    first_rgb8: Vec<u8>,
}

impl Observed {
    fn new(
        resident: &Arc<Resident>,
        backend: &dyn Backend,
        point: &SamplePoint,
        coverage: &TrainingCoverage,
    ) -> Result<Self, ReportError> {
        // Without a drive there is no coverage, and this is not called.
        let world_from_rig = point.world_from_rig.ok_or(ReportError::NoSamplePoints)?;

        // All cameras, scaled by the same factor.
        // At least 1, so that nothing divides by 0.
        let widest_px = point.views.iter().map(|view| view.camera.width_px).fold(1, u32::max);
        // Never enlarged: a larger image has no more content.
        let scale = (WIDTH_PX / f64::from(widest_px)).min(1.0);
        let views = point
            .views
            .iter()
            .map(|view| scaled(*view, scale))
            .collect::<Result<Vec<View>, CameraError>>()?;

        // Colour and opacity of each.
        let profile = &resident.version.manifest.profile;
        let scene = resident.scene(&wildcity_session::viewpoints(&views), profile)?;
        let pixels = || views.iter().map(|view| view.camera.pixels());
        let mut rgb8: Vec<Vec<u8>> = pixels().map(|count| vec![0; 3 * count]).collect();
        let mut opacity: Vec<Vec<f32>> = pixels().map(|count| vec![0.0; count]).collect();
        let buffers = rgb8.iter_mut().zip(&mut opacity);
        let mut targets: Vec<Target<'_>> = buffers
            .map(|(rgb8, opacity)| Target {
                rgb8: Some(rgb8),
                opacity: Some(opacity),
                ..Target::default()
            })
            .collect();
        let frame = Frame { scene: &scene, profile, views: &views };
        backend.render(&frame, &mut targets, &|_, _| {})?;

        let images = views.iter().zip(&opacity);
        let trusts =
            images.map(|(view, opacity)| coverage.trust(&world_from_rig, view, opacity)).collect();
        // A rig has at least one camera.
        Ok(Self { trusts, first_view: views[0], first_rgb8: rgb8.swap_remove(0) })
    }

    fn image(&self, point: &SamplePoint) -> Result<ViewImage, ReportError> {
        let camera = &self.first_view.camera;
        let jpeg = wildcity_session::jpeg(
            &self.first_rgb8,
            camera.width_px,
            camera.height_px,
            JPEG_QUALITY,
        )
        .map_err(|reason| ReportError::Encode { reason })?;
        Ok(ViewImage { sample_point: point.name.clone(), jpeg })
    }
}

fn summarize(offset_m: f64, trusts: &[Trust], image: ViewImage) -> Confidence {
    // At least 1: without images the means are 0 and not NaN.
    let count = trusts.len().max(1) as f64;
    let mean = |of: &dyn Fn(&Trust) -> f64| trusts.iter().map(of).sum::<f64>() / count;
    let values = || trusts.iter().map(|trust| trust.value);
    Confidence {
        offset_m,
        mean: mean(&|trust| trust.value),
        // Trust lies between 0 and 1, which are the neutral starts.
        min: values().fold(1.0, f64::min),
        max: values().fold(0.0, f64::max),
        distance_m: mean(&|trust| trust.distance_m),
        angle_rad: mean(&|trust| trust.angle_rad),
        low_coverage: mean(&|trust| trust.low_coverage),
        outside: mean(&|trust| trust.outside),
        image,
    }
}
