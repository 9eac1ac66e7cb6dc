//! Rigs: the cameras of a vehicle.

use std::collections::BTreeSet;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::appearance::{Appearance, AppearanceError, Exposure, Overlay};
use crate::geometry::camera::Shutter;
use crate::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use crate::geometry::{Camera, CameraError, Pose};

/// A camera on the vehicle.
///
/// In rig files, manifests and episodes it looks as on the wire: `{"name", "width", "height", "fx",
/// "fy", "cx", "cy", "camera_to_rig": {"xyz", "q"}}`, sizes and intrinsics in pixels; what is no pinhole
/// has `lens`, `windshield` and `shutter` besides ([`crate::geometry::camera::json`]), what is not
/// recorded as it is `exposure`, and what has its own car before it `overlay` ([`Appearance`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "CameraFields", into = "CameraFields")]
pub struct RigCamera {
    /// Name within the rig, `[a-z0-9._-]+`.
    pub name: String,
    /// Size, intrinsics and lens.
    pub camera: Camera,
    /// Where the camera stands on the rig (`camera_to_rig` on the wire).
    pub rig_from_camera: Pose,
    /// How its rows are exposed one after the other; all at once if absent.
    pub shutter: Option<Shutter>,
    /// What it makes of colours, and what of its own car it sees.
    pub appearance: Appearance,
}

impl RigCamera {
    /// A camera whose rows are exposed all at once, and which shows what is there.
    pub fn new(name: impl Into<String>, camera: Camera, rig_from_camera: Pose) -> Self {
        let appearance = Appearance::default();
        Self { name: name.into(), camera, rig_from_camera, shutter: None, appearance }
    }

    /// The camera whose image is a part of this one's: first column and row, then width and height.
    ///
    /// # Errors
    /// It is not within the image, or the lens does not see it.
    pub fn cropped(&self, at_px: [u64; 2], size_px: [u64; 2]) -> Result<Self, RigError> {
        let camera = self.camera.cropped(at_px, size_px).map_err(|cause| self.wrong(cause))?;
        // Within the image: they are small.
        self.part(camera, at_px.map(|at| at as u32), [camera.width_px, camera.height_px])
    }

    /// The camera with the same field of view and another number of pixels.
    ///
    /// # Errors
    /// There is no such camera.
    pub fn scaled(&self, width_px: u64, height_px: u64) -> Result<Self, RigError> {
        let camera = self.camera.scaled(width_px, height_px).map_err(|cause| self.wrong(cause))?;
        self.part(camera, [0, 0], [self.camera.width_px, self.camera.height_px])
    }

    /// With another camera, which sees a part of the image, and that part of what lies over it.
    fn part(&self, camera: Camera, at_px: [u32; 2], part_px: [u32; 2]) -> Result<Self, RigError> {
        let mut appearance = self.appearance.clone();
        if let Some(overlay) = &mut appearance.overlay {
            let size_px = [camera.width_px, camera.height_px];
            let part = overlay.cropped_and_resized(at_px, part_px, size_px);
            *overlay = Arc::new(part.map_err(|cause| self.looks_wrong(cause))?);
        }
        Ok(Self { camera, appearance, ..self.clone() })
    }

    fn wrong(&self, cause: CameraError) -> RigError {
        RigError::Camera { name: self.name.clone(), cause }
    }

    fn looks_wrong(&self, cause: AppearanceError) -> RigError {
        RigError::Appearance { name: self.name.clone(), cause }
    }
}

/// The cameras of one vehicle, in the order in which images are answered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RigFields")]
pub struct Rig {
    /// Name, `[a-z0-9._-]+`.
    pub name: String,
    /// At least one camera.
    pub cameras: Vec<RigCamera>,
}

