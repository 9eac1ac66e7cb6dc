//! Relocation and growth: 3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al.
//! 2024).
//!
//! Gaussians that have become transparent, and new ones, become copies of others, drawn in
//! proportion to their opacity. A Gaussian that is drawn k times becomes n = k + 1 equal ones, with
//! the opacity and scales that leave the image nearly as it was:
//!
//! ```text
//! o' = 1 - (1 - o)^(1/n)
//! s' = s o / Σ_{i=1..n} Σ_{k<i} C(i-1, k) (-1)^k o'^(k+1) / √(k+1)
//! ```

use wildcity_scene::random::{mix, to_unit};

use crate::model::Model;
use crate::settings::Settings;

/// Most copies of one Gaussian at a time, as in the code of its authors.
const MOST_COPIES: usize = 51;

/// Moves the transparent Gaussians, and adds new ones up to the cap. Returns the number of both.
pub(crate) fn relocate_and_grow(model: &mut Model, settings: &Settings, seed: u64) -> [usize; 2] {
    let growth = &settings.growth;
    let count = model.len();
    let opacities: Vec<f32> = (0..count).map(|index| model.opacity(index)).collect();
    // Written so that a NaN counts as transparent.
    let is_alive = |index: &usize| opacities[*index] > growth.least_opacity;
    let alive: Vec<usize> = (0..count).filter(is_alive).collect();
    if alive.is_empty() {
        return [0, 0];
    }
    let dead: Vec<usize> = (0..count).filter(|index| !is_alive(index)).collect();
    let added = settings.added(count);

    // Draw in proportion to the opacity, with replacement.
    let mut sums = Vec::with_capacity(alive.len());
    let mut sum = 0.0;
    for &index in &alive {
        sum += f64::from(opacities[index]);
        sums.push(sum);
    }
    let draw = |k: usize| {
        let at = to_unit(mix(seed ^ mix(k as u64))) * sum;
        let place = sums.partition_point(|&sum| sum <= at);
        // A product that is rounded up to the whole sum lies behind the last one.
        alive[place.min(alive.len() - 1)]
    };
    let sources: Vec<usize> = (0..dead.len() + added).map(draw).collect();
    let mut drawn = vec![0; count];
    for &source in &sources {
        drawn[source] += 1;
    }
    for source in (0..count).filter(|&source| drawn[source] > 0) {
        let n = (drawn[source] + 1).min(MOST_COPIES);
        let [opacity, factor] = shared(opacities[source].into(), n, growth.least_opacity.into());
        model.reshape(source, opacity as f32, factor as f32);
        model.forget(source);
    }
    let to: Vec<usize> = dead.iter().copied().chain(count..count + added).collect();
    model.copy(&sources, &to);
    [dead.len(), added]
}

/// The opacity of each of n copies of a Gaussian, and the factor of their scales.
fn shared(opacity: f64, n: usize, least_opacity: f64) -> [f64; 2] {
    // At 1 the root would be 1, and each copy as opaque as the one.
    let before = opacity.min(1.0 - 1.2e-7);
    let each = 1.0 - (1.0 - before).powf(1.0 / n as f64);
    let mut sum = 0.0;
    for i in 1..=n {
        let mut binomial = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * binomial * each.powi(k as i32 + 1) / (k as f64 + 1.0).sqrt();
            // C(i-1, k+1) from C(i-1, k).
            binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    // The scale belongs to the opacity before it is raised to the least, as in their code.
    [each.max(least_opacity), before / sum]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_have_the_integral_of_the_one() {
        for opacity in [0.05, 0.3, 0.8, 0.99] {
            for n in [1, 2, 3, 10] {
                let [each, factor] = shared(opacity, n, 1e-6);
                assert!((1.0 - (1.0 - each).powi(n as i32) - opacity).abs() < 1e-6);
                // Along a line: of the one, and of n copies, 1 - (1 - each g)^n, by the trapezoidal
                // rule, which is exact for such functions.
                let integral = |f: &dyn Fn(f64) -> f64| {
                    (-8_000..8_000).map(|i| f(f64::from(i) * 1e-3)).sum::<f64>() * 1e-3
                };
                let one = integral(&|x| opacity * (-0.5 * x * x).exp());
                let copies = integral(&|x| {
                    let x = x / factor;
                    1.0 - (1.0 - each * (-0.5 * x * x).exp()).powi(n as i32)
                });
                assert!((one - copies).abs() < 1e-6 * one, "{opacity} {n}: {one} {copies}");
            }
        }
    }
}
