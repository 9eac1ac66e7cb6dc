//! Rigs: the cameras and LiDARs of a vehicle.

use std::collections::BTreeSet;
use std::sync::Arc;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use wildcity_options as options;
use wildcity_options::strict;

use super::appearance::{Appearance, AppearanceError, Overlay, UnreadOverlay};
use crate::geometry::camera::Shutter;
use crate::geometry::camera::json::Intrinsics;
use crate::geometry::{Camera, CameraError, Lidar, LidarError, Pose, PoseError};

/// A camera mounted on the vehicle.
///
/// JSON in rig files, manifests and recordings is the same as on the wire:
/// [`options::RigCamera`].
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(into = "options::RigCamera")]
pub struct RigCamera {
    /// Name within the rig, `[a-z0-9._-]+`.
    pub name: String,
    /// Size, intrinsics and lens.
    pub camera: Camera,
    /// Pose of the camera on the rig (`camera_to_rig` on the wire).
    pub rig_from_camera: Pose,
    /// Rolling shutter; `None` for a global one.
    pub shutter: Option<Shutter>,
    /// Exposure and overlay of its images.
    pub appearance: Appearance,
}

impl RigCamera {
    /// A camera with a global shutter and without exposure or overlay.
    pub fn new(name: impl Into<String>, camera: Camera, rig_from_camera: Pose) -> Self {
        let appearance = Appearance::default();
        Self { name: name.into(), camera, rig_from_camera, shutter: None, appearance }
    }

    /// The camera whose image is a part of this one's: first column and row, then width and height.
    ///
    /// # Errors
    /// As [`Camera::cropped`].
    pub fn cropped(&self, at_px: [u64; 2], size_px: [u64; 2]) -> Result<Self, RigError> {
        let camera = self.camera.cropped(at_px, size_px).map_err(|cause| self.wrong(cause))?;
        // The part is within the image, so its position fits u32.
        self.part(camera, at_px.map(|at| at as u32), [camera.width_px, camera.height_px])
    }

    /// The camera with the same field of view and a different image size, in pixels.
    ///
    /// # Errors
    /// As [`Camera::scaled`].
    pub fn scaled(&self, width_px: u64, height_px: u64) -> Result<Self, RigError> {
        let camera = self.camera.scaled(width_px, height_px).map_err(|cause| self.wrong(cause))?;
        self.part(camera, [0, 0], [self.camera.width_px, self.camera.height_px])
    }

    /// This camera with other intrinsics, which show a part of the image, and with that part of the
    /// overlay.
    fn part(&self, camera: Camera, at_px: [u32; 2], part_px: [u32; 2]) -> Result<Self, RigError> {
        // A copy; overlays are behind an `Arc`, so that it is cheap.
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

/// The cameras of one vehicle, in the order of the images in an observation, and its LiDARs.
///
/// ```
/// use wildcity_scene::Rig;
///
/// let rig = Rig::preset("vehicle6").expect("a preset");
/// rig.check()?;
/// assert_eq!(rig.cameras.len(), 6);
///
/// let front = rig.cameras[0].scaled(720, 464)?;
/// assert_eq!((front.name.as_str(), front.camera.width_px), ("front", 720));
/// # Ok::<(), wildcity_scene::rig::RigError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Rig {
    /// Name of the rig, `[a-z0-9._-]+`.
    pub name: String,
    /// At least one camera.
    pub cameras: Vec<RigCamera>,
    /// The LiDARs, in the order of the sweeps in an observation: at most [`Rig::MAX_LIDARS`].
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub lidars: Vec<RigLidar>,
}

/// A LiDAR mounted on the vehicle.
///
/// JSON is the same as on the wire: [`options::RigLidar`].
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(into = "options::RigLidar")]
pub struct RigLidar {
    /// Name within the rig, also among the names of its cameras.
    pub name: String,
    /// Its beams and its range, in the LiDAR's axes.
    pub lidar: Arc<Lidar>,
    /// Pose of the LiDAR on the rig (`lidar_to_rig` on the wire).
    pub rig_from_lidar: Pose,
}

