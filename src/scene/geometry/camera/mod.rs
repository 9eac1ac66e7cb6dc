//! Camera models, one file each.
//!
//! A direction in the camera frame is refracted by the windshield, if there is one, and then
//! projected by the lens to a pixel. Each lens has a valid field that ends before the image would
//! fold back; pixels outside of it are not drawn.
//!
//! # Extrapolation beyond the field
//! The projection of a Gaussian needs points of it that may lie outside of the field, where the
//! model folds back or is undefined. There it is continued linearly in the angle
//! ([`Camera::project_extrapolated`]). The limit belongs to the lens and not to the image, so that
//! rendering a part of an image gives the same pixels as the whole, except for images that reach
//! beyond 73° off the axis with a model of slopes (pinhole, OpenCV). These are continued linearly
//! from slope 4, 76° off the axis, or from the farthest corner. With a limit of 8, where slopes
//! rise by 65 per radian, a road below the camera was torn into splats that reached into the image:
//! 42 dB behind a windshield and 28 dB with a shutter that rolls from the right, instead of 47 to
//! 49 dB. Pixels outside of the field are masked in the final image ([`FieldMask`]), since no bound
//! on splats keeps them empty.
//!
//! # Depth
//! Depth is the distance to the camera for lenses that may see 90° and more (fisheye, f-theta),
//! where z is neither an order nor a distance. It is z for pinhole and OpenCV lenses, so that a
//! small distortion changes little.

pub mod field;
pub mod fisheye;
pub mod ftheta;
pub mod json;
pub mod monotone;
pub mod opencv;
pub mod pinhole;
pub mod shutter;
pub mod windshield;

use glam::{DVec2, DVec3};

pub use field::{FieldCone, FieldMask, ScaleWithin};
pub use fisheye::Fisheye;
pub use ftheta::FTheta;
pub use monotone::MonotonePolynomial;
pub use opencv::OpenCv;
pub use pinhole::Pinhole;
pub use shutter::{Shutter, ShutterDirection};
pub use wildcity_options::camera::{FThetaReference, WindshieldReference};
pub use windshield::{Bivariate, Windshield};

/// Upper limit of the field of every lens, in radians off the axis: 160°. Towards 180° a whole ring
/// of pixels shows almost the same direction, so that pixels per radian around the ring grow
/// without bound; at 160° they are three times those along the radius.
pub const WIDEST_RAD: f64 = 2.8;

/// The intrinsics of a camera: an image size and the model that maps directions to pixels.
///
/// Pixel (column, row) covers `[column, column + 1) x [row, row + 1)`; its centre is at +0.5.
///
/// ```
/// use glam::{DVec2, DVec3};
/// use wildcity_scene::geometry::Camera;
/// use wildcity_scene::geometry::camera::Pinhole;
///
/// let pinhole = Pinhole { fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
/// let camera = Camera::checked(640, 480, pinhole)?;
///
/// // 1 m to the right at a depth of 10 m: 500 px / 10 m = 50 px right of the principal point.
/// let point_m = DVec3::new(1.0, 0.0, 10.0);
/// let at_px = camera.project(point_m).expect("in front of the camera");
/// assert_eq!(at_px, DVec2::new(370.0, 240.0));
///
/// let direction = camera.unproject(at_px).expect("a pinhole sees all of its image");
/// assert!((direction - point_m.normalize()).length() < 1e-12);
/// # Ok::<(), wildcity_scene::geometry::CameraError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width, in pixels.
    pub width_px: u32,
    /// Image height, in pixels.
    pub height_px: u32,
    /// Focal lengths at the axis, and the principal point.
    pub pinhole: Pinhole,
    pub lens: Lens,
    /// The windshield in front of the lens.
    pub windshield: Option<Windshield>,
    /// The image's width and height in pixels of the native image, that is, at the size at which
    /// the camera takes images and twins are trained; `None` if that is its own size. An image
    /// below its native size is rendered as the native image shrunk ([`Camera::native_scale`]).
    pub native_size_px: Option<DVec2>,
}

/// How a lens maps the angle off its axis to the image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Lens {
    /// No distortion: the distance from the principal point is proportional to the tangent of the
    /// angle.
    #[default]
    Pinhole,
    /// OpenCV's radial, tangential and thin prism distortion.
    OpenCv(OpenCv),
    Fisheye(Fisheye),
    FTheta(FTheta),
}

