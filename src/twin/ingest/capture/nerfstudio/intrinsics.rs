//! Cameras of transforms.json, by the formulas of the programs that train from it.
//!
//! nerfstudio (cameras/camera_utils.py, data/dataparsers/nerfstudio_dataparser.py): lenses of
//! perspective models are `(x, y) (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸)` and OpenCV's tangential
//! terms p1, p2; those of fisheye models are OpenCV's `fisheye`, with the same tangential terms. A
//! frame or the file may have `distortion_params` in their place: k1 to k4, p1, p2. instant-ngp
//! (src/nerf_loader.cu, read_lens): OpenCV's lens, or with `is_fisheye` OpenCV's `fisheye`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, Pinhole};

/// Fields of a camera, by their names in the file.
#[derive(Clone, Default, Deserialize)]
#[serde(transparent)]
pub(super) struct Intrinsics(BTreeMap<String, Value>);

/// A field that cannot be used.
pub(super) struct Wrong {
    pub(super) field: &'static str,
    pub(super) reason: String,
}

/// Models of nerfstudio with a pinhole or OpenCV's lens. `perspective` is of exporters of
/// simulators.
const PERSPECTIVE: [&str; 6] =
    ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "perspective"];
const FISHEYE: [&str; 3] = ["OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE"];

/// Fields that make another camera than the ones that are read, unless they are false or zero.
const REFUSED: [(&str, &str); 12] = [
    ("orthographic", "a camera without perspective: give images of a perspective one"),
    ("k5", "a coefficient beyond k1 to k4: calibrate the lens without it, or undistort the images"),
    ("k6", "a coefficient beyond k1 to k4: calibrate the lens without it, or undistort the images"),
    ("b1", "an affinity of the pixels: calibrate the lens without it, or undistort the images"),
    ("b2", "a skew of the pixels: calibrate the lens without it, or undistort the images"),
    ("skew", "a skew of the pixels: calibrate the lens without it, or undistort the images"),
    ("ftheta_p0", "an f-theta lens: undistort the images"),
    ("latlong", "a panorama: cut pinhole images from it"),
    ("equirectangular", "a panorama: cut pinhole images from it"),
    ("rolling_shutter", "a rolling shutter: give the pose of each image's middle row, without it"),
    ("transform_matrix_start", "a motion during the exposure: give transform_matrix alone"),
    ("transform_matrix_end", "a motion during the exposure: give transform_matrix alone"),
];

/// Fields of a camera, which programs take from the file or from the frame: nerfstudio from the
/// file, instant-ngp from the frame.
const OF_CAMERA: [&str; 19] = [
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "distortion_params",
    "camera_angle_x",
    "camera_angle_y",
    "x_fov",
    "y_fov",
    "camera_model",
    "is_fisheye",
];

/// Coefficients of a lens.
struct Distortion {
    k: [f64; 4],
    p: [f64; 2],
}

impl Intrinsics {
    /// These fields of a file, and those of a frame.
    ///
    /// # Errors
    /// Both have a field of the camera, with different values.
    pub(super) fn joined_with(&self, frame: Self) -> Result<Self, Wrong> {
        // A conflict is refused and not resolved: each choice would train wrongly with one of the
        // two programs.
        for field in OF_CAMERA {
            let of_file = self.0.get(field).filter(|value| !value.is_null());
            let of_frame = frame.0.get(field).filter(|value| !value.is_null());
            if let (Some(of_file), Some(of_frame)) = (of_file, of_frame)
                && !is_same(of_file, of_frame)
            {
                let reason = format!(
                    "is {of_frame}, and {of_file} for the whole file: programs read one or the other; remove one"
                );
                return Err(Wrong { field, reason });
            }
        }
        // The frame's fields replace those of the file. Those of the camera are equal where both
        // exist.
        let mut fields = self.0.clone();
        fields.extend(frame.0.into_iter().filter(|(_, value)| !value.is_null()));
        Ok(Self(fields))
    }

    /// Whether a field is given.
    pub(super) fn has(&self, field: &str) -> bool {
        self.0.get(field).is_some_and(|value| !value.is_null())
    }