/// Why a rig was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigError {
    /// No cameras, or more than [`Rig::MAX_CAMERAS`].
    #[error("rig {rig:?} has {count} cameras; 1 to {limit} are accepted")]
    Count { rig: String, count: usize, limit: usize },
    /// A name is empty, too long, or has other characters than `[a-z0-9._-]`.
    #[error(
        "{name:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    Name { name: String },
    /// Two cameras or LiDARs share a name.
    #[error("{name:?} occurs twice: every camera and LiDAR needs a name of its own")]
    Duplicate { name: String },
    /// More LiDARs than [`Rig::MAX_LIDARS`].
    #[error("rig {rig:?} has {count} LiDARs; at most {limit} are accepted")]
    Lidars { rig: String, count: usize, limit: usize },
    /// The LiDARs have more beams than [`Rig::MAX_BEAMS`] together.
    #[error("the LiDARs of a rig have {beams} beams in all; at most {limit} are accepted")]
    Beams { beams: usize, limit: usize },
    /// The beams of a LiDAR are invalid.
    #[error("LiDAR {name:?}: beams.{cause}")]
    Lidar {
        name: String,
        /// Why it was refused.
        cause: LidarError,
    },
    /// The pose of a LiDAR is invalid.
    #[error("LiDAR {name:?}: lidar_to_rig.{cause}")]
    LidarPose {
        name: String,
        /// Why it was refused.
        cause: PoseError,
    },
    /// The intrinsics or the shutter of a camera are invalid.
    #[error("camera {name:?}: {cause}")]
    Camera {
        name: String,
        /// Why it was refused.
        cause: CameraError,
    },
    /// The exposure or the overlay of a camera is invalid.
    #[error("camera {name:?}: {cause}")]
    Appearance {
        name: String,
        /// Why it was refused.
        cause: AppearanceError,
    },
    /// The pose of a camera is invalid.
    #[error("camera {name:?}: camera_to_rig.{cause}")]
    Pose {
        name: String,
        /// Why it was refused.
        cause: PoseError,
    },
    /// The overlays together would take too much memory.
    #[error("the overlays of a rig have {pixels} pixels in all; at most {limit} are accepted")]
    Overlays {
        /// Pixels of all overlays.
        pixels: u64,
        limit: u64,
    },
}

/// Rigs that are part of the program, by name: the JSON files of `scenes/rigs`.
const PRESETS: [(&str, &str); 5] = [
    ("vehicle6", include_str!("../../scenes/rigs/vehicle6.json")),
    ("vehicle6-lidar", include_str!("../../scenes/rigs/vehicle6-lidar.json")),
    ("surround6", include_str!("../../scenes/rigs/surround6.json")),
    ("alpamayo1", include_str!("../../scenes/rigs/alpamayo1.json")),
    ("alpamayo2", include_str!("../../scenes/rigs/alpamayo2.json")),
];

impl Rig {
    /// Names of the rigs that are part of the program, for [`Rig::preset`].
    pub fn preset_names() -> impl Iterator<Item = &'static str> {
        PRESETS.into_iter().map(|(name, _)| name)
    }

    /// A rig that is part of the program; `None` if no rig has this name.
    pub fn preset(name: &str) -> Option<Self> {
        let (_, json) = PRESETS.into_iter().find(|(preset, _)| *preset == name)?;
        // A test parses every preset, so `ok` cannot hide a broken file as an unknown name.
        serde_json::from_str(json).ok()
    }

    /// Largest number of cameras: the key of the depth sort has 4 bits for the camera.
    pub const MAX_CAMERAS: usize = 16;

    /// Largest number of LiDARs.
    pub const MAX_LIDARS: usize = 4;

    /// Most beams of all LiDARs together: those of one of the largest.
    pub const MAX_BEAMS: usize = Lidar::MAX_ROWS * Lidar::MAX_COLUMNS;

    /// A rig without LiDARs.
    pub fn new(name: impl Into<String>, cameras: Vec<RigCamera>) -> Self {
        Self { name: name.into(), cameras, lidars: Vec::new() }
    }

    /// Checks number, names, intrinsics, shutters and appearances of the cameras, and the names of
    /// LiDARs, whose beams were checked when they were made.
    ///
    /// # Errors
    /// Names the first camera that is invalid.
    pub fn check(&self) -> Result<(), RigError> {
        // The number first: later checks take time per camera, and the limit bounds it.
        check_count(&self.name, self.cameras.len())?;
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
            // Intrinsics before the shutter, and both before the appearance, whose check needs a
            // valid size.
            let shutter = shutter.as_ref().map_or(Ok(()), Shutter::check);
            camera.check().and(shutter).map_err(|cause| mounted.wrong(cause))?;
            let looks = appearance.check([camera.width_px, camera.height_px]);
            looks.map_err(|cause| mounted.looks_wrong(cause))?;
        }
        check_lidar_count(&self.name, self.lidars.len())?;
        for RigLidar { name, .. } in &self.lidars {
            if !is_name(name) {
                return Err(RigError::Name { name: name.clone() });
            }
            if !names.insert(name) {
                return Err(RigError::Duplicate { name: name.clone() });
            }
        }
        let beams = self.lidars.iter().map(|mounted| mounted.lidar.beams()).sum();
        if beams > Self::MAX_BEAMS {
            return Err(RigError::Beams { beams, limit: Self::MAX_BEAMS });
        }
        check_overlays(&self.cameras)
    }
}

