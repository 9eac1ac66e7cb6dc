//! Recorded images of a twin: what the cameras really saw along its drives.
//!
//! A manifest names a *table* of them, which is JSON and an object of its own, and the table names
//! each image, a JPEG or PNG that is an object as well. Images are read when a repair model needs
//! them ([`Manifest::views`]).
//!
//! [`Manifest::views`]: crate::Manifest::views

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::manifest::ObjectRef;
use super::rig::is_name;
use wildcity_options::strict;

use crate::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use crate::geometry::{Camera, CameraError, Pose};

/// An image that a camera took on a recorded drive.
///
/// JSON:
/// `{"trajectory", "station_m", "camera", "width", "height", "fx", "fy", "cx", "cy",`
/// `"world_from_camera": {"xyz", "q"}, "image": {"object", "bytes"}}`
/// and perhaps `mask`, like `image`, and `exposure_stops`; and, as in rig files, `lens`,
/// `windshield` and `native_size`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "ViewFields", into = "ViewFields")]
pub struct RecordedView {
    /// The drive, by its name.
    pub trajectory: String,
    /// Station of the drive at which it was taken, in metres from its start.
    pub station_m: f64,
    /// Name of the camera, `[a-z0-9._-]+`.
    pub camera_name: String,
    /// Size, intrinsics and lens of the stored image.
    pub camera: Camera,
    /// Pose of the camera in the world.
    pub world_from_camera: Pose,
    /// The exposure of the image in stops against the twin's, if that is known.
    pub exposure_stops: Option<f64>,
    /// The JPEG or PNG.
    pub image: ObjectRef,
    /// A PNG of the image's size, if not all pixels count: those darker than half show what the
    /// twin does not have, such as the hood of the own vehicle.
    pub mask: Option<ObjectRef>,
}

/// Why a table of recorded images was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ViewError {
    /// A name is empty, too long, or has other characters than `[a-z0-9._-]`.
    #[error("{field} {name:?} is not a name: 1 to 64 of a-z 0-9 . _ -, not beginning with .")]
    Name {
        /// The field: `camera` or `trajectory`.
        field: &'static str,
        name: String,
    },
    /// A number is not finite.
    #[error("{field} is {value:?}; give a finite number")]
    Number {
        /// The field: `station_m` or `exposure_stops`.
        field: &'static str,
        value: f64,
    },
    /// An exposure that no camera has.
    #[error("exposure_stops is {value}; give -{most} to {most}", most = MOST_STOPS)]
    Stops { value: f64 },
    /// The camera cannot be used.
    #[error("camera {name:?}: {cause}")]
    Camera { name: String, cause: CameraError },
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewFields {
    trajectory: String,
    station_m: f64,
    camera: String,
    width: u32,
    height: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fx: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fy: Option<f64>,
    cx: f64,
    cy: f64,
    #[serde(
        default,
        deserialize_with = "strict::deserialize",
        skip_serializing_if = "Option::is_none"
    )]
    lens: Option<LensFields>,
    #[serde(
        default,
        deserialize_with = "strict::deserialize",
        skip_serializing_if = "Option::is_none"
    )]
    windshield: Option<WindshieldFields>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    native_size: Option<[f64; 2]>,
    world_from_camera: Pose,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    exposure_stops: Option<f64>,
    image: ObjectRef,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    mask: Option<ObjectRef>,
}

/// Largest exposure of an image against the twin's, in stops.
pub const MOST_STOPS: f64 = 16.0;

/// An exposure in stops that no camera has: beyond [`MOST_STOPS`], or not a number.
pub fn refused_stops(stops: Option<f64>) -> Option<f64> {
    stops.filter(|stops| !(-MOST_STOPS..=MOST_STOPS).contains(stops))
}

impl RecordedView {
    /// Checks names, numbers and the camera.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    pub fn check(&self) -> Result<(), ViewError> {
        for (field, name) in [("trajectory", &self.trajectory), ("camera", &self.camera_name)] {
            if !is_name(name) {
                return Err(ViewError::Name { field, name: name.clone() });
            }
        }
        if !self.station_m.is_finite() {
            return Err(ViewError::Number { field: "station_m", value: self.station_m });
        }
        if let Some(value) = refused_stops(self.exposure_stops) {
            return Err(ViewError::Stops { value });
        }
        let wrong = |cause| ViewError::Camera { name: self.camera_name.clone(), cause };
        self.camera.check().map_err(wrong)
    }
}

/// A mask of an image that Lanczos 3 shrinks, `[height, width]`: a pixel counts if all of those
/// that it is made of do. The kernel reaches three of the smaller pixels far. Nothing changes if
/// the sizes are equal.
pub fn reduced_mask(counts: &[bool], from_px: [u32; 2], to_px: [u32; 2]) -> Vec<bool> {
    if from_px == to_px {
        return counts.to_vec();
    }
    let [width, height] = from_px.map(|side| side as usize);
    let [to_width, to_height] = to_px.map(|side| side as usize);
    // True until a pixel that does not count reaches it: most masks exclude few pixels.
    let mut reduced = vec![true; to_width * to_height];
    for (pixel, _) in counts.iter().enumerate().filter(|(_, counts)| !**counts) {
        let columns = reached(pixel % width, width, to_width);
        for row in reached(pixel / width, height, to_height) {
            // A rectangle of the smaller image: rows and columns are independent in a separable
            // kernel.
            reduced[row * to_width..][columns.clone()].fill(false);
        }
    }
    reduced
}

