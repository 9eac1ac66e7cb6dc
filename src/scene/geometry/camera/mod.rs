//! Camera models: one file each.
//!
//! A direction in the camera's frame goes through the windshield, if there is one, then through the
//! lens, and lands on a pixel. What a lens does not see is not drawn: every model has a valid field
//! that ends before the image would fold back, and nothing outside of it is ever projected.

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

pub use field::{FieldCone, FieldMask};
pub use fisheye::Fisheye;
pub use ftheta::{FTheta, FThetaReference};
pub use monotone::MonotonePolynomial;
pub use opencv::OpenCv;
pub use pinhole::Pinhole;
pub use shutter::{Shutter, ShutterDirection};
pub use windshield::{Bivariate, Windshield, WindshieldReference};

/// The widest field of any lens, in radians off the axis: 160°. Where all directions but one land on a
/// ring, pixels per radian across the ring grow beyond all bounds; at 160° they are three times those
/// along it.
pub const WIDEST_RAD: f64 = 2.8;

/// An image size and the model that maps camera rays to its pixels.
///
/// Pixel (column, row) covers `[column, column + 1) x [row, row + 1)`; its centre is at +0.5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width, in pixels.
    pub width_px: u32,
    /// Image height, in pixels.
    pub height_px: u32,
    /// Focal lengths at the axis, and where the axis lands.
    pub pinhole: Pinhole,
    /// What the lens does otherwise than a pinhole.
    pub lens: Lens,
    /// What stands before the lens.
    pub windshield: Option<Windshield>,
}

/// How a lens maps the angle off its axis to the image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Lens {
    /// By its tangent: straight lines stay straight.
    #[default]
    Pinhole,
    /// OpenCV's radial, tangential and thin prism distortion.
    OpenCv(OpenCv),
    /// OpenCV's fisheye.
    Fisheye(Fisheye),
    /// NVIDIA's f-theta.
    FTheta(FTheta),
}

/// Why a camera was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A side is zero or above the limit.
    #[error("{field} is {value}; a side is from 1 to {limit} pixels")]
    Size {
        /// `width` or `height`.
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
        /// The refused value.
        value: f64,
        /// What must hold instead.
        must: &'static str,
    },
    /// An intrinsic is not there.
    #[error("{field} is missing; only an f-theta lens has its focal lengths from its polynomial")]
    Missing {
        /// `fx` or `fy`.
        field: &'static str,
    },
    /// A part of an image does not lie within it.
    #[error(
        "crop is {left}, {top}, {width} x {height} px; it must lie within the image of {of_width} x {of_height} px"
    )]
    Crop {
        /// First column, in pixels.
        left: u64,
        /// First row.
        top: u64,
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
        /// Columns that there are.
        of_width: u32,
        /// Rows that there are.
        of_height: u32,
    },
}

impl CameraError {
    /// The field at fault, as it is called in camera files and on the wire.
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
    /// The largest accepted side, in pixels: 16 K panoramas, and 16-bit tile coordinates suffice.
    pub const MAX_SIDE_PX: u32 = 16_384;

    /// Least share of an image that its lens must see.
    const LEAST_SHARE: f64 = 0.125;

    /// A pinhole camera of these pixels, as it is.
    pub fn from_pinhole(width_px: u32, height_px: u32, pinhole: Pinhole) -> Self {
        Self { width_px, height_px, pinhole, lens: Lens::Pinhole, windshield: None }
    }