/// Why a camera was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A side is zero or above the limit.
    #[error("{field} is {value}; a side is from 1 to {limit} pixels")]
    Size {
        /// The field: `width` or `height`.
        field: &'static str,
        /// The refused value, in pixels.
        value: u64,
        /// The largest accepted side, in pixels.
        limit: u32,
    },
    /// An intrinsic is not a usable number.
    #[error("{field} is {value:?}; {must}")]
    Intrinsic {
        /// `fx`, `lens.k`, `windshield` and so on.
        field: &'static str,
        value: f64,
        /// The values that are accepted.
        must: &'static str,
    },
    /// A focal length is missing.
    #[error("{field} is missing; only an f-theta lens takes its focal lengths from its polynomial")]
    Missing {
        /// The field: `fx` or `fy`.
        field: &'static str,
    },
    /// A crop is not within the image.
    #[error(
        "crop is {left}, {top}, {width} x {height} px; it must lie within the image of {of_width} x {of_height} px"
    )]
    Crop {
        /// First column, in pixels.
        left: u64,
        top: u64,
        width: u64,
        height: u64,
        /// Width of the image, in pixels.
        of_width: u32,
        /// Height of the image, in pixels.
        of_height: u32,
    },
}

impl CameraError {
    /// The field at fault, by its name in camera files and on the wire.
    pub fn field(&self) -> &'static str {
        match self {
            Self::Size { field, .. } | Self::Intrinsic { field, .. } | Self::Missing { field } => {
                field
            }
            Self::Crop { .. } => "crop",
        }
    }
}

impl Camera {
    /// Largest accepted width or height, in pixels: enough for 16 K panoramas, and tile coordinates
    /// fit 16 bits.
    pub const MAX_SIDE_PX: u32 = 16_384;

    /// Smallest accepted share of the image that is within the lens' field.
    const LEAST_SHARE: f64 = 0.125;

    /// A pinhole camera, not checked.
    pub fn from_pinhole(width_px: u32, height_px: u32, pinhole: Pinhole) -> Self {
        let lens = Lens::Pinhole;
        Self { width_px, height_px, pinhole, lens, windshield: None, native_size_px: None }
    }

