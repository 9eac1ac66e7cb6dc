//! What a camera is beyond a pinhole.

use serde::{Deserialize, Serialize};

/// How a lens maps rays to pixels, where it is no pinhole.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "model", rename_all = "lowercase")]
pub enum Lens {
    /// OpenCV's radial, tangential and thin prism distortion.
    Opencv {
        /// k1 to k6.
        k: [f64; 6],
        /// p1 and p2.
        #[serde(default)]
        p: [f64; 2],
        /// s1 to s4.
        #[serde(default)]
        s: [f64; 4],
    },
    /// OpenCV's fisheye.
    Fisheye {
        /// k1 to k4.
        k: [f64; 4],
        /// How far off the axis it sees, in radians; as far as its polynomial rises if absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max_angle: Option<f64>,
    },
    /// NVIDIA's f-theta, which has its focal lengths from its polynomial.
    Ftheta {
        /// Which way the polynomial goes.
        reference: FthetaReference,
        /// Coefficients of powers 0 to 5, in radians and pixels.
        polynomial: [f64; 6],
        /// `[c, d, e]` of `[[c, d], [e, 1]]`, from round to real pixels.
        linear_cde: [f64; 3],
        /// How far off the axis it sees, in radians.
        max_angle: f64,
    },
}

/// Which way an f-theta polynomial goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Reference"))]
pub enum FthetaReference {
    /// From radians off the axis to pixels from the principal point.
    AngleToPixel,
    /// From pixels to radians.
    PixelToAngle,
}

/// What a camera makes of colours: `matrix * rgb + offset`, linear red, green, blue from 0 to 1. The matrix,
/// or a gain per channel; answers have the matrix.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Exposure {
    /// Row by row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matrix: Option<[[f64; 3]; 3]>,
    /// Of red, green and blue, in its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<[f64; 3]>,
    /// Added to each channel.
    #[serde(default)]
    pub offset: [f64; 3],
}

/// A windshield before the lens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Windshield {
    /// Which way the polynomials go.
    pub reference: WindshieldReference,
    /// Coefficients of the angle to the right.
    pub horizontal: Vec<f64>,
    /// Coefficients of the angle downwards.
    pub vertical: Vec<f64>,
}

/// Which way a windshield's polynomials go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum WindshieldReference {
    /// From the world's rays to the lens'.
    Forward,
    /// From the lens' rays to the world's.
    Backward,
}

/// A shutter that exposes rows, or columns, one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Shutter {
    /// Which row or column comes first.
    pub direction: ShutterDirection,
    /// From the first row's exposure to the last's, in microseconds.
    pub duration_us: i64,
}

/// The way a shutter rolls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Rolls"))]
pub enum ShutterDirection {
    /// The top row first.
    TopToBottom,
    /// The bottom row first.
    BottomToTop,
    /// The left column first.
    LeftToRight,
    /// The right column first.
    RightToLeft,
}
