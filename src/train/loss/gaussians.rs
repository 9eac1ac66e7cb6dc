//! Losses of all Gaussians, which keep what no image needs small (3DGS-MCMC, eq. 10).

use super::{Loss, Real};

/// The mean opacity. Derivatives are by the logits: `o (1 - o)`.
pub fn opacity<T: Real>(logits: &[T]) -> Loss<T> {
    let share = 1.0 / logits.len().max(1) as f64;
    let mut value = 0.0;
    let mut by = Vec::with_capacity(logits.len());
    for &logit in logits {
        let opacity = T::one() / (T::one() + (-logit).exp());
        value += opacity.to_double();
        by.push(opacity * (T::one() - opacity) * T::from_f64(share));
    }
    Loss { value: value * share, by }
}

/// The mean of all standard deviations, in metres. Derivatives are by their logarithms.
pub fn scale<T: Real>(ln_scales: &[T]) -> Loss<T> {
    let share = 1.0 / ln_scales.len().max(1) as f64;
    let mut value = 0.0;
    let mut by = Vec::with_capacity(ln_scales.len());
    for ln_scale in ln_scales {
        let scale_m = ln_scale.exp();
        value += scale_m.to_double();
        by.push(scale_m * T::from_f64(share));
    }
    Loss { value: value * share, by }
}