/// The pixels of a row of `to` that Lanczos 3 makes of pixel `at` of a row of `from`.
fn reached(at: usize, from: usize, to: usize) -> Range<usize> {
    const REACH_PX: f64 = 3.0;
    // The centre of the pixel, in pixels of the smaller image.
    let center_px = (at as f64 + 0.5) * to as f64 / from as f64;
    // Centres are at +0.5. Negative numbers become 0.
    let first = (center_px - REACH_PX - 0.5).ceil() as usize;
    let last = (center_px + REACH_PX - 0.5).floor() as usize;
    // Cut at the far edge; `first` cannot be beyond it, because the centre is within the image.
    first..(last + 1).min(to)
}

impl From<RecordedView> for ViewFields {
    fn from(from: RecordedView) -> Self {
        let Intrinsics { size_px, focal_px, center_px, lens, windshield, native_size_px } =
            Intrinsics::from_camera(&from.camera);
        let [width, height] = size_px;
        let [fx, fy] = focal_px;
        let [cx, cy] = center_px;
        Self {
            trajectory: from.trajectory,
            station_m: from.station_m,
            camera: from.camera_name,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            lens,
            windshield,
            native_size: native_size_px,
            world_from_camera: from.world_from_camera,
            exposure_stops: from.exposure_stops,
            image: from.image,
            mask: from.mask,
        }
    }
}

impl TryFrom<ViewFields> for RecordedView {
    type Error = ViewError;

    fn try_from(fields: ViewFields) -> Result<Self, ViewError> {
        let intrinsics = Intrinsics {
            size_px: [fields.width, fields.height],
            focal_px: [fields.fx, fields.fy],
            center_px: [fields.cx, fields.cy],
            lens: fields.lens,
            windshield: fields.windshield,
            native_size_px: fields.native_size,
        };
        let made = intrinsics.camera();
        let camera =
            made.map_err(|cause| ViewError::Camera { name: fields.camera.clone(), cause })?;
        let view = Self {
            trajectory: fields.trajectory,
            station_m: fields.station_m,
            camera_name: fields.camera,
            camera,
            world_from_camera: fields.world_from_camera,
            exposure_stops: fields.exposure_stops,
            image: fields.image,
            mask: fields.mask,
        };
        view.check()?;
        Ok(view)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::Pinhole;

    #[test]
    fn a_pixel_of_a_smaller_mask_counts_if_all_of_its_pixels_do() {
        // One pixel in the middle of 40 x 4, at 20.5: in 20 x 2 at 10.25, so that centres from 7.25
        // to 13.25 are reached.
        // Row 2 of 4, whose centre 2.5 is 1.25 in the smaller image: both of its rows are within
        // three pixels.
        let mut counts = vec![true; 40 * 4];
        counts[40 * 2 + 20] = false;
        let reduced = reduced_mask(&counts, [40, 4], [20, 2]);
        for (column, (above, below)) in reduced[..20].iter().zip(&reduced[20..]).enumerate() {
            let is_reached = (7..=12).contains(&column);
            assert_eq!([*above, *below], [!is_reached; 2], "column {column}");
        }
        assert_eq!(reduced_mask(&counts, [40, 4], [40, 4]), counts);
    }

    #[test]
    fn a_view_is_read_as_it_was_written_and_checked() {
        let pinhole = Pinhole { fx: 100.0, fy: 101.0, cx: 50.0, cy: 40.0 };
        let view = RecordedView {
            trajectory: "log".into(),
            station_m: 12.5,
            camera_name: "front".into(),
            camera: Camera::from_pinhole(100, 80, pinhole),
            world_from_camera: Pose::IDENTITY,
            exposure_stops: Some(-1.5),
            image: ObjectRef { object: "0".repeat(64), bytes: 3 },
            mask: Some(ObjectRef { object: "1".repeat(64), bytes: 4 }),
        };
        let text = serde_json::to_string(&view).unwrap();
        assert_eq!(serde_json::from_str::<RecordedView>(&text).unwrap(), view);
        let renamed = text.replace("\"front\"", "\"Front camera\"");
        let error = serde_json::from_str::<RecordedView>(&renamed).unwrap_err();
        assert!(error.to_string().contains("camera \"Front camera\""), "{error}");
        let flat = text.replace("\"height\":80", "\"height\":0");
        let error = serde_json::from_str::<RecordedView>(&flat).unwrap_err();
        assert!(error.to_string().contains("height"), "{error}");
        let bright = text.replace("-1.5", "17.0");
        let error = serde_json::from_str::<RecordedView>(&bright).unwrap_err();
        assert!(error.to_string().contains("exposure_stops is 17; give -16 to 16"), "{error}");
        let bare = RecordedView { exposure_stops: None, mask: None, ..view };
        let text = serde_json::to_string(&bare).unwrap();
        assert!(!text.contains("mask") && !text.contains("stops"), "{text}");
        assert_eq!(serde_json::from_str::<RecordedView>(&text).unwrap(), bare);
    }
}