    pub(super) fn camera(&self) -> Result<Camera, Wrong> {
        for (field, reason) in REFUSED {
            if self.0.get(field).is_some_and(is_set) {
                return Err(Wrong { field, reason: format!("is not read: it is {reason}") });
            }
        }
        let width = self.side("w")?;
        let height = self.side("h")?;
        let [fx, fy] = self.focal_px(f64::from(width), f64::from(height))?;
        // The middle of the image, counted in pixels whose first one has its middle at 0.5.
        let cx = self.number("cx")?.unwrap_or(0.5 * f64::from(width));
        let cy = self.number("cy")?.unwrap_or(0.5 * f64::from(height));
        let camera = Camera {
            width_px: width,
            height_px: height,
            pinhole: Pinhole { fx, fy, cx, cy },
            lens: self.lens()?,
            windshield: None,
            native_size_px: None,
        };
        let checked = camera.check();
        checked.map_err(|cause| Wrong { field: "intrinsics", reason: cause.to_string() })?;
        Ok(camera)
    }

    /// Focal lengths: in pixels, or as an angle of view of instant-ngp; one of the two stands for
    /// both.
    fn focal_px(&self, width: f64, height: f64) -> Result<[f64; 2], Wrong> {
        let along = |side: f64, fl: &'static str, angle: &'static str, fov: &'static str| {
            // Half the side is the tangent of half the angle of view times the focal length.
            let of_angle = |angle_rad: f64| 0.5 * side / (0.5 * angle_rad).tan();
            let of_fov = self.number(fov)?.map(|degrees| of_angle(degrees.to_radians()));
            let given = match self.number(fl)? {
                Some(focal) => Some(focal),
                None => self.number(angle)?.map(of_angle),
            };
            match (given, of_fov) {
                // 0.1 % leaves room for angles that exporters round. Beyond it the fields describe
                // two cameras.
                (Some(given), Some(of_fov)) if (given / of_fov - 1.0).abs() > 1e-3 => {
                    let reason = format!(
                        "says a focal length of {of_fov:.2}, and {fl} or {angle} {given:.2}"
                    );
                    Err(Wrong { field: fov, reason })
                }
                (given, of_fov) => Ok(given.or(of_fov)),
            }
        };
        let x = along(width, "fl_x", "camera_angle_x", "x_fov")?;
        let y = along(height, "fl_y", "camera_angle_y", "y_fov")?;
        match (x, y) {
            // Square pixels are the rule: one focal length holds for both axes.
            (Some(x), y) => Ok([x, y.unwrap_or(x)]),
            (None, Some(y)) => Ok([y, y]),
            (None, None) => {
                let reason = "is missing, and camera_angle_x too: add it to the frame or to the file, in pixels";
                Err(Wrong { field: "fl_x", reason: reason.to_owned() })
            }
        }
    }

    fn lens(&self) -> Result<Lens, Wrong> {
        let model = match self.0.get("camera_model") {
            None | Some(Value::Null) => None,
            Some(Value::String(model)) => Some(model.as_str()),
            Some(other) => {
                let reason = format!("is {other}, not a text");
                return Err(Wrong { field: "camera_model", reason });
            }
        };
        let is_ngp_fisheye = match self.0.get("is_fisheye") {
            None | Some(Value::Null) => false,
            Some(Value::Bool(is_fisheye)) => *is_fisheye,
            Some(other) => {
                let reason = format!("is {other}, not true or false");
                return Err(Wrong { field: "is_fisheye", reason });
            }
        };
        let Distortion { k, p } = self.distortion()?;
        match model {
            // The flag is instant-ngp's and the model is nerfstudio's: they must name the same
            // lens.
            Some(model) if is_ngp_fisheye && !FISHEYE.contains(&model) => {
                let reason =
                    format!("is true, and camera_model is {model:?}: remove one of the two");
                Err(Wrong { field: "is_fisheye", reason })
            }
            Some(model) if FISHEYE.contains(&model) => fisheye(k, p),
            None if is_ngp_fisheye => fisheye(k, p),
            Some(model) if !PERSPECTIVE.contains(&model) => {
                let reason = format!(
                    "is {model:?}; {} and {} can be read: undistort the images",
                    PERSPECTIVE[..5].join(", "),
                    FISHEYE.join(", ")
                );
                Err(Wrong { field: "camera_model", reason })
            }
            _ => perspective(k, p),
        }
    }

    fn distortion(&self) -> Result<Distortion, Wrong> {
        let field = "distortion_params";
        let or_zero = |name| self.number(name).map(Option::unwrap_or_default);
        // The list stands in the place of the single fields, which may repeat it but not differ
        // from it.
        match self.0.get(field) {
            None | Some(Value::Null) => Ok(Distortion {
                k: [or_zero("k1")?, or_zero("k2")?, or_zero("k3")?, or_zero("k4")?],
                p: [or_zero("p1")?, or_zero("p2")?],
            }),
            Some(list) => match <[f64; 6]>::deserialize(list) {
                Ok(values) => {
                    let names = ["k1", "k2", "k3", "k4", "p1", "p2"];
                    for (name, value) in names.into_iter().zip(values) {
                        if let Some(other) = self.number(name)?.filter(|other| *other != value) {
                            let reason =
                                format!("says {name} {value}, and {name} is {other}: remove one");
                            return Err(Wrong { field, reason });
                        }
                    }
                    let [k1, k2, k3, k4, p1, p2] = values;
                    Ok(Distortion { k: [k1, k2, k3, k4], p: [p1, p2] })
                }
                Err(_) => {
                    let reason =
                        format!("is {list}; six numbers can be read: k1, k2, k3, k4, p1, p2");
                    Err(Wrong { field, reason })
                }
            },
        }
    }

    fn number(&self, field: &'static str) -> Result<Option<f64>, Wrong> {
        match self.0.get(field) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(Wrong { field, reason: format!("is {value}, not a number") }),
            },
        }
    }

    fn side(&self, field: &'static str) -> Result<u32, Wrong> {
        let side = self.number(field)?;
        // JSON numbers may be floats: 1920.0 is a size, and 1920.5 is none.
        let usable = side.filter(|side| side.fract() == 0.0 && (1.0..=1e6).contains(side));
        usable.map(|side| side as u32).ok_or_else(|| {
            let given = side.map_or("is missing".to_owned(), |side| format!("is {side:?}"));
            let reason = format!(
                "{given}: add the size of the images to the frame or to the file, in pixels"
            );
            Wrong { field, reason }
        })
    }
}

