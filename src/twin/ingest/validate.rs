//! The gate: what every Gaussian must satisfy before anything is written or drawn.
//!
//! The bounds are wide. They keep every stage's f32 arithmetic finite, and catch what is a mistake
//! rather than a scene: a diverged training, swapped columns, logarithms taken twice.

use rayon::prelude::*;

use crate::limits;
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, sh};

use super::IngestError;

/// Shortest and longest quaternion. Trainers leave them between 0.1 and 10.
pub const QUAT_LENGTH: [f64; 2] = [1e-6, 1e6];
/// Smallest and largest ln of a standard deviation: 1e-13 m and 22 km.
pub const LN_SCALE: [f32; 2] = [-30.0, 10.0];
/// Largest opacity before the sigmoid, either way; f32's sigmoid is 1 from 17 on.
pub const MAX_LOGIT: f32 = 1e4;
/// Largest colour coefficient, either way: colours are about 1.
pub const MAX_SH: f32 = sh::MAX_COEFFICIENT;

/// One number of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Field {
    /// Centre along an axis.
    Mean(usize),
    /// Component of the quaternion: w, x, y, z.
    Quat(usize),
    /// Length of the quaternion.
    QuatLength,
    /// Natural logarithm of the standard deviation along an own axis.
    Scale(usize),
    /// Opacity before the sigmoid.
    Opacity,
    /// Colour: coefficient, channel.
    Sh(usize, usize),
}

impl Field {
    /// The field of a file whose format names none; scales and opacities as they are kept.
    pub(super) fn plain_name(self) -> String {
        match self {
            Self::Mean(axis) => format!("position[{axis}]"),
            Self::Quat(i) => format!("rotation[{i}] (of w, x, y, z)"),
            Self::QuatLength => "length of the rotation".into(),
            Self::Scale(axis) => format!("ln of scale[{axis}]"),
            Self::Opacity => "logit of the opacity".into(),
            Self::Sh(k, channel) => format!("colour coefficient [{k}][{channel}]"),
        }
    }

    /// The field of a Gaussian that comes from no file.
    pub fn twin_name(self) -> String {
        match self {
            Self::Mean(axis) => format!("means_m[{axis}]"),
            Self::Quat(i) => format!("quats_wxyz[{i}]"),
            Self::QuatLength => "length of quats_wxyz".into(),
            Self::Scale(axis) => format!("ln_scales[{axis}]"),
            Self::Opacity => "logit_opacities".into(),
            Self::Sh(k, channel) => format!("sh[{k}][{channel}]"),
        }
    }
}

/// A Gaussian that no renderer can draw.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("Gaussian {index}: {field} is {value}; {must}")]
pub struct BadGaussian {
    /// Which one, from 0.
    pub index: usize,
    /// The field, as the file calls it.
    pub field: String,
    /// The refused value.
    pub value: String,
    /// What must hold instead.
    pub must: &'static str,
}

/// All Gaussians of a file that no renderer can draw.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BadGaussians {
    /// The first of them, one at least and [`limits::BAD_GAUSSIANS`] at most.
    pub first: Vec<BadGaussian>,
    /// How many there are.
    pub count: u64,
    /// Of how many.
    pub gaussians: u64,
}

/// Checks all Gaussians; `name` says what the file calls a field.
///
/// # Errors
/// [`IngestError::Values`] if one is out of bounds: all of those.
pub fn check(
    gaussians: &Gaussians,
    name: &(dyn Fn(Field) -> String + Sync),
) -> Result<(), IngestError> {
    let first = (0..gaussians.len())
        .into_par_iter()
        .by_uniform_blocks(4096)
        .find_first(|&index| first_fault(gaussians, index).is_some());
    let Some(first) = first else { return Ok(()) };
    let (mut bad, mut count) = (Vec::new(), 0);
    for index in first..gaussians.len() {
        let Some((field, value, must)) = first_fault(gaussians, index) else { continue };
        count += 1;
        if bad.len() < limits::BAD_GAUSSIANS {
            bad.push(BadGaussian { index, field: name(field), value, must });
        }
    }
    let gaussians = gaussians.len() as u64;
    Err(IngestError::Values(BadGaussians { first: bad, count, gaussians }))
}

impl std::fmt::Display for BadGaussians {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(first) = self.first.first() {
            write!(f, "{first}")?;
        }
        if self.count > 1 {
            let (more, others) = (self.count - 1, self.first.iter().skip(1).map(|bad| bad.index));
            let named: Vec<String> = others.take(4).map(|index| index.to_string()).collect();
            write!(f, "; and {more} more, as Gaussian {}", named.join(", "))?;
        }
        Ok(())
    }
}

type Fault = (Field, String, &'static str);

/// Every test is phrased as what must hold, so that NaN fails it.
fn first_fault(gaussians: &Gaussians, index: usize) -> Option<Fault> {
    for (axis, &m) in gaussians.means_m[index].iter().enumerate() {
        let near = m.abs() <= Pose::MAX_COORDINATE_M;
        if !near {
            return Some((
                Field::Mean(axis),
                format!("{m:?}"),
                "a centre is within 1e8 of the origin",
            ));
        }
    }
    let quat = gaussians.quats_wxyz[index];
    if let Some(i) = quat.iter().position(|q| !q.is_finite()) {
        return Some((Field::Quat(i), format!("{:?}", quat[i]), "a quaternion is finite"));
    }
    let length = quat.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>().sqrt();
    if !(QUAT_LENGTH[0]..=QUAT_LENGTH[1]).contains(&length) {
        let must = "a quaternion's length is from 1e-6 to 1e6";
        return Some((Field::QuatLength, format!("{length:?}"), must));
    }
    for (axis, ln) in gaussians.ln_scales[index].iter().enumerate() {
        if !(LN_SCALE[0]..=LN_SCALE[1]).contains(ln) {
            let must = "a scale is the natural logarithm of metres, from -30 to 10";
            return Some((Field::Scale(axis), format!("{ln:?}"), must));
        }
    }
    let logit = gaussians.logit_opacities[index];
    let bounded = logit.abs() <= MAX_LOGIT;
    if !bounded {
        let must = "an opacity is a logit (before the sigmoid), within 1e4 of 0";
        return Some((Field::Opacity, format!("{logit:?}"), must));
    }
    for (i, c) in gaussians.sh_of(index).iter().enumerate() {
        let bounded = c.abs() <= MAX_SH;
        if !bounded {
            let must = "a colour coefficient is within 1000 of 0";
            return Some((Field::Sh(i / 3, i % 3), format!("{c:?}"), must));
        }
    }
    None
}
