//! JSON of lenses and windshields in rig files and camera lists.
//!
//! ```text
//! {"model": "opencv", "k": [k1, .. k6], "p": [p1, p2], "s": [s1, .. s4]}
//! {"model": "fisheye", "k": [k1, .. k4], "max_angle": radians}
//! {"model": "ftheta", "reference": "angle_to_pixel", "polynomial": [c0, .. c5],
//!  "linear_cde": [c, d, e], "max_angle": radians}
//! {"reference": "forward", "horizontal": [..], "vertical": [..]}
//! ```

use glam::DVec2;

use super::{Bivariate, Camera, CameraError, FTheta, Fisheye, Lens, OpenCv, Pinhole, Windshield};

pub use wildcity_options::camera::{Lens as LensFields, Windshield as WindshieldFields};

/// The intrinsics of a camera as JSON holds them.
#[derive(Clone, Debug, PartialEq)]
pub struct Intrinsics {
    /// Width and height, in pixels.
    pub size_px: [u32; 2],
    /// Focal lengths x and y, in pixels. `None` for an f-theta lens, whose polynomial defines them.
    pub focal_px: [Option<f64>; 2],
    /// Principal point, in pixels.
    pub center_px: [f64; 2],
    /// The lens; `None` for a pinhole.
    pub lens: Option<LensFields>,
    /// The windshield in front of the lens.
    pub windshield: Option<WindshieldFields>,
    /// Width and height in native pixels; `None` for an image of native size.
    pub native_size_px: Option<[f64; 2]>,
}

impl Intrinsics {
    /// The camera with these intrinsics. The caller checks it with [`Camera::check`].
    ///
    /// # Errors
    /// A focal length is missing, or the number of a windshield's coefficients fits no polynomial.
    pub fn camera(&self) -> Result<Camera, CameraError> {
        // No lens in the file is a pinhole, the default of `Lens`.
        let lens = self.lens.as_ref().map(lens_from).unwrap_or_default();
        // Only this model knows its focal lengths. Given ones are kept here, and `Camera::check`
        // compares them.
        let own = match &lens {
            Lens::FTheta(lens) => Some(lens.focal_px()),
            _ => None,
        };
        let focal = |field, axis: usize| {
            let given = self.focal_px[axis].or(own.map(|own| own[axis]));
            given.ok_or(CameraError::Missing { field })
        };
        let [cx, cy] = self.center_px;
        let pinhole = Pinhole { fx: focal("fx", 0)?, fy: focal("fy", 1)?, cx, cy };
        let windshield = self.windshield.as_ref().map(windshield_from).transpose()?;
        let [width_px, height_px] = self.size_px;
        let native_size_px = self.native_size_px.map(DVec2::from_array);
        Ok(Camera { width_px, height_px, pinhole, lens, windshield, native_size_px })
    }

    /// The intrinsics of a camera.
    pub fn from_camera(camera: &Camera) -> Self {
        let Pinhole { fx, fy, cx, cy } = camera.pinhole;
        Self {
            size_px: [camera.width_px, camera.height_px],
            focal_px: [Some(fx), Some(fy)],
            center_px: [cx, cy],
            lens: fields_of_lens(&camera.lens),
            windshield: camera.windshield.as_ref().map(fields_of_windshield),
            native_size_px: camera.native_size_px.map(|size_px| size_px.to_array()),
        }
    }
}

fn lens_from(fields: &LensFields) -> Lens {
    match *fields {
        LensFields::Opencv { k, p, s } => Lens::opencv(OpenCv::new(k, p, s)),
        LensFields::Fisheye { k, max_angle } => Lens::Fisheye(Fisheye::new(k, max_angle)),
        LensFields::Ftheta { reference, polynomial, linear_cde, max_angle } => {
            Lens::FTheta(FTheta::new(reference, polynomial, linear_cde, max_angle))
        }
    }
}

fn fields_of_lens(lens: &Lens) -> Option<LensFields> {
    Some(match lens {
        Lens::Pinhole => return None,
        Lens::OpenCv(lens) => LensFields::Opencv { k: lens.k(), p: lens.p(), s: lens.s() },
        Lens::Fisheye(lens) => LensFields::Fisheye { k: lens.k(), max_angle: lens.max_angle_rad() },
        Lens::FTheta(lens) => LensFields::Ftheta {
            reference: lens.reference(),
            polynomial: lens.polynomial(),
            linear_cde: lens.linear_cde(),
            max_angle: lens.max_angle_rad(),
        },
    })
}

fn windshield_from(fields: &WindshieldFields) -> Result<Windshield, CameraError> {
    let horizontal = Bivariate::new("windshield.horizontal", &fields.horizontal)?;
    let vertical = Bivariate::new("windshield.vertical", &fields.vertical)?;
    Ok(Windshield::new(fields.reference, horizontal, vertical))
}

fn fields_of_windshield(windshield: &Windshield) -> WindshieldFields {
    WindshieldFields {
        reference: windshield.reference(),
        horizontal: windshield.horizontal().coefficients().to_vec(),
        vertical: windshield.vertical().coefficients().to_vec(),
    }
}
