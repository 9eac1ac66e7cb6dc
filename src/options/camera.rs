//! Properties of a camera beyond the pinhole: lens, windshield, shutter and colour correction.

use serde::{Deserialize, Serialize};

/// A lens model other than the pinhole: how it maps rays to pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "model", rename_all = "lowercase")]
pub enum Lens {
    /// OpenCV's radial, tangential and thin-prism distortion.
    Opencv {
        /// Radial coefficients k1 to k6.
        k: [f64; 6],
        /// Tangential coefficients p1 and p2.
        #[serde(default)]
        p: [f64; 2],
        /// Thin-prism coefficients s1 to s4.
        #[serde(default)]
        s: [f64; 4],
    },
    /// OpenCV's fisheye model.
    Fisheye {
        /// Coefficients k1 to k4.
        k: [f64; 4],
        /// Largest angle from the optical axis that the lens sees, in radians. If absent, the angle
        /// up to which its polynomial increases.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max_angle: Option<f64>,
    },
    /// NVIDIA's f-theta model. Its polynomial determines the focal lengths.
    Ftheta {
        /// What the polynomial maps to what.
        reference: FThetaReference,
        /// Coefficients of the powers 0 to 5, in radians and pixels.
        polynomial: [f64; 6],
        /// `[c, d, e]` of the matrix `[[c, d], [e, 1]]`, which maps rotationally symmetric pixel
        /// offsets to those of the real sensor.
        linear_cde: [f64; 3],
        /// Largest angle from the optical axis that the lens sees, in radians.
        max_angle: f64,
    },
}

/// What an f-theta polynomial maps to what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Reference"))]
pub enum FThetaReference {
    /// The angle from the optical axis, in radians, to the distance from the principal point, in
    /// pixels.
    AngleToPixel,
    /// The distance from the principal point, in pixels, to the angle, in radians.
    PixelToAngle,
}

/// Colour correction of a camera: `matrix * rgb + offset`, on the red, green and blue that the
/// scene stores, from 0 to 1. They are display-referred, as in the training photographs, and not
/// proportional to light. Requests give the matrix, or a gain per channel instead; answers have the
/// matrix.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(transform = crate::matrix_or_gain))]
pub struct Exposure {
    /// The matrix, row by row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(inner(inner(range(min = -100.0, max = 100.0)))))]
    pub matrix: Option<[[f64; 3]; 3]>,
    /// Gain of red, green and blue, instead of the matrix.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(inner(range(min = -100.0, max = 100.0))))]
    pub gain: Option<[f64; 3]>,
    /// Added to each channel after the matrix or gain.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schemars(inner(range(min = -100.0, max = 100.0))))]
    pub offset: [f64; 3],
}

/// A windshield in front of the lens, which refracts rays.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Windshield {
    /// Which rays the polynomials map to which.
    pub reference: WindshieldReference,
    /// Coefficients of the polynomial for the angle to the right.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 21)))]
    pub horizontal: Vec<f64>,
    /// Coefficients of the polynomial for the angle downwards.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 21)))]
    pub vertical: Vec<f64>,
}

/// Which rays a windshield's polynomials map to which.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum WindshieldReference {
    /// Rays outside the windshield to rays at the lens.
    Forward,
    /// Rays at the lens to rays outside the windshield.
    Backward,
}

/// A rolling shutter: it exposes the image's rows, or columns, one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Shutter {
    /// The order in which rows or columns are exposed.
    pub direction: ShutterDirection,
    /// Time from the exposure of the first row (or column) to that of the last, in microseconds.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 100_000)))]
    pub duration_us: i64,
}

/// The order in which a rolling shutter exposes rows or columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Rolls"))]
pub enum ShutterDirection {
    /// Rows, the top one first.
    TopToBottom,
    /// Rows, the bottom one first.
    BottomToTop,
    /// Columns, the left one first.
    LeftToRight,
    /// Columns, the right one first.
    RightToLeft,
}
