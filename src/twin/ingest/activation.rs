//! Inverse activations: from activated or quantised values in files to raw parameters.

use wildcity_scene::sh;

use super::validate::{FULL_LOGIT, LN_SCALE};

/// The logit of an opacity from 0 to 1; NaN outside of that, which validation refuses.
pub(super) fn logit(opacity: f64) -> f32 {
    let most = f64::from(FULL_LOGIT);
    (opacity / (1.0 - opacity)).ln().clamp(-most, most) as f32
}

/// The natural logarithm of a standard deviation. Zero, to which narrow types round small ones,
/// becomes the smallest allowed value. A negative one becomes NaN, which validation refuses.
pub(super) fn ln_scale(scale: f64) -> f32 {
    let ln = scale.ln() as f32;
    if ln < LN_SCALE[0] { LN_SCALE[0] } else { ln }
}

/// The SH coefficient of degree 0 for a colour from 0 to 1.
pub(super) fn dc(colour: f64) -> f32 {
    ((colour - 0.5) / sh::C0) as f32
}

/// The unit quaternion (w, x, y, z) from its three smallest components, in order, and the index of
/// the largest, 0 to 3, which is positive.
pub(super) fn quat_of_smallest_three(largest: usize, others: [f64; 3]) -> [f32; 4] {
    let square = others.iter().map(|q| q * q).sum::<f64>();
    let mut left = others.into_iter();
    std::array::from_fn(|i| {
        if i == largest {
            (1.0 - square).max(0.0).sqrt() as f32
        } else {
            left.next().unwrap_or(0.0) as f32
        }
    })
}