    /// A pinhole camera from outside, all in pixels.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    pub fn checked(width_px: u64, height_px: u64, pinhole: Pinhole) -> Result<Self, CameraError> {
        let [width_px, height_px] = sides(width_px, height_px)?;
        let camera = Self::from_pinhole(width_px, height_px, pinhole);
        camera.check()?;
        Ok(camera)
    }

    /// # Errors
    /// Names the first field that cannot be used.
    pub fn check(&self) -> Result<(), CameraError> {
        sides(self.width_px.into(), self.height_px.into())?;
        self.pinhole.check()?;
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
            windshield.check(self.corner_rad())?;
        }
        if self.lens != Lens::Pinhole {
            // Middles of 16 x 16 parts.
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

    /// Pixels in the image.
    pub fn pixels(&self) -> usize {
        self.width_px as usize * self.height_px as usize
    }

    /// Whether it is a pinhole and nothing else.
    pub fn is_pinhole(&self) -> bool {
        self.lens == Lens::Pinhole && self.windshield.is_none()
    }

    /// Where a camera-space point lands, in pixels, on the image or beside it; `None` outside of the
    /// valid field.
    pub fn project(&self, point_m: DVec3) -> Option<DVec2> {
        let inside = self.inside(point_m);
        let off_axis = inside.truncate().length();
        let seen = match &self.lens {
            Lens::Pinhole if inside.z > 0.0 => return Some(self.pinhole.project(inside)),
            Lens::Pinhole => false,
            Lens::OpenCv(lens) => inside.z > 0.0 && off_axis <= lens.limit_slope() * inside.z,
            Lens::Fisheye(lens) => off_axis.atan2(inside.z) <= lens.limit_rad(),
            Lens::FTheta(lens) => off_axis.atan2(inside.z) <= lens.limit_rad(),
        };
        seen.then(|| self.land(inside, OpenCv::MOST_SLOPE))
    }

    /// Where a camera-space point lands if the model is continued beyond its field: at the same rate
    /// in the angle as at its end. For the shape of what reaches into the field from beyond.
    #[inline(always)]
    pub fn project_extrapolated(&self, point_m: DVec3) -> DVec2 {
        self.land(self.inside(point_m), self.extrapolation_slope())
    }

    /// The slope from which pinholes and OpenCV's lenses are continued straight in the angle: 4, 76° off the
    /// axis, or where the farthest corner of the image is, but never beyond 8.
    ///
    /// A slope grows with the square of its own per radian: at 8, what lies beside the camera, a road below
    /// it, is torn into splats of some hundred pixels that reach into the image. At 4 none did.
    #[inline(always)]
    pub fn extrapolation_slope(&self) -> f64 {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let center_px = DVec2::new(cx, cy);
        let most_px = center_px.abs().max((self.size_px() - center_px).abs());
        let corner = (most_px / DVec2::new(fx, fy)).length();
        (corner / OpenCv::LEAST_FACTOR).clamp(4.0, OpenCv::MOST_SLOPE)
    }

    /// The unit direction in the camera's frame that lands on a place of the image, in pixels; `None`
    /// outside of the valid field.
    pub fn unproject(&self, at_px: DVec2) -> Option<DVec3> {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let offset_px = at_px - DVec2::new(cx, cy);
        let plane = offset_px / DVec2::new(fx, fy);
        let inside = match &self.lens {
            Lens::Pinhole => Some(plane.extend(1.0).normalize()),
            Lens::OpenCv(lens) => lens.direction(plane),
            Lens::Fisheye(lens) => lens.direction(plane),
            Lens::FTheta(lens) => lens.direction(offset_px),
        };
        inside.map(|inside| match &self.windshield {
            None => inside,
            Some(windshield) => windshield.outside(inside),
        })
    }

    /// What is called depth of a camera-space point, in metres: its z where the field is that of a
    /// pinhole, its distance where there may be something at 90° and beyond.
    #[inline(always)]
    pub fn depth_m(&self, point_m: DVec3) -> f64 {
        if self.depth_is_distance() { point_m.length() } else { point_m.z }
    }

    /// Whether depth is distance.
    #[inline(always)]
    pub fn depth_is_distance(&self) -> bool {
        matches!(self.lens, Lens::Fisheye(_) | Lens::FTheta(_))
    }

    /// How far off the axis the lens sees, in radians.
    pub fn limit_rad(&self) -> f64 {
        match &self.lens {
            Lens::Pinhole => std::f64::consts::FRAC_PI_2,
            Lens::OpenCv(lens) => lens.limit_slope().atan(),
            Lens::Fisheye(lens) => lens.limit_rad(),
            Lens::FTheta(lens) => lens.limit_rad(),
        }
    }

    /// Width and height, in pixels.
    pub fn size_px(&self) -> DVec2 {
        DVec2::new(f64::from(self.width_px), f64::from(self.height_px))
    }

    /// The same view in an image of another size.
    ///
    /// # Errors
    /// The size, or what it makes of the intrinsics, cannot be used.
    pub fn scaled(&self, width_px: u64, height_px: u64) -> Result<Self, CameraError> {
        let [width_px, height_px] = sides(width_px, height_px)?;
        let scale = DVec2::new(f64::from(width_px), f64::from(height_px)) / self.size_px();
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let mut pinhole =
            Pinhole { fx: fx * scale.x, fy: fy * scale.y, cx: cx * scale.x, cy: cy * scale.y };
        let mut lens = self.lens;
        if let Lens::FTheta(ftheta) = &mut lens {
            *ftheta = ftheta.scaled(scale);
            (pinhole.fx, pinhole.fy) = ftheta.focal_px().into();
        }
        let scaled = Self { width_px, height_px, pinhole, lens, ..*self };
        scaled.check()?;
        Ok(scaled)
    }

    /// A part of the image, from a column and a row on.
    ///
    /// # Errors
    /// It is not within the image, or the lens does not see it.
    pub fn cropped(
        &self,
        [left, top]: [u64; 2],
        [width, height]: [u64; 2],
    ) -> Result<Self, CameraError> {
        let [width_px, height_px] = sides(width, height)?;
        let (of_width, of_height) = (self.width_px, self.height_px);
        let within = left <= u64::from(of_width - width_px.min(of_width))
            && top <= u64::from(of_height - height_px.min(of_height))
            && width_px <= of_width
            && height_px <= of_height;
        if !within {
            return Err(CameraError::Crop { left, top, width, height, of_width, of_height });
        }
        let mut cropped = Self { width_px, height_px, ..*self };
        cropped.pinhole.cx -= left as f64;
        cropped.pinhole.cy -= top as f64;
        cropped.check()?;
        Ok(cropped)
    }

    /// The direction behind the windshield.
    #[inline(always)]
    fn inside(&self, point_m: DVec3) -> DVec3 {
        match &self.windshield {
            None => point_m,
            Some(windshield) => windshield.inside(point_m),
        }
    }

    /// Where a direction behind the windshield lands; what has slopes goes on straight from one on.
    #[inline(always)]
    fn land(&self, inside: DVec3, straight: f64) -> DVec2 {
        let Pinhole { fx, fy, cx, cy } = self.pinhole;
        let (focal_px, center_px) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
        match &self.lens {
            Lens::Pinhole => center_px + focal_px * Pinhole::extrapolated_slope(inside, straight),
            Lens::OpenCv(lens) => center_px + focal_px * lens.plane(inside, straight),
            Lens::Fisheye(lens) => center_px + focal_px * lens.plane(inside),
            Lens::FTheta(lens) => center_px + lens.offset_px(inside),
        }
    }

    /// How far off the axis the corners of the image look behind the windshield, in radians: as far as the
    /// lens sees, where it does not see them.
    pub fn corner_rad(&self) -> f64 {
        let bare = Self { windshield: None, ..*self };
        let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
        let angles_rad = corners.map(|corner| {
            let ray = bare.unproject(DVec2::from(corner) * self.size_px());
            ray.map_or(self.limit_rad(), |ray| ray.truncate().length().atan2(ray.z))
        });
        angles_rad.into_iter().fold(0.0, f64::max)
    }

    /// An f-theta lens has its focal lengths from its polynomial; what else is said must agree.
    fn check_focal_px(&self, lens: &FTheta) -> Result<(), CameraError> {
        let DVec2 { x, y } = lens.focal_px();
        for (field, value, derived) in [("fx", self.pinhole.fx, x), ("fy", self.pinhole.fy, y)] {
            let agrees = (value - derived).abs() <= 1e-6 * derived;
            if !agrees {
                let must = "an f-theta lens has its focal lengths from its polynomial: leave fx and fy out";
                return Err(CameraError::Intrinsic { field, value, must });
            }
        }
        Ok(())
    }
}

impl Lens {
    /// OpenCV's model; a pinhole where all coefficients are zero, so that it is drawn as one.
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

/// Coefficients beyond this are mistakes: a calibration in pixels has 1e5.
const MOST: f64 = 1e9;

fn check_numbers(field: &'static str, numbers: &[f64]) -> Result<(), CameraError> {
    let usable = |value: &f64| value.is_finite() && value.abs() <= MOST;
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

/// A lens that sees less than this, in radians off its axis, has a polynomial that falls from the start.
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