fn check_count(rig: &str, count: usize) -> Result<(), RigError> {
    let limit = Rig::MAX_CAMERAS;
    if (1..=limit).contains(&count) {
        Ok(())
    } else {
        Err(RigError::Count { rig: rig.to_owned(), count, limit })
    }
}

fn check_lidar_count(rig: &str, count: usize) -> Result<(), RigError> {
    let limit = Rig::MAX_LIDARS;
    if count <= limit {
        Ok(())
    } else {
        Err(RigError::Lidars { rig: rig.to_owned(), count, limit })
    }
}

/// Checks the size of all overlays of some cameras together.
///
/// # Errors
/// [`RigError::Overlays`].
pub fn check_overlays(cameras: &[RigCamera]) -> Result<(), RigError> {
    let overlays = cameras.iter().filter_map(|camera| camera.appearance.overlay.as_ref());
    check_overlay_pixels(overlays.map(|overlay| overlay.rgba8().len() as u64 / 4).sum())
}

/// Checks a number of pixels against [`Overlay::MAX_PIXELS`].
///
/// # Errors
/// [`RigError::Overlays`].
pub fn check_overlay_pixels(pixels: u64) -> Result<(), RigError> {
    let limit = Overlay::MAX_PIXELS;
    if pixels <= limit { Ok(()) } else { Err(RigError::Overlays { pixels, limit }) }
}

/// Memory of all overlays, in bytes: decoded pixels and PNG files.
pub fn overlay_bytes(cameras: &[RigCamera]) -> u64 {
    let overlays = cameras.iter().filter_map(|camera| camera.appearance.overlay.as_ref());
    overlays.map(|overlay| overlay.bytes()).sum()
}

/// Largest length of a name, in bytes.
pub const MAX_NAME_BYTES: usize = 64;

/// Whether a text is a valid name of a twin, a rig, a camera, a trajectory or a session: 1 to 64 of
/// `a-z 0-9 . _ -`, not starting with a dot. Such a name is safe as a file name and cannot be a
/// path.
pub fn is_name(text: &str) -> bool {
    let allowed = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b"._-".contains(&b);
    // The length in bytes: all allowed characters have one byte.
    (1..=MAX_NAME_BYTES).contains(&text.len())
        // Names are file names; a leading dot would hide the file, and `..` would leave the folder.
        && !text.starts_with('.')
        && text.bytes().all(allowed)
}

/// Why a rig of a request was refused, and where.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{cause}")]
pub struct RigFieldError {
    /// The part of the rig, such as `cameras[2]` or `cameras[2].exposure.gain`.
    pub part: String,
    pub cause: RigError,
}

impl Rig {
    /// The rig of a request, checked.
    ///
    /// # Errors
    /// Names the first part that is invalid.
    pub fn from_request(rig: options::Rig) -> Result<Self, RigFieldError> {
        UnreadRig::from_request(rig)?.decode()
    }
}

/// A rig of a request that was checked, except for the pixels of its overlays. None of them has
/// been decoded: a rig that is refused costs no more than its message.
#[derive(Debug)]
pub struct UnreadRig {
    /// The rig without overlays.
    rig: Rig,
    /// The index of a camera, and its overlay.
    overlays: Vec<(usize, UnreadOverlay)>,
}