/// Whether two values are the same: 700 is 700.0.
fn is_same(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_same(a, b))
        }
        // serde_json tells 700 from 700.0, which are the same number to every reader.
        (Value::Number(_), Value::Number(_)) => a.as_f64() == b.as_f64(),
        _ => a == b,
    }
}

/// Whether a value asks for something: it is neither null, false, zero, nor a list of these.
fn is_set(value: &Value) -> bool {
    match value {
        Value::Null | Value::Bool(false) => false,
        Value::Number(number) => number.as_f64() != Some(0.0),
        Value::Array(values) => values.iter().any(is_set),
        _ => true,
    }
}

fn perspective([k1, k2, k3, k4]: [f64; 4], p: [f64; 2]) -> Result<Lens, Wrong> {
    if k4 != 0.0 {
        // OpenCV's fourth coefficient is in the denominator, and nerfstudio's is of r to the power
        // of 8.
        let reason = format!(
            "is {k4}: a lens that is no fisheye is read with k1, k2, k3, p1 and p2; calibrate it without k4, or \
             undistort the images"
        );
        return Err(Wrong { field: "k4", reason });
    }
    Ok(Lens::opencv(OpenCv::new([k1, k2, k3, 0.0, 0.0, 0.0], p, [0.0; 4])))
}

fn fisheye(k: [f64; 4], p: [f64; 2]) -> Result<Lens, Wrong> {
    // The fisheye lens here has no tangential terms, and to ignore them would bend the picture.
    for (field, value) in [("p1", p[0]), ("p2", p[1])] {
        if value != 0.0 {
            let reason = format!(
                "is {value}: a fisheye lens is read without tangential distortion; calibrate it without, or undistort \
                 the images"
            );
            return Err(Wrong { field, reason });
        }
    }
    Ok(Lens::Fisheye(Fisheye::new(k, None)))
}