/// Why a rig was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigError {
    /// No cameras, or more than a step can render.
    #[error("rig {rig:?} has {count} cameras; 1 to {limit} are accepted")]
    Count {
        /// The rig.
        rig: String,
        /// How many it has.
        count: usize,
        /// How many are accepted.
        limit: usize,
    },
    /// A name is empty, too long, or has other characters than `[a-z0-9._-]`.
    #[error("{name:?} is not a name: 1 to 64 of a-z 0-9 . _ - are, not starting with .")]
    Name {
        /// The refused name.
        name: String,
    },
    /// Two cameras share a name.
    #[error("camera {name:?} occurs twice")]
    Duplicate {
        /// The name.
        name: String,
    },
    /// A camera cannot be used.
    #[error("camera {name:?}: {cause}")]
    Camera {
        /// The camera.
        name: String,
        /// What is wrong with it.
        cause: CameraError,
    },
    /// What it makes of an image cannot be used.
    #[error("camera {name:?}: {cause}")]
    Appearance {
        /// The camera.
        name: String,
        /// What is wrong with it.
        cause: AppearanceError,
    },
    /// Overlays that would take too much memory.
    #[error("the overlays of a rig have {pixels} pixels in all; at most {limit} are accepted")]
    Overlays {
        /// Their pixels.
        pixels: u64,
        /// How many are accepted.
        limit: u64,
    },
}

/// Rigs that come with the program, by name: the JSON of `scenes/rigs`.
const PRESETS: [(&str, &str); 4] = [
    ("vehicle6", include_str!("../../scenes/rigs/vehicle6.json")),
    ("surround6", include_str!("../../scenes/rigs/surround6.json")),
    ("alpamayo1", include_str!("../../scenes/rigs/alpamayo1.json")),
    ("alpamayo2", include_str!("../../scenes/rigs/alpamayo2.json")),
];

impl Rig {
    /// Names of the rigs that come with the program, for [`Rig::preset`].
    pub fn preset_names() -> impl Iterator<Item = &'static str> {
        PRESETS.into_iter().map(|(name, _)| name)
    }

    /// A rig that comes with the program; `None` if there is none of this name.
    pub fn preset(name: &str) -> Option<Self> {
        let (_, json) = PRESETS.into_iter().find(|(preset, _)| *preset == name)?;
        // A test parses every preset, so `ok` never turns a broken file into "no such rig".
        serde_json::from_str(json).ok()
    }

    /// Most cameras of a rig: the depth sort's key keeps 4 bits for the camera.
    pub const MAX_CAMERAS: usize = 16;

    /// # Errors
    /// Names the first camera that cannot be used.
    pub fn check(&self) -> Result<(), RigError> {
        let count = self.cameras.len();
        if !(1..=Self::MAX_CAMERAS).contains(&count) {
            let rig = self.name.clone();
            return Err(RigError::Count { rig, count, limit: Self::MAX_CAMERAS });
        }
        if !is_name(&self.name) {
            return Err(RigError::Name { name: self.name.clone() });
        }
        let mut names = BTreeSet::new();
        for mounted in &self.cameras {
            let RigCamera { name, camera, shutter, appearance, .. } = mounted;
            if !is_name(name) {
                return Err(RigError::Name { name: name.clone() });
            }
            if !names.insert(name) {
                return Err(RigError::Duplicate { name: name.clone() });
            }
            let shutter = shutter.as_ref().map_or(Ok(()), Shutter::check);
            camera.check().and(shutter).map_err(|cause| mounted.wrong(cause))?;
            let looks = appearance.check([camera.width_px, camera.height_px]);
            looks.map_err(|cause| mounted.looks_wrong(cause))?;
        }
        check_overlays(&self.cameras)
    }
}

/// # Errors
/// [`RigError::Overlays`].
pub fn check_overlays(cameras: &[RigCamera]) -> Result<(), RigError> {
    let overlays = cameras.iter().filter_map(|camera| camera.appearance.overlay.as_ref());
    check_overlay_pixels(overlays.map(|overlay| overlay.rgba8().len() as u64 / 4).sum())
}