impl UnreadRig {
    /// Reads and checks a rig, without the pixels of its overlays.
    ///
    /// # Errors
    /// Names the first part that is invalid.
    pub fn from_request(rig: options::Rig) -> Result<Self, RigFieldError> {
        let at = |part: &str| {
            let part = part.to_owned();
            move |cause| RigFieldError { part, cause }
        };
        // Reads no camera of a rig that has too many; `check` refuses one that has none.
        if rig.cameras.len() > Rig::MAX_CAMERAS {
            check_count(&rig.name, rig.cameras.len()).map_err(at("cameras"))?;
        }
        let mut cameras: Vec<RigCamera> = Vec::new();
        let mut overlays: Vec<(usize, UnreadOverlay)> = Vec::new();
        for (index, fields) in rig.cameras.into_iter().enumerate() {
            let part = format!("cameras[{index}]");
            let (camera, overlay) = RigCamera::from_request(&part, fields)?;
            if cameras.iter().any(|other| other.name == camera.name) {
                let cause = RigError::Duplicate { name: camera.name };
                return Err(RigFieldError { part: format!("{part}.name"), cause });
            }
            cameras.push(camera);
            overlays.extend(overlay.map(|overlay| (index, overlay)));
            let pixels = overlays.iter().map(|(_, overlay)| overlay.pixels()).sum();
            // From the headers alone: a rig with too many pixels is refused before one is decoded.
            check_overlay_pixels(pixels).map_err(at(&format!("{part}.overlay")))?;
        }
        if !is_name(&rig.name) {
            return Err(at("name")(RigError::Name { name: rig.name }));
        }
        check_lidar_count(&rig.name, rig.lidars.len()).map_err(at("lidars"))?;
        let mut lidars: Vec<RigLidar> = Vec::new();
        for (index, fields) in rig.lidars.into_iter().enumerate() {
            let part = format!("lidars[{index}]");
            let lidar = RigLidar::from_request(&part, fields)?;
            let is_taken = cameras.iter().any(|other| other.name == lidar.name)
                || lidars.iter().any(|other| other.name == lidar.name);
            if is_taken {
                let cause = RigError::Duplicate { name: lidar.name };
                return Err(RigFieldError { part: format!("{part}.name"), cause });
            }
            lidars.push(lidar);
        }
        let rig = Rig { name: rig.name, cameras, lidars };
        // Each camera and each LiDAR was checked above; what is left concerns all of them.
        rig.check().map_err(|cause| {
            let part = if matches!(cause, RigError::Beams { .. }) { "lidars" } else { "cameras" };
            RigFieldError { part: part.to_owned(), cause }
        })?;
        Ok(Self { rig, overlays })
    }

    /// The most memory that decoding takes, in bytes.
    pub fn decoding_bytes(&self) -> u64 {
        self.overlays.iter().map(|(_, overlay)| overlay.decoding_bytes()).sum()
    }

    /// The rig with its overlays.
    ///
    /// # Errors
    /// Names the first overlay that cannot be decoded.
    pub fn decode(self) -> Result<Rig, RigFieldError> {
        let Self { mut rig, overlays } = self;
        for (index, overlay) in overlays {
            let camera = &mut rig.cameras[index];
            let decoded = overlay.decode().map_err(|cause| {
                let cause = RigError::Appearance { name: camera.name.clone(), cause };
                RigFieldError { part: format!("cameras[{index}].overlay"), cause }
            })?;
            camera.appearance.overlay = Some(Arc::new(decoded));
        }
        Ok(rig)
    }
}