    /// A pinhole camera from untrusted input, all in pixels.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    pub fn checked(width_px: u64, height_px: u64, pinhole: Pinhole) -> Result<Self, CameraError> {
        let [width_px, height_px] = sides(width_px, height_px)?;
        let camera = Self::from_pinhole(width_px, height_px, pinhole);
        camera.check()?;
        Ok(camera)
    }

    /// Checks size, intrinsics, lens and windshield.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    pub fn check(&self) -> Result<(), CameraError> {
        sides(self.width_px.into(), self.height_px.into())?;
        self.pinhole.check()?;
        // The lens first: below, `unproject` needs a usable one.
        match &self.lens {
            Lens::Pinhole => {}
            Lens::OpenCv(lens) => lens.check()?,
            Lens::Fisheye(lens) => lens.check()?,
            Lens::FTheta(lens) => {
                lens.check()?;
                self.check_focal_px(lens)?;
            }
        }
        if let Some(windshield) = &self.windshield {
            // Only rays that reach the image count, so that a polynomial may be useless beyond the
            // corners.
            windshield.check(self.corner_rad())?;
        }
        for value in self.native_size_px.map_or([1.0; 2], |size| size.to_array()) {
            let in_range = value > 0.0 && value <= f64::from(Self::MAX_SIDE_PX);
            if !in_range {
                let must = "a side is above 0 and at most 16384 pixels";
                return Err(CameraError::Intrinsic { field: "native_size", value, must });
            }
        }
        if self.lens != Lens::Pinhole {
            // Sample the centres of a grid of 16 x 16 parts of the image.
            let part = |i: u32| (f64::from(i) + 0.5) / 16.0;
            let at = |i: u32| DVec2::new(part(i % 16), part(i / 16)) * self.size_px();
            let seen = (0..256).filter(|&i| self.unproject(at(i)).is_some()).count();
            let value = seen as f64 / 256.0;
            if value < Self::LEAST_SHARE {
                let field = match &self.lens {
                    Lens::OpenCv(lens) => lens.at_fault(),
                    _ => "lens",
                };
                let must = "the lens sees at least an eighth of its image";
                return Err(CameraError::Intrinsic { field, value, must });
            }
        }
        Ok(())
    }

    /// Number of pixels of the image.
    pub fn pixels(&self) -> usize {
        self.width_px as usize * self.height_px as usize
    }

    /// Whether this is a pinhole without a windshield.
    pub fn is_pinhole(&self) -> bool {
        self.lens == Lens::Pinhole && self.windshield.is_none()
    }

    /// Projects a camera-space point, in metres, to pixels, possibly outside of the image. `None`
    /// outside of the valid field.
    pub fn project(&self, point_m: DVec3) -> Option<DVec2> {
        let inside = self.inside(point_m);
        let off_axis = inside.truncate().length();
        let seen = match &self.lens {
            // A pinhole has no limit but its own plane.
            Lens::Pinhole if inside.z > 0.0 => return Some(self.pinhole.project(inside)),
            Lens::Pinhole => false,
            // Slopes without a division: off <= limit z, for z above 0.
            Lens::OpenCv(lens) => inside.z > 0.0 && off_axis <= lens.limit_slope() * inside.z,
            Lens::Fisheye(lens) => off_axis.atan2(inside.z) <= lens.limit_rad(),
            Lens::FTheta(lens) => off_axis.atan2(inside.z) <= lens.limit_rad(),
        };
        // Within the field nothing is extrapolated; the largest slope turns that branch off.
        seen.then(|| self.land(inside, OpenCv::MOST_SLOPE))
    }

    /// Projects a camera-space point, in metres, to pixels. Beyond its field the model is continued
    /// linearly in the angle, at the rate that it has at the limit. Used for the shape of Gaussians
    /// that reach into the field from outside.
    #[inline(always)]
    pub fn project_extrapolated(&self, point_m: DVec3) -> DVec2 {
        self.land(self.inside(point_m), self.extrapolation_slope())
    }

    /// The slope (tangent of the angle off the axis) from which pinhole and OpenCV lenses are
    /// extrapolated linearly in the angle: 4, 76° off the axis, or the slope of the farthest corner
    /// of the image if that is larger, at most 8.
    ///
    /// The slope's derivative by the angle is `1 + slope²`. With a limit of 8, geometry far off the
    /// axis, such as the road below the camera, was torn into splats of some hundred pixels that
    /// reached into the image. With 4 none did.
    #[inline(always)]
    pub fn extrapolation_slope(&self) -> f64 {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let center_px = DVec2::new(cx, cy);
        let most_px = center_px.abs().max((self.size_px() - center_px).abs());
        let corner = (most_px / DVec2::new(fx, fy)).length();
        // A lens may shrink slopes to 0.8 of the ray's: the corner's ray is at most 1 / 0.8 as
        // steep as its pixel.
        (corner / OpenCv::LEAST_FACTOR).clamp(4.0, OpenCv::MOST_SLOPE)
    }

    /// The unit direction in the camera frame that projects to an image position, in pixels. `None`
    /// outside of the valid field.
    pub fn unproject(&self, at_px: DVec2) -> Option<DVec3> {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let offset_px = at_px - DVec2::new(cx, cy);
        let plane = offset_px / DVec2::new(fx, fy);
        let inside = match &self.lens {
            Lens::Pinhole => Some(plane.extend(1.0).normalize()),
            Lens::OpenCv(lens) => lens.direction(plane),
            Lens::Fisheye(lens) => lens.direction(plane),
            // An f-theta lens has its focal length in the polynomial, so that it takes pixels.
            Lens::FTheta(lens) => lens.direction(offset_px),
        };
        // Outwards, rays pass the lens before the windshield: the inverse order of `project`.
        inside.map(|inside| match &self.windshield {
            None => inside,
            Some(windshield) => windshield.outside(inside),
        })
    }

    /// Depth of a camera-space point, in metres: its distance for lenses that may see 90° and more
    /// (fisheye, f-theta), its z for all others.
    #[inline(always)]
    pub fn depth_m(&self, point_m: DVec3) -> f64 {
        if self.depth_is_distance() { point_m.length() } else { point_m.z }
    }

    /// Whether depth is the distance to the camera, and not z.
    #[inline(always)]
    pub fn depth_is_distance(&self) -> bool {
        matches!(self.lens, Lens::Fisheye(_) | Lens::FTheta(_))
    }

    /// Limit of the lens' field, in radians off the axis.
    pub fn limit_rad(&self) -> f64 {
        match &self.lens {
            Lens::Pinhole => std::f64::consts::FRAC_PI_2,
            Lens::OpenCv(lens) => lens.limit_slope().atan(),
            Lens::Fisheye(lens) => lens.limit_rad(),
            Lens::FTheta(lens) => lens.limit_rad(),
        }
    }

    /// Width and height of the image, in pixels.
    pub fn size_px(&self) -> DVec2 {
        DVec2::new(f64::from(self.width_px), f64::from(self.height_px))
    }

    /// Sides of the image as shares of those of the native image, at most 1: an image that is
    /// larger than the native one is rendered like a native one.
    pub fn native_scale(&self) -> DVec2 {
        let native_px = self.native_size_px.unwrap_or(self.size_px());
        (self.size_px() / native_px).min(DVec2::ONE)
    }

    /// The camera with the same field of view and a different image size, in pixels. The native
    /// size stays what it was.
    ///
    /// # Errors
    /// The size or the scaled intrinsics are out of range.
    pub fn scaled(&self, width_px: u64, height_px: u64) -> Result<Self, CameraError> {
        let [width_px, height_px] = sides(width_px, height_px)?;
        let scale = DVec2::new(f64::from(width_px), f64::from(height_px)) / self.size_px();
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let mut pinhole =
            Pinhole { fx: fx * scale.x, fy: fy * scale.y, cx: cx * scale.x, cy: cy * scale.y };
        // Lenses of slopes and angles work in focal lengths and do not change with the size; only
        // f-theta works in pixels.
        let mut lens = self.lens;
        if let Lens::FTheta(ftheta) = &mut lens {
            *ftheta = ftheta.scaled(scale);
            (pinhole.fx, pinhole.fy) = ftheta.focal_px().into();
        }
        let mut scaled = Self { width_px, height_px, pinhole, lens, ..*self };
        // The first scaling records the native size, later ones keep it. An image that is back at
        // its native size has none.
        let native_px = self.native_size_px.unwrap_or(self.size_px());
        scaled.native_size_px = (native_px != scaled.size_px()).then_some(native_px);
        scaled.check()?;
        Ok(scaled)
    }

    /// The camera whose image is a part of this one's: first column and row, then width and height.
    ///
    /// # Errors
    /// The part is not within the image, or too little of it is within the lens' field.
    pub fn cropped(&self, at_px: [u64; 2], size_px: [u64; 2]) -> Result<Self, CameraError> {
        let [left, top] = at_px;
        let [width, height] = size_px;
        let [width_px, height_px] = sides(width, height)?;
        let of_width = self.width_px;
        let of_height = self.height_px;
        // Compared after the subtraction, with `min` against an underflow: `left + width` of
        // untrusted numbers could overflow.
        let within = left <= u64::from(of_width - width_px.min(of_width))
            && top <= u64::from(of_height - height_px.min(of_height))
            && width_px <= of_width
            && height_px <= of_height;
        if !within {
            return Err(CameraError::Crop { left, top, width, height, of_width, of_height });
        }
        // Cutting only moves the principal point: the lens and its field stay what they are.
        let mut cropped = Self { width_px, height_px, ..*self };
        cropped.pinhole.cx -= left as f64;
        cropped.pinhole.cy -= top as f64;
        cropped.native_size_px =
            // A part has the same scale as the whole: its native size is the same part of the
            // native image.
            self.native_size_px.map(|native_px| native_px * (cropped.size_px() / self.size_px()));
        cropped.check()?;
        Ok(cropped)
    }

    /// The direction behind the windshield: the one that reaches the lens.
    #[inline(always)]
    fn inside(&self, point_m: DVec3) -> DVec3 {
        match &self.windshield {
            None => point_m,
            Some(windshield) => windshield.inside(point_m),
        }
    }

    /// Projects a direction behind the windshield to pixels. Models of slopes are extrapolated
    /// linearly in the angle from slope `straight` on.
    #[inline(always)]
    fn land(&self, inside: DVec3, straight: f64) -> DVec2 {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let focal_px = DVec2::new(fx, fy);
        let center_px = DVec2::new(cx, cy);
        match &self.lens {
            Lens::Pinhole => center_px + focal_px * Pinhole::extrapolated_slope(inside, straight),
            Lens::OpenCv(lens) => center_px + focal_px * lens.plane(inside, straight),
            Lens::Fisheye(lens) => center_px + focal_px * lens.plane(inside),
            Lens::FTheta(lens) => center_px + lens.offset_px(inside),
        }
    }

    /// The largest angle off the axis of the image's corners behind the windshield, in radians.
    /// Corners outside of the lens' field count with the limit of the field.
    pub fn corner_rad(&self) -> f64 {
        // Corners behind the windshield: the one that is checked may not be invertible yet.
        let bare = Self { windshield: None, ..*self };
        let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
        let angles_rad = corners.map(|corner| {
            let ray = bare.unproject(DVec2::from(corner) * self.size_px());
            ray.map_or(self.limit_rad(), |ray| ray.truncate().length().atan2(ray.z))
        });
        angles_rad.into_iter().fold(0.0, f64::max)
    }

    /// The focal lengths of an f-theta lens follow from its polynomial; given ones must agree with
    /// these.
    fn check_focal_px(&self, lens: &FTheta) -> Result<(), CameraError> {
        let DVec2 { x, y } = lens.focal_px();
        for (field, value, derived) in [("fx", self.pinhole.fx, x), ("fy", self.pinhole.fy, y)] {
            // Relative, because the values may have been written with few digits.
            let agrees = (value - derived).abs() <= 1e-6 * derived;
            if !agrees {
                let must =
                    "an f-theta lens takes its focal lengths from its polynomial: omit fx and fy";
                return Err(CameraError::Intrinsic { field, value, must });
            }
        }
        Ok(())
    }
}

