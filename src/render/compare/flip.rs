//! LDR-FLIP (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images"): how
//! much a person sees when two images alternate, from 0 to 1 for each pixel.
//!
//! The images are taken as sRGB on a display with [`PIXELS_PER_DEGREE`]. Colours are blurred as the
//! eye does at that distance (contrast sensitivity), compared in a Hunt-adjusted L*a*b*, and the
//! difference is raised where edges or points differ. `flip-evaluator` 1.7 gives the same values to
//! rounding in f32.

use std::f64::consts::PI;

use rayon::prelude::*;

/// Pixels of a display per degree of the visual field: 3840 px on 0.7 m, seen from 0.7 m.
pub const PIXELS_PER_DEGREE: f64 = 3840.0 * PI / 180.0;

/// Amplitudes and widths of the two Gaussians of the contrast sensitivity of each opponent channel:
/// achromatic, red-green, blue-yellow.
const SENSITIVITY: [[(f64, f64); 2]; 3] =
    [[(1.0, 0.0047), (0.0, 1e-5)], [(1.0, 0.0053), (0.0, 1e-5)], [(34.1, 0.04), (13.5, 0.025)]];
/// The widest of them, which gives all three their reach.
const WIDEST: f64 = 0.04;
/// Width of an edge that the eye detects, in degrees.
const FEATURE_DEG: f64 = 0.082;
/// Exponents of colours and of features; where the compressed range of colours begins, and its
/// value there.
const COLOR_EXPONENT: f32 = 0.7;
const FEATURE_EXPONENT: f32 = 0.5;
const KNEE: f32 = 0.4;
const KNEE_VALUE: f32 = 0.95;

/// XYZ of linear RGB with sRGB's primaries, and its inverse.
const XYZ_FROM_RGB: [[f64; 3]; 3] = [
    [10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0],
    [2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0],
    [1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0],
];
const RGB_FROM_XYZ: [[f64; 3]; 3] = [
    [3.241_003_275, -1.537_398_934, -0.498_615_861],
    [-0.969_224_334, 1.875_930_071, 0.041_554_224],
    [0.055_639_423, -0.204_011_202, 1.057_148_933],
];
/// XYZ of white (D65).
const WHITE: [f32; 3] = [0.950_428_55, 1.0, 1.088_900_3];

/// One value per pixel, row by row.
type Plane = Vec<f32>;

/// The error of each pixel between two images of sRGB values from 0 to 1, `[height, width, 3]`. The
/// mean over the pixels is the FLIP of the images.
///
/// # Panics
/// If a length does not fit the size.
pub fn flip(image: &[f32], truth: &[f32], size_px: [u32; 2]) -> Vec<f32> {
    let [width, height] = size_px.map(|px| px as usize);
    assert!(image.len() == 3 * width * height && truth.len() == image.len(), "{size_px:?}");
    let [image, truth] = [image, truth].map(|srgb| Perceived::new(srgb, width));
    // The paper normalizes by the distance of green and blue, the largest in the gamut.
    let most = hyab(hunt_lab([0.0, 1.0, 0.0]), hunt_lab([0.0, 0.0, 1.0])).powf(COLOR_EXPONENT);
    let knee = KNEE * most;
    let error = |pixel: usize| {
        // A line from 0 to the knee takes 95 % of the range, and a flatter one the rest: large
        // differences of colour are all about equally visible.
        let distance = hyab(image.lab[pixel], truth.lab[pixel]).powf(COLOR_EXPONENT);
        let color = if distance < knee {
            KNEE_VALUE / knee * distance
        } else {
            KNEE_VALUE + (distance - knee) / (most - knee) * (1.0 - KNEE_VALUE)
        };
        let edges = (image.edges[pixel] - truth.edges[pixel]).abs();
        let points = (image.points[pixel] - truth.points[pixel]).abs();
        // A strength is a hypotenuse of two axes with at most 1 each, hence the division by root 2.
        let feature = (edges.max(points) / 2.0_f32.sqrt()).powf(FEATURE_EXPONENT);
        // The base is at most 1, so that a smaller exponent raises the error.
        color.powf(1.0 - feature)
    };
    (0..width * height).into_par_iter().map(error).collect()
}

/// The features of an image that are compared.
struct Perceived {
    /// Blurred colours in the Hunt-adjusted L*a*b*.
    lab: Vec<[f32; 3]>,
    edges: Plane,
    /// Strength of points and lines.
    points: Plane,
}