impl RigCamera {
    /// A camera of a request, checked, and its overlay; `part` names it in errors.
    fn from_request(
        part: &str,
        fields: options::RigCamera,
    ) -> Result<(Self, Option<UnreadOverlay>), RigFieldError> {
        let at = |end: &str, cause| RigFieldError { part: format!("{part}{end}"), cause };
        let name = fields.name.clone();
        if !is_name(&name) {
            return Err(at(".name", RigError::Name { name }));
        }
        let rig_from_camera = Pose::try_from(fields.camera_to_rig)
            .map_err(|cause| at(".camera_to_rig", RigError::Pose { name: name.clone(), cause }))?;
        let refused = |cause| at("", RigError::Camera { name: name.clone(), cause });
        let camera = intrinsics(&fields).camera().map_err(refused)?;
        camera.check().map_err(refused)?;
        let shutter = fields.shutter.map(Shutter::from);
        shutter.as_ref().map_or(Ok(()), Shutter::check).map_err(refused)?;
        // After the check above, which bounds the size of the overlay by that of the image.
        let has_gain = fields.exposure.is_some_and(|exposure| exposure.gain.is_some());
        let size_px = [camera.width_px, camera.height_px];
        let uri = fields.overlay.as_deref();
        let overlay = uri.map(|uri| UnreadOverlay::from_data_uri(uri, size_px)).transpose();
        let (appearance, overlay) = Appearance::new(fields.exposure, None, size_px)
            .and_then(|appearance| appearance.check(size_px).map(|()| appearance))
            // An error of the overlay waits until the exposure has been checked.
            .and_then(|appearance| Ok((appearance, overlay?)))
            .map_err(|cause| {
                let field = match &cause {
                    // A gain stands for a matrix.
                    AppearanceError::Exposure { field: "matrix", .. } if has_gain => {
                        ".exposure.gain".to_owned()
                    }
                    AppearanceError::Exposure { field, .. } => format!(".exposure.{field}"),
                    cause => format!(".{}", cause.field()),
                };
                at(&field, RigError::Appearance { name: name.clone(), cause })
            })?;
        Ok((Self { name, camera, rig_from_camera, shutter, appearance }, overlay))
    }
}

/// Files are read without unknown fields, and refused only if they form no camera at all. Callers
/// that read a rig also call [`Rig::check`], which checks the values and names the camera at fault.
impl<'de> Deserialize<'de> for RigCamera {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let fields: options::RigCamera = strict::deserialize(deserializer)?;
        Self::try_from(fields).map_err(D::Error::custom)
    }
}

impl<'de> Deserialize<'de> for Rig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let fields: options::Rig = strict::deserialize(deserializer)?;
        Self::try_from(fields).map_err(D::Error::custom)
    }
}

/// Counts the cameras first, and stops at the first one whose overlay exceeds the limit, so that no
/// more overlays are decoded than a rig may have.
impl TryFrom<options::Rig> for Rig {
    type Error = RigError;

    fn try_from(
        options::Rig { name, cameras: fields, lidars }: options::Rig,
    ) -> Result<Self, RigError> {
        check_count(&name, fields.len())?;
        check_lidar_count(&name, lidars.len())?;
        let mut cameras = Vec::with_capacity(fields.len());
        for camera in fields {
            cameras.push(camera.try_into()?);
            // After each camera, so that the memory of decoded overlays never exceeds the limit by
            // more than one.
            check_overlays(&cameras)?;
        }
        let lidars = lidars.into_iter().map(RigLidar::try_from).collect::<Result<_, _>>()?;
        Ok(Self { name, cameras, lidars })
    }
}

impl RigLidar {
    /// A LiDAR of a request, checked; `part` names it in errors.
    fn from_request(part: &str, fields: options::RigLidar) -> Result<Self, RigFieldError> {
        let name = fields.name.clone();
        if !is_name(&name) {
            return Err(RigFieldError {
                part: format!("{part}.name"),
                cause: RigError::Name { name },
            });
        }
        Self::try_from(fields).map_err(|cause| {
            let field = match &cause {
                RigError::Lidar { cause, .. } => format!(".beams.{}", cause.field()),
                RigError::LidarPose { .. } => ".lidar_to_rig".to_owned(),
                _ => String::new(),
            };
            RigFieldError { part: format!("{part}{field}"), cause }
        })
    }
}

impl TryFrom<options::RigLidar> for RigLidar {
    type Error = RigError;

    fn try_from(fields: options::RigLidar) -> Result<Self, RigError> {
        let options::RigLidar { name, beams, lidar_to_rig } = fields;
        let lidar = Lidar::from_options(&beams)
            .map_err(|cause| RigError::Lidar { name: name.clone(), cause })?;
        let rig_from_lidar = Pose::try_from(lidar_to_rig)
            .map_err(|cause| RigError::LidarPose { name: name.clone(), cause })?;
        Ok(Self { name, lidar: Arc::new(lidar), rig_from_lidar })
    }
}

impl From<RigLidar> for options::RigLidar {
    fn from(RigLidar { name, lidar, rig_from_lidar }: RigLidar) -> Self {
        Self { name, beams: lidar.to_options(), lidar_to_rig: rig_from_lidar.into() }
    }
}

