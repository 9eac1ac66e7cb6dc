//! From what files hold, activated or quantised, back to raw parameters.

use wildcity_scene::sh;

use super::validate::LN_SCALE;

/// Largest logit made of an opacity, either way: 255 of 255 means 1, whose logit is infinite; 20's
/// is 1 in f32.
const MAX_LOGIT: f64 = 20.0;

/// The logit of an opacity from 0 to 1; NaN outside, which the gate refuses.
pub(super) fn logit(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln().clamp(-MAX_LOGIT, MAX_LOGIT) as f32
}

/// The logarithm of a standard deviation. Zero, which smaller types round to, becomes the smallest
/// that is allowed; a negative one becomes NaN, which the gate refuses.
pub(super) fn ln_scale(scale: f64) -> f32 {
    let ln = scale.ln() as f32;
    if ln < LN_SCALE[0] { LN_SCALE[0] } else { ln }
}

/// The coefficient of degree 0 of a colour from 0 to 1.
pub(super) fn dc(colour: f64) -> f32 {
    ((colour - 0.5) / sh::C0) as f32
}

/// The unit quaternion (w, x, y, z) of its three smallest components, in order, and the place of
/// the largest, from 0 to 3, which is positive.
pub(super) fn quat_of_smallest_three(largest: usize, others: [f64; 3]) -> [f32; 4] {
    let square = others.iter().map(|q| q * q).sum::<f64>();
    let mut left = others.into_iter();
    std::array::from_fn(|i| match i == largest {
        true => (1.0 - square).max(0.0).sqrt() as f32,
        false => left.next().unwrap_or(0.0) as f32,
    })
}
