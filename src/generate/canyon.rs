//! A street of any number of Gaussians, for measuring: a road between two facades, closed at its
//! ends.
//!
//! More Gaussians are smaller, so that they cover the same surfaces equally densely: a larger
//! number gives more detail, as in a larger capture.

use super::random::Random;
use wildcity_scene::Gaussians;

/// Half the length of the road, and half its width, in metres.
const HALF_M: [f64; 2] = [60.0, 8.0];
/// Height of the facades, in metres: what a vehicle's cameras see of them.
const HEIGHT_M: f64 = 6.0;
/// Largest distance of a surfel from its surface, to either side, in metres.
const ROUGH_M: f64 = 0.05;

/// Makes `count` Gaussians of SH degree 1 around the origin, with the road along x at z = 0. Calls
/// `progress` with the number of Gaussians that are done and the number of all. The same count
/// gives the same Gaussians; between machines they may differ by rounding, because the logarithm is
/// that of the system.
pub fn canyon(count: usize, progress: &mut dyn FnMut(u64, u64)) -> Gaussians {
    let [half_length, half_width] = HALF_M;
    // Road, two facades, and two ends.
    let areas_m2 =
        [4.0 * half_length * half_width, 4.0 * half_length * HEIGHT_M, 4.0 * half_width * HEIGHT_M];
    let area_m2: f64 = areas_m2.iter().sum();
    // Each Gaussian has an equal part of the surface: n s^2 = area.
    let spacing_m = (area_m2 / count.max(1) as f64).sqrt();
    let mut random = Random::new(1, "canyon", 0);
    let mut gaussians = Gaussians::with_capacity(1, count);
    for index in 0..count {
        if index % (1 << 16) == 0 {
            progress(index as u64, count as u64);
        }
        // All numbers are drawn for every Gaussian, used or not, so that the stream does not depend
        // on which surface it lies on.
        let x = random.range(-half_length, half_length);
        let y = random.range(-half_width, half_width);
        let z = random.range(0.0, HEIGHT_M);
        let off = random.range(-ROUGH_M, ROUGH_M);
        let side = if random.chance(0.5) { -1.0 } else { 1.0 };
        let at = random.range(0.0, area_m2);
        // `across` is the axis that is perpendicular to the surface, along which the Gaussian is
        // thin.
        let (mean_m, across, grey) = if at < areas_m2[0] {
            ([x, y, off], 2, 0.25)
        } else if at < areas_m2[0] + areas_m2[1] {
            ([x, side * half_width + off, z], 1, 0.6)
        } else {
            ([side * half_length + off, y, z], 0, 0.8)
        };
        // 0.7 of the spacing in the surface, a tenth of that across it.
        let mut sigma_m = [0.7 * spacing_m; 3];
        sigma_m[across] *= 0.1;
        gaussians.means_m.push(mean_m);
        gaussians.ln_scales.push(sigma_m.map(|s| (s.ln() + random.range(-0.5, 0.5)) as f32));
        let tilt = |random: &mut Random| random.range(-0.2, 0.2) as f32;
        let quat = [1.0, tilt(&mut random), tilt(&mut random), tilt(&mut random)];
        gaussians.quats_wxyz.push(quat);
        gaussians.logit_opacities.push(random.range(-1.0, 4.0) as f32);
        gaussians.sh.extend((0..3).map(|_| (grey - 0.5 + random.range(-0.5, 0.5)) as f32));
        gaussians.sh.extend((0..9).map(|_| random.range(-0.1, 0.1) as f32));
    }
    progress(count as u64, count as u64);
    gaussians
}