impl TryFrom<options::RigCamera> for RigCamera {
    type Error = RigError;

    fn try_from(fields: options::RigCamera) -> Result<Self, RigError> {
        let name = fields.name.clone();
        let camera = intrinsics(&fields)
            .camera()
            .map_err(|cause| RigError::Camera { name: name.clone(), cause })?;
        let rig_from_camera = Pose::try_from(fields.camera_to_rig)
            .map_err(|cause| RigError::Pose { name: name.clone(), cause })?;
        // The header of the overlay is compared with the camera's size before a pixel is decoded.
        let size_px = [camera.width_px, camera.height_px];
        let appearance = Appearance::new(fields.exposure, fields.overlay.as_deref(), size_px)
            .map_err(|cause| RigError::Appearance { name: name.clone(), cause })?;
        let shutter = fields.shutter.map(Shutter::from);
        Ok(Self { name, camera, rig_from_camera, shutter, appearance })
    }
}

fn intrinsics(fields: &options::RigCamera) -> Intrinsics {
    Intrinsics {
        // Larger sizes become u32::MAX, which the check of the camera refuses.
        size_px: [fields.width, fields.height].map(|side| u32::try_from(side).unwrap_or(u32::MAX)),
        focal_px: [fields.fx, fields.fy],
        center_px: [fields.cx, fields.cy],
        lens: fields.lens,
        windshield: fields.windshield.clone(),
        native_size_px: fields.native_size,
    }
}

impl From<Rig> for options::Rig {
    fn from(Rig { name, cameras, lidars }: Rig) -> Self {
        Self {
            name,
            cameras: cameras.into_iter().map(Into::into).collect(),
            lidars: lidars.into_iter().map(Into::into).collect(),
        }
    }
}

impl From<RigCamera> for options::RigCamera {
    fn from(from: RigCamera) -> Self {
        let RigCamera { name, camera, rig_from_camera, shutter, appearance } = from;
        let Intrinsics { size_px, focal_px, center_px, lens, windshield, native_size_px } =
            Intrinsics::from_camera(&camera);
        let Appearance { exposure, overlay } = appearance;
        Self {
            name,
            width: size_px[0].into(),
            height: size_px[1].into(),
            fx: focal_px[0],
            fy: focal_px[1],
            cx: center_px[0],
            cy: center_px[1],
            lens,
            windshield,
            shutter: shutter.map(Into::into),
            exposure: exposure.map(Into::into),
            overlay: overlay.map(|overlay| overlay.to_data_uri()),
            native_size: native_size_px,
            camera_to_rig: rig_from_camera.into(),
        }
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
        let rig = |cameras| Rig::new("test", cameras);
        assert_eq!(rig(vec![camera("front"), camera("rear")]).check(), Ok(()));
        let nameless = Rig::new("My car", vec![camera("front")]);
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
        let rig = Rig::new("test", vec![camera("front")]);
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
        let unknown = text.replace("\"q\"", "\"roll\":0.1,\"q\"");
        let refused = serde_json::from_str::<Rig>(&unknown).unwrap_err().to_string();
        assert!(refused.contains("`cameras[0].camera_to_rig.roll`"), "{refused}");
    }

    /// Cameras are counted before any is checked: a file with 100,000 cameras must not cost more
    /// than reading it.
    #[test]
    fn too_many_cameras_are_refused_first() {
        let camera = r#"{"name":"front","width":100,"height":80,"fx":100,"fy":100,"cx":50,"cy":40,
            "overlay":"none","camera_to_rig":{"xyz":[0,0,0],"q":[1,0,0,0]}}"#;
        let rig = |count| {
            format!(r#"{{"name":"test","cameras":[{}]}}"#, [camera].repeat(count).join(","))
        };
        let refused = |count| serde_json::from_str::<Rig>(&rig(count)).unwrap_err().to_string();
        // 16 cameras pass the count, so that the first overlay is read and refused.
        assert!(refused(16).contains("overlay"), "{}", refused(16));
        assert!(refused(100_000).contains("100000 cameras"), "{}", refused(100_000));
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
        // 100 x 80 pixels are 8,000.
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
            // Columns of the matrix are the camera's axes on the rig: z is where it looks, and y is
            // down.
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