/// # Errors
/// [`RigError::Overlays`].
pub fn check_overlay_pixels(pixels: u64) -> Result<(), RigError> {
    let limit = Overlay::MAX_PIXELS;
    match pixels <= limit {
        true => Ok(()),
        false => Err(RigError::Overlays { pixels, limit }),
    }
}

/// Memory of all overlays, in bytes: their pixels, and the files that they are written as.
pub fn overlay_bytes(cameras: &[RigCamera]) -> u64 {
    let overlays = cameras.iter().filter_map(|camera| camera.appearance.overlay.as_ref());
    overlays.map(|overlay| overlay.bytes()).sum()
}

/// Longest name, in bytes.
pub const MAX_NAME_BYTES: usize = 64;

/// Whether a text may name a twin, a rig, a camera, a trajectory or a session.
///
/// 1 to 64 of `a-z 0-9 . _ -`, not starting with a dot: safe as a file name, never a path.
pub fn is_name(text: &str) -> bool {
    let allowed = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b"._-".contains(&b);
    (1..=MAX_NAME_BYTES).contains(&text.len())
        && !text.starts_with('.')
        && text.bytes().all(allowed)
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFields {
    name: String,
    width: u32,
    height: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fx: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fy: Option<f64>,
    cx: f64,
    cy: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    lens: Option<LensFields>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    windshield: Option<WindshieldFields>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    shutter: Option<Shutter>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    exposure: Option<Exposure>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    overlay: Option<String>,
    camera_to_rig: Pose,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RigFields {
    name: String,
    cameras: Vec<CameraFields>,
}

/// Stops at the camera whose overlay is too much, so that no more is unpacked than a rig may have.
impl TryFrom<RigFields> for Rig {
    type Error = RigError;

    fn try_from(RigFields { name, cameras: fields }: RigFields) -> Result<Self, RigError> {
        let mut cameras = Vec::with_capacity(fields.len().min(Self::MAX_CAMERAS));
        for camera in fields {
            cameras.push(camera.try_into()?);
            check_overlays(&cameras)?;
        }
        Ok(Self { name, cameras })
    }
}

impl From<RigCamera> for CameraFields {
    fn from(from: RigCamera) -> Self {
        let RigCamera { name, camera, rig_from_camera: camera_to_rig, shutter, appearance } = from;
        let Intrinsics { size_px, focal_px, center_px, lens, windshield } = Intrinsics::of(&camera);
        let ([width, height], [fx, fy], [cx, cy]) = (size_px, focal_px, center_px);
        let Appearance { exposure, overlay } = appearance;
        let overlay = overlay.map(|overlay| overlay.to_data_uri());
        Self {
            name,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            lens,
            windshield,
            shutter,
            exposure,
            overlay,
            camera_to_rig,
        }
    }
}

/// Whoever reads a rig calls [`Rig::check`], which names the camera at fault; this refuses only what
/// makes no camera at all.
impl TryFrom<CameraFields> for RigCamera {
    type Error = RigError;

    fn try_from(fields: CameraFields) -> Result<Self, RigError> {
        let CameraFields { name, width, height, fx, fy, cx, cy, lens, windshield, .. } = fields;
        let (size_px, focal_px, center_px) = ([width, height], [fx, fy], [cx, cy]);
        let intrinsics = Intrinsics { size_px, focal_px, center_px, lens, windshield };
        let camera = match intrinsics.camera() {
            Ok(camera) => camera,
            Err(cause) => return Err(RigError::Camera { name, cause }),
        };
        let appearance = match Appearance::new(fields.exposure, fields.overlay.as_deref(), size_px)
        {
            Ok(appearance) => appearance,
            Err(cause) => return Err(RigError::Appearance { name, cause }),
        };
        let (rig_from_camera, shutter) = (fields.camera_to_rig, fields.shutter);
        Ok(Self { name, camera, rig_from_camera, shutter, appearance })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::Pinhole;
    use glam::DVec3;

    fn camera(name: &str) -> RigCamera {
        let pinhole = Pinhole { fx: 100.0, fy: 100.0, cx: 50.0, cy: 40.0 };
        RigCamera::new(name, Camera::from_pinhole(100, 80, pinhole), Pose::IDENTITY)
    }

    #[test]
    fn a_rig_is_checked() {
        let rig = |cameras| Rig { name: "test".into(), cameras };
        assert_eq!(rig(vec![camera("front"), camera("rear")]).check(), Ok(()));
        let nameless = Rig { name: "My car".into(), cameras: vec![camera("front")] };
        assert!(matches!(nameless.check(), Err(RigError::Name { .. })));
        assert!(matches!(rig(vec![]).check(), Err(RigError::Count { count: 0, .. })));
        let twice = rig(vec![camera("front"), camera("front")]);
        assert!(matches!(twice.check(), Err(RigError::Duplicate { .. })));
        let mut flat = camera("front");
        flat.camera.height_px = 0;
        assert!(matches!(rig(vec![flat]).check(), Err(RigError::Camera { .. })));
    }

    #[test]
    fn a_rig_file_says_what_the_wire_says() {
        let rig = Rig { name: "test".into(), cameras: vec![camera("front")] };
        let text = serde_json::to_string(&rig).unwrap();
        assert_eq!(
            text,
            r#"{"name":"test","cameras":[{"name":"front","width":100,"height":80,"fx":100.0,"#
                .to_owned()
                + r#""fy":100.0,"cx":50.0,"cy":40.0,"#
                + r#""camera_to_rig":{"xyz":[0.0,0.0,0.0],"q":[1.0,0.0,0.0,0.0]}}]}"#
        );
        assert_eq!(serde_json::from_str::<Rig>(&text).unwrap(), rig);
        let unknown = text.replace("\"fx\"", "\"k1\":0.1,\"fx\"");
        assert!(serde_json::from_str::<Rig>(&unknown).is_err(), "a lens that is not drawn");
    }

    #[test]
    fn lenses_and_shutters_are_written_as_they_are_read() {
        let rig = |more: &str| {
            let camera =
                format!(r#"{{"name":"front","width":100,"height":80,{more},"cx":50.0,"cy":40.0,"#);
            let rig = r#""camera_to_rig":{"xyz":[0,0,0],"q":[1,0,0,0]}}]}"#;
            serde_json::from_str::<Rig>(&format!(r#"{{"name":"test","cameras":[{camera}{rig}"#))
        };
        for more in [
            r#""fx":50,"fy":50,"lens":{"model":"opencv","k":[0.1,0,0,0,0,0],"p":[0.001,0]}"#,
            r#""fx":50,"fy":50,"lens":{"model":"fisheye","k":[0.02,0,0,0]}"#,
            r#""lens":{"model":"ftheta","reference":"angle_to_pixel","polynomial":[0,60,0,0,0,0],
                "linear_cde":[1,0,0],"max_angle":1.2}"#,
            r#""fx":50,"fy":50,"windshield":{"reference":"forward","horizontal":[0.01,1,0],
                "vertical":[0,0,1]},"shutter":{"direction":"top_to_bottom","duration_us":30000}"#,
        ] {
            let read = rig(more).unwrap();
            assert_eq!(read.check(), Ok(()), "{more}");
            assert!(!read.cameras[0].camera.is_pinhole());
            let text = serde_json::to_string(&read).unwrap();
            assert_eq!(serde_json::from_str::<Rig>(&text).unwrap(), read, "{text}");
        }
        let hood = Overlay::new(100, [[1, 2, 3, 4]; 8000].as_flattened().to_vec()).unwrap();
        let looks = format!(
            r#""fx":50,"fy":50,"exposure":{{"gain":[1,2,3]}},"overlay":"{}""#,
            hood.to_data_uri()
        );
        let read = rig(&looks).unwrap();
        assert_eq!(read.check(), Ok(()));
        assert_eq!(read.cameras[0].appearance.overlay.as_deref(), Some(&hood));
        let text = serde_json::to_string(&read).unwrap();
        assert_eq!(serde_json::from_str::<Rig>(&text).unwrap(), read, "{text}");
        let half = read.cameras[0].cropped([50, 0], [50, 80]).unwrap().scaled(25, 40).unwrap();
        assert_eq!(half.appearance.overlay.map(|overlay| overlay.size_px()), Some([25, 40]));
        let zeros = r#""fx":50,"fy":50,"lens":{"model":"opencv","k":[0,0,0,0,0,0]}"#;
        assert!(rig(zeros).unwrap().cameras[0].camera.is_pinhole(), "a pinhole by another name");
        let refused = |more: &str| match rig(more) {
            Err(error) => error.to_string(),
            Ok(rig) => rig.check().unwrap_err().to_string(),
        };
        for (more, reason) in [
            (
                r#""fx":50,"fy":50,"lens":{"model":"fisheye","k":[-9,0,0,0],"max_angle":9}"#,
                "max_angle",
            ),
            (r#""fx":50,"fy":50,"lens":{"model":"opencv","k":[-1e6,0,0,0,0,0]}"#, "folds back"),
            (r#""lens":{"model":"fisheye","k":[0,0,0,0]}"#, "fx is missing"),
            (
                r#""fx":50,"fy":50,"shutter":{"direction":"top_to_bottom","duration_us":0}"#,
                "shutter",
            ),
            (
                r#""fx":50,"fy":50,"windshield":{"reference":"forward","horizontal":[0,1],"vertical":[0]}"#,
                "1, 3, 6",
            ),
            (r#""fx":50,"fy":50,"exposure":{"gain":[1,1,1e9]}"#, "a number from -100 to 100"),
            (r#""fx":50,"fy":50,"overlay":"hood.png""#, "camera \"front\": the overlay cannot be"),
        ] {
            assert!(refused(more).contains(reason), "{}", refused(more));
        }
    }

    #[test]
    fn every_preset_parses_and_checks() {
        for name in Rig::preset_names() {
            let rig = Rig::preset(name).expect(name);
            assert_eq!(rig.name, name);
            assert_eq!(rig.check(), Ok(()));
        }
        assert_eq!(Rig::preset("vehicle7"), None);
    }

    #[test]
    fn the_vehicle_looks_where_its_cameras_are_named() {
        let rig = Rig::preset("vehicle6").unwrap();
        let (sin, cos) = 35_f64.to_radians().sin_cos();
        let looks = [
            ("front", DVec3::X),
            ("front_left", DVec3::new(cos, sin, 0.0)),
            ("front_right", DVec3::new(cos, -sin, 0.0)),
            ("left", DVec3::Y),
            ("right", DVec3::NEG_Y),
            ("rear", DVec3::NEG_X),
        ];
        assert_eq!(rig.cameras.len(), looks.len());
        for (RigCamera { name, rig_from_camera, .. }, (named, forward)) in
            rig.cameras.iter().zip(looks)
        {
            assert_eq!(name, named);
            let axes = rig_from_camera.rotation_matrix();
            assert!((axes.z_axis - forward).length() < 1e-12, "{name} looks along {}", axes.z_axis);
            assert!((axes.y_axis + DVec3::Z).length() < 1e-12, "{name}: down is {}", axes.y_axis);
            assert!((1.5..=2.0).contains(&rig_from_camera.position_m.z), "{name}");
        }
    }

    #[test]
    fn names_are_never_paths() {
        for name in ["front", "a.b-c_9", &"x".repeat(64)] {
            assert!(is_name(name), "{name}");
        }
        for name in ["", ".", "..", ".a", "a/b", "A", "a b", "é", &"x".repeat(65)] {
            assert!(!is_name(name), "{name}");
        }
    }
}
