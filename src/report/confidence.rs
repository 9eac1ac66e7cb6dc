//! How far images may be believed on the recorded drive and beside it, with what they show there.

use std::sync::Arc;

use serde::Serialize;

use super::ReportError;
use super::sample_points::{OFFSETS_M, SamplePoint};
use super::settings::scaled;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::geometry::CameraError;
use wildcity_session::{TrainingCoverage, Trust};
use wildcity_twin::residency::Resident;

/// Trust at one distance from the recorded drive: of all cameras at all stations.
#[derive(Clone, Debug, Serialize)]
pub struct Confidence {
    /// Distance from the drive, in metres.
    pub offset_m: f64,
    /// Mean trust of an image, from 0 to 1.
    pub mean: f64,
    /// Trust of the image that is believed least.
    pub least: f64,
    /// Trust of the image that is believed most.
    pub most: f64,
    /// Mean distance to the nearest keyframe, in metres.
    pub distance_m: f64,
    /// Mean angle to it, in radians.
    pub angle_rad: f64,
    /// Mean share of holes.
    pub low_coverage: f64,
    /// Mean share of rays that leave what was trained.
    pub outside: f64,
    /// What the rig's first camera sees in the middle of the drive.
    #[serde(skip)]
    pub picture: ViewImage,
}

/// An image of a place.
#[derive(Clone, Debug, Default)]
pub struct ViewImage {
    /// The place.
    pub place: String,
    /// A JPEG file.
    pub file: Vec<u8>,
}

/// Widest image that is looked at, in pixels: trust needs shares of pixels, and a page small pictures.
const WIDTH_PX: f64 = 360.0;
/// Quality of the pictures.
const QUALITY: u8 = 85;

/// Trust by [`OFFSETS_M`]; nothing of a twin without a recorded drive.
///
/// # Errors
/// The twin cannot be read, a frame cannot be drawn, or a picture not be encoded.
pub fn confidence_by_offset(
    resident: &Arc<Resident>,
    backend: &dyn Backend,
    places: &[SamplePoint],
) -> Result<Vec<Confidence>, ReportError> {
    let Some(trained) = TrainingCoverage::new(&resident.version.manifest) else {
        return Ok(Vec::new());
    };
    let mut all = Vec::new();
    for offset_m in OFFSETS_M {
        let here: Vec<&SamplePoint> =
            places.iter().filter(|place| place.offset_m == offset_m).collect();
        let (mut trusts, mut picture) = (Vec::new(), ViewImage::default());
        for (station, place) in here.iter().enumerate() {
            let seen = Seen::of(resident, backend, place, &trained)?;
            if station == here.len() / 2 {
                picture = seen.picture(place)?;
            }
            trusts.extend(seen.trusts);
        }
        all.push(summed(offset_m, &trusts, picture));
    }
    Ok(all)
}

/// What the cameras see at one place.
struct Seen {
    trusts: Vec<Trust>,
    first: View,
    rgb8: Vec<u8>,
}

impl Seen {
    fn of(
        resident: &Arc<Resident>,
        backend: &dyn Backend,
        place: &SamplePoint,
        trained: &TrainingCoverage,
    ) -> Result<Self, ReportError> {
        let world_from_rig = place.world_from_rig.ok_or(ReportError::NoSamplePoints)?;
        let widest_px = place.views.iter().map(|view| view.camera.width_px).fold(1, u32::max);
        let share = (WIDTH_PX / f64::from(widest_px)).min(1.0);
        let views = place.views.iter().map(|view| scaled(*view, share));
        let views = views.collect::<Result<Vec<View>, CameraError>>()?;
        let profile = &resident.version.manifest.profile;
        let scene = resident.scene(&wildcity_session::viewpoints(&views), profile)?;
        let pixels = || views.iter().map(|view| view.camera.pixels());
        let mut rgb8: Vec<Vec<u8>> = pixels().map(|count| vec![0; 3 * count]).collect();
        let mut opacity: Vec<Vec<f32>> = pixels().map(|count| vec![0.0; count]).collect();
        let target = |(rgb8, opacity)| Target {
            rgb8: Some(rgb8),
            opacity: Some(opacity),
            ..Target::default()
        };
        let buffers = rgb8.iter_mut().map(Vec::as_mut_slice);
        let buffers = buffers.zip(opacity.iter_mut().map(Vec::as_mut_slice));
        let mut targets: Vec<Target<'_>> = buffers.map(target).collect();
        let frame = Frame { scene: &scene, profile, views: &views };
        backend.render(&frame, &mut targets, &|_, _| {})?;
        let trust =
            |(view, opacity): (&View, &Vec<f32>)| trained.trust(&world_from_rig, view, opacity);
        let trusts = views.iter().zip(&opacity).map(trust).collect();
        Ok(Self { trusts, first: views[0], rgb8: rgb8.swap_remove(0) })
    }

    fn picture(&self, place: &SamplePoint) -> Result<ViewImage, ReportError> {
        let (width_px, height_px) = (self.first.camera.width_px, self.first.camera.height_px);
        let file = wildcity_session::jpeg(&self.rgb8, width_px, height_px, QUALITY);
        let file = file.map_err(|reason| ReportError::Encode { reason })?;
        Ok(ViewImage { place: place.name.clone(), file })
    }
}

fn summed(offset_m: f64, trusts: &[Trust], picture: ViewImage) -> Confidence {
    let count = trusts.len().max(1) as f64;
    let mean = |of: &dyn Fn(&Trust) -> f64| trusts.iter().map(of).sum::<f64>() / count;
    let values = || trusts.iter().map(|trust| trust.value);
    Confidence {
        offset_m,
        mean: mean(&|trust| trust.value),
        least: values().fold(1.0, f64::min),
        most: values().fold(0.0, f64::max),
        distance_m: mean(&|trust| trust.distance_m),
        angle_rad: mean(&|trust| trust.angle_rad),
        low_coverage: mean(&|trust| trust.low_coverage),
        outside: mean(&|trust| trust.outside),
        picture,
    }
}