impl Perceived {
    fn new(srgb: &[f32], width: usize) -> Self {
        let opponent: Vec<[f32; 3]> = srgb
            .par_chunks_exact(3)
            .map(|rgb| opponent([rgb[0], rgb[1], rgb[2]].map(linear)))
            .collect();
        let channel = |c: usize| -> Plane { opponent.iter().map(|color| color[c]).collect() };
        let blurred = [0, 1, 2].map(|c| blur(&channel(c), width, SENSITIVITY[c]));
        let lab_at = |pixel: usize| {
            let color = [0, 1, 2].map(|c: usize| blurred[c][pixel]);
            // The blur of the opponent channels may leave the gamut of the display.
            hunt_lab(linear_of_opponent(color).map(|value| value.clamp(0.0, 1.0)))
        };
        let lab = (0..opponent.len()).into_par_iter().map(lab_at).collect();
        let brightness: Plane = opponent.iter().map(|[y, ..]| (y + 16.0) / 116.0).collect();
        // A feature's kernel along one axis, and the smooth one along the other: both directions.
        let [smooth, edge, point] = feature_kernels();
        let strength = |kernel: &[f32]| -> Plane {
            let across = convolved(&brightness, width, kernel, &smooth);
            let down = convolved(&brightness, width, &smooth, kernel);
            across.iter().zip(&down).map(|(x, y)| x.hypot(*y)).collect()
        };
        Self { lab, edges: strength(&edge), points: strength(&point) }
    }
}

/// sRGB to linear (IEC 61966-2-1).
fn linear(value: f32) -> f32 {
    let value = value.clamp(0.0, 1.0);
    if value > 0.04045 { ((value + 0.055) / 1.055).powf(2.4) } else { value / 12.92 }
}

fn multiply(matrix: &[[f64; 3]; 3], [x, y, z]: [f32; 3]) -> [f32; 3] {
    matrix.map(|row| row[0] as f32 * x + row[1] as f32 * y + row[2] as f32 * z)
}

/// Linear RGB in the opponent space YCxCz.
fn opponent(rgb: [f32; 3]) -> [f32; 3] {
    let xyz = multiply(&XYZ_FROM_RGB, rgb);
    let [x, y, z] = [0, 1, 2].map(|c| xyz[c] / WHITE[c]);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

fn linear_of_opponent([y, cx, cz]: [f32; 3]) -> [f32; 3] {
    let y = (y + 16.0) / 116.0;
    let xyz = [y + cx / 500.0, y, y - cz / 200.0];
    multiply(&RGB_FROM_XYZ, [0, 1, 2].map(|c| xyz[c] * WHITE[c]))
}

/// Linear RGB in L*a*b*, with a* and b* weaker in the dark (Hunt's effect).
fn hunt_lab(rgb: [f32; 3]) -> [f32; 3] {
    let xyz = multiply(&XYZ_FROM_RGB, rgb);
    let delta = 6.0_f32 / 29.0;
    let response = |value: f32| {
        if value > delta.powi(3) {
            value.cbrt()
        } else {
            value / (3.0 * delta * delta) + 4.0 / 29.0
        }
    };
    let [x, y, z] = [0, 1, 2].map(|c| response(xyz[c] / WHITE[c]));
    let lightness = 116.0 * y - 16.0;
    let chroma = 0.01 * lightness;
    [lightness, chroma * 500.0 * (x - y), chroma * 200.0 * (y - z)]
}

/// Distance of two colours: difference in lightness plus distance in chroma.
fn hyab(a: [f32; 3], b: [f32; 3]) -> f32 {
    (a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])
}

/// A plane blurred by a sum of two Gaussians. Each is separable, their sum is not.
fn blur(plane: &[f32], width: usize, gaussians: [(f64, f64); 2]) -> Plane {
    // A Gaussian exp(-pi^2 x^2/b) has the standard deviation root(b/2)/pi; three of the widest,
    // from degrees to pixels.
    let reach = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil() as i32;
    let kernel = |scale: f64| -> Vec<f64> {
        let at = |k: i32| (-(PI * f64::from(k) / PIXELS_PER_DEGREE).powi(2) / scale).exp();
        (-reach..=reach).map(at).collect()
    };
    let parts = gaussians.map(|(amplitude, scale)| {
        let kernel = kernel(scale);
        let along: f64 = kernel.iter().sum();
        // Weight of this Gaussian in two dimensions: its factor a root(pi/b), times the sum of the
        // kernel along both axes. What follows works with kernels of sum 1.
        let share = amplitude * (PI / scale).sqrt() * along * along;
        let unit: Vec<f32> = kernel.iter().map(|weight| (weight / along) as f32).collect();
        (share, unit)
    });
    let total: f64 = parts.iter().map(|(share, _)| share).sum();
    let mut sum = vec![0.0; plane.len()];
    // The first two channels have one Gaussian only, and need no second pass.
    for (share, kernel) in parts.iter().filter(|(share, _)| *share > 0.0) {
        let share = (share / total) as f32;
        let part = convolved(plane, width, kernel, kernel);
        sum.iter_mut().zip(part).for_each(|(sum, value)| *sum += share * value);
    }
    sum
}