impl Lens {
    /// An OpenCV lens, or a pinhole if all coefficients are zero, so that it takes the faster path.
    pub fn opencv(lens: OpenCv) -> Self {
        if lens.is_pinhole() { Self::Pinhole } else { Self::OpenCv(lens) }
    }
}

fn sides(width: u64, height: u64) -> Result<[u32; 2], CameraError> {
    let limit = Camera::MAX_SIDE_PX;
    let side = |field, value| match u32::try_from(value) {
        Ok(side) if (1..=limit).contains(&side) => Ok(side),
        _ => Err(CameraError::Size { field, value, limit }),
    };
    Ok([side("width", width)?, side("height", height)?])
}

/// Largest accepted magnitude of a coefficient. Calibrations in pixels reach 1e5; larger is a
/// mistake.
const MAX_COEFFICIENT: f64 = 1e9;

fn check_numbers(field: &'static str, numbers: &[f64]) -> Result<(), CameraError> {
    let usable = |value: &f64| value.is_finite() && value.abs() <= MAX_COEFFICIENT;
    match numbers.iter().copied().find(|value| !usable(value)) {
        None => Ok(()),
        Some(value) => {
            Err(CameraError::Intrinsic { field, value, must: "a coefficient is finite, up to 1e9" })
        }
    }
}

fn check_max_angle(max_angle_rad: Option<f64>) -> Result<(), CameraError> {
    let usable = |value: f64| value > 0.0 && value <= WIDEST_RAD;
    match max_angle_rad.filter(|&value| !usable(value)) {
        None => Ok(()),
        Some(value) => {
            let must = "a field is above 0, up to 2.8 rad off the axis";
            Err(CameraError::Intrinsic { field: "lens.max_angle", value, must })
        }
    }
}

/// Smallest accepted field, in radians off the axis. A smaller one means a polynomial that falls
/// from the start.
const LEAST_FIELD_RAD: f64 = 1e-3;

fn check_field(field: &'static str, value: f64) -> Result<(), CameraError> {
    let usable = value >= LEAST_FIELD_RAD;
    if usable {
        return Ok(());
    }
    let must = "rad off the axis is all that its coefficients give before the image folds back or is torn; \
                at least 0.001 rad are needed";
    Err(CameraError::Intrinsic { field, value, must })
}
