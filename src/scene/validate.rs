//! The bounds that every Gaussian must satisfy before it is written or drawn.
//!
//! The bounds are wide. They keep the f32 arithmetic of every render stage finite, and they catch
//! mistakes: a training that diverged, swapped columns, logarithms taken twice.

use rayon::prelude::*;

use super::geometry::Pose;
use super::{Gaussians, sh};

/// Shortest and longest quaternion. Trainers leave them between 0.1 and 10.
pub const QUAT_LENGTH: [f64; 2] = [1e-6, 1e6];
/// Smallest and largest natural logarithm of a standard deviation in metres: 1e-13 m and 22 km.
pub const LN_SCALE: [f32; 2] = [-30.0, 10.0];
/// Largest magnitude of an opacity before the sigmoid; in f32 the sigmoid is 1 from 17 on.
pub const MAX_LOGIT: f32 = 1e4;
/// Magnitude of the logit that stands for an opacity of 0 or 1, whose logit is infinite: the
/// sigmoid of 20 is 1 in f32.
pub const FULL_LOGIT: f32 = 20.0;
/// Largest magnitude of a colour coefficient: colours are about 1.
pub const MAX_SH: f32 = sh::MAX_COEFFICIENT;
/// Number of invalid Gaussians of one file that are listed individually; further ones are only
/// counted.
pub const NAMED_BAD_GAUSSIANS: usize = 16;

/// Gaussians that one thread checks at a time.
const BLOCK_GAUSSIANS: usize = 4096;

/// One number of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Field {
    /// Coordinate of the centre along an axis.
    Mean(usize),
    /// Component of the quaternion: w, x, y, z.
    Quat(usize),
    /// Length of the quaternion.
    QuatLength,
    /// Natural logarithm of the standard deviation along one of the Gaussian's own axes.
    Scale(usize),
    /// Opacity before the sigmoid.
    Opacity,
    /// A coefficient of the colour, and its channel.
    Sh(usize, usize),
}

impl Field {
    /// Name of the field for a file whose format names no fields. Scales and opacities are named as
    /// they are kept in memory: as logarithms and logits.
    pub fn plain_name(self) -> String {
        match self {
            Self::Mean(axis) => format!("position[{axis}]"),
            Self::Quat(i) => format!("rotation[{i}] (of w, x, y, z)"),
            Self::QuatLength => "length of the rotation".into(),
            Self::Scale(axis) => format!("ln of scale[{axis}]"),
            Self::Opacity => "logit of the opacity".into(),
            Self::Sh(k, channel) => format!("colour coefficient [{k}][{channel}]"),
        }
    }

    /// Name of the field for a Gaussian that was not read from a file: that of the column.
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

/// A Gaussian with a number outside its bounds, which no renderer can draw.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("Gaussian {index}: {field} is {value}; {must}")]
pub struct BadGaussian {
    /// Index in the file, from 0.
    pub index: usize,
    /// Name of the field in the file.
    pub field: String,
    pub value: String,
    /// The bound that the value violates.
    pub must: &'static str,
}

/// The Gaussians of one file that have a number outside its bounds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BadGaussians {
    /// The first of them: at least one, at most [`NAMED_BAD_GAUSSIANS`].
    pub first: Vec<BadGaussian>,
    pub count: u64,
    /// Number of Gaussians in the file.
    pub gaussians: u64,
}

/// Checks every number of every Gaussian; `name` gives the name of a field in the file.
///
/// # Errors
/// All Gaussians with a number outside its bounds, the first few of them by name.
pub fn check(
    gaussians: &Gaussians,
    name: &(dyn Fn(Field) -> String + Sync),
) -> Result<(), BadGaussians> {
    // Most files are valid, so all cores search for the first invalid Gaussian.
    // `find_first` gives the first index whichever thread finds one, so that the message does not
    // depend on threads.
    let first = (0..gaussians.len())
        .into_par_iter()
        .by_uniform_blocks(BLOCK_GAUSSIANS)
        .find_first(|&index| violation(gaussians, index).is_some());
    let Some(first) = first else { return Ok(()) };
    let mut named = Vec::new();
    let mut count = 0;
    // From there one thread is enough: invalid files are rare, and names are needed in order.
    for index in first..gaussians.len() {
        let Some(Violation { field, value, must }) = violation(gaussians, index) else { continue };
        count += 1;
        if named.len() < NAMED_BAD_GAUSSIANS {
            named.push(BadGaussian { index, field: name(field), value, must });
        }
    }
    Err(BadGaussians { first: named, count, gaussians: gaussians.len() as u64 })
}

impl std::fmt::Display for BadGaussians {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(first) = self.first.first() {
            write!(f, "{first}")?;
        }
        if self.count > 1 {
            let others = self.first.iter().skip(1).map(|bad| bad.index.to_string());
            let named: Vec<String> = others.take(4).collect();
            write!(f, "; and {} more, as Gaussian {}", self.count - 1, named.join(", "))?;
        }
        Ok(())
    }
}

impl std::error::Error for BadGaussians {}

/// A number outside its bounds.
struct Violation {
    field: Field,
    value: String,
    must: &'static str,
}

/// Whether every number of a Gaussian is within its bounds.
pub fn is_valid(gaussians: &Gaussians, index: usize) -> bool {
    violation(gaussians, index).is_none()
}

/// The first number of a Gaussian that is outside its bounds. Every condition states what must
/// hold, so that NaN fails it.
fn violation(gaussians: &Gaussians, index: usize) -> Option<Violation> {
    // The order of the checks is that of the columns: the first one at fault is named.
    for (axis, &m) in gaussians.means_m[index].iter().enumerate() {
        let near = m.abs() <= Pose::MAX_COORDINATE_M;
        if !near {
            return Some(Violation {
                field: Field::Mean(axis),
                value: format!("{m:?}"),
                must: "a centre is within 1e8 of the origin",
            });
        }
    }
    let quat = gaussians.quats_wxyz[index];
    if let Some(i) = quat.iter().position(|q| !q.is_finite()) {
        return Some(Violation {
            field: Field::Quat(i),
            value: format!("{:?}", quat[i]),
            must: "a quaternion is finite",
        });
    }
    // In f64: the squares of components up to 3e38 leave f32.
    let length = quat.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>().sqrt();
    if !(QUAT_LENGTH[0]..=QUAT_LENGTH[1]).contains(&length) {
        return Some(Violation {
            field: Field::QuatLength,
            value: format!("{length:?}"),
            must: "a quaternion's length is from 1e-6 to 1e6",
        });
    }
    for (axis, ln) in gaussians.ln_scales[index].iter().enumerate() {
        if !(LN_SCALE[0]..=LN_SCALE[1]).contains(ln) {
            return Some(Violation {
                field: Field::Scale(axis),
                value: format!("{ln:?}"),
                must: "a scale is the natural logarithm of metres, from -30 to 10",
            });
        }
    }
    let logit = gaussians.logit_opacities[index];
    let bounded = logit.abs() <= MAX_LOGIT;
    if !bounded {
        return Some(Violation {
            field: Field::Opacity,
            value: format!("{logit:?}"),
            must: "an opacity is a logit (before the sigmoid), within 1e4 of 0",
        });
    }
    for (i, c) in gaussians.sh_at(index).iter().enumerate() {
        let bounded = c.abs() <= MAX_SH;
        if !bounded {
            return Some(Violation {
                field: Field::Sh(i / 3, i % 3),
                value: format!("{c:?}"),
                must: "a colour coefficient is within 1000 of 0",
            });
        }
    }
    None
}