/// Kernels of features along an axis: a smooth one across the feature's own axis, that of edges,
/// and that of points. In two dimensions positive and negative weights of edges and of points sum
/// to 1 each.
fn feature_kernels() -> [Vec<f32>; 3] {
    let sigma_px = 0.5 * FEATURE_DEG * PIXELS_PER_DEGREE;
    let reach = (3.0 * sigma_px).ceil() as i32;
    let gaussian = |x: f64| (-x * x / (2.0 * sigma_px * sigma_px)).exp();
    let kernel = |weight: &dyn Fn(f64) -> f64| -> Vec<f64> {
        (-reach..=reach).map(|k| weight(f64::from(k)) * gaussian(f64::from(k))).collect()
    };
    let unit = |weights: Vec<f64>| -> Vec<f32> {
        let positive: f64 = weights.iter().filter(|w| **w > 0.0).sum();
        let negative: f64 = -weights.iter().filter(|w| **w < 0.0).sum::<f64>();
        // Each sign by itself, so that a plane of one brightness has no feature.
        let scaled = |w: &f64| w / if *w < 0.0 { negative } else { positive };
        weights.iter().map(|w| scaled(w) as f32).collect()
    };
    [
        unit(kernel(&|_| 1.0)),
        // First and second derivative of the Gaussian, up to a factor.
        unit(kernel(&|x| -x)),
        unit(kernel(&|x| x * x / (sigma_px * sigma_px) - 1.0)),
    ]
}

/// Correlates a plane with a kernel along rows and another along columns. Beyond its edges the
/// plane continues with its last values.
fn convolved(plane: &[f32], width: usize, across: &[f32], down: &[f32]) -> Plane {
    let height = plane.len() / width;
    let reach = across.len() / 2;
    let mut along_rows = vec![0.0; plane.len()];
    along_rows.par_chunks_exact_mut(width).zip(plane.par_chunks_exact(width)).for_each(
        |(new, row)| {
            // A padded copy of the row avoids a test of the edges at every weight.
            let first = std::iter::repeat_n(row[0], reach);
            let last = std::iter::repeat_n(row[width - 1], reach);
            let padded: Vec<f32> = first.chain(row.iter().copied()).chain(last).collect();
            for (new, window) in new.iter_mut().zip(padded.windows(across.len())) {
                *new = window.iter().zip(across).map(|(value, weight)| value * weight).sum();
            }
        },
    );
    let mut new = vec![0.0; plane.len()];
    new.par_chunks_exact_mut(width).enumerate().for_each(|(row, new)| {
        // Whole rows at a time, since a walk down a column misses the caches at every step.
        for (k, weight) in down.iter().enumerate() {
            let from = (row + k).saturating_sub(reach).min(height - 1) * width;
            for (sum, value) in new.iter_mut().zip(&along_rows[from..from + width]) {
                *sum += weight * value;
            }
        }
    });
    new
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_image_has_no_error_and_green_for_blue_the_largest() {
        let image = [0.2, 0.5, 0.9].repeat(40 * 30);
        assert_eq!(flip(&image, &image, [40, 30]), vec![0.0; 40 * 30]);
        let green = [0.0, 1.0, 0.0].repeat(40 * 30);
        let blue = [0.0, 0.0, 1.0].repeat(40 * 30);
        let errors = flip(&green, &blue, [40, 30]);
        assert!(errors.iter().all(|error| (error - 1.0).abs() < 1e-4), "{}", errors[0]);
    }

    #[test]
    fn an_image_of_one_pixel_is_compared() {
        let errors = flip(&[1.0; 3], &[0.0; 3], [1, 1]);
        assert!(errors.len() == 1 && errors[0] > 0.9, "{errors:?}");
    }
}
