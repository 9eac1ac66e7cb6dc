//! From the images of the Gaussians to those of a camera: `E(C + (1 - A) B)` with the colours C and
//! opacity A of the Gaussians, the background or sky B, and the exposure E, an affine map of
//! colours.
//!
//! As the renderer does, the sky is left out where less than 1/255 of it shows, which a loss of 8
//! bits cannot see; a background of one colour is added everywhere.

use rayon::prelude::*;

use crate::loss::Real;

/// What lies behind the Gaussians.
#[derive(Clone, Copy, Debug)]
pub enum Background<'a, T> {
    Color([T; 3]),
    /// `[height, width, 3]`: a colour for each pixel, such as those of a sky.
    Image(&'a [T]),
}

/// An affine map of colours: `matrix rgb + offset`, the matrix row by row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure<T> {
    pub matrix: [[T; 3]; 3],
    pub offset: [T; 3],
}

/// The derivatives of a loss through [`compose`].
#[derive(Clone, Debug, PartialEq)]
pub struct ComposedGradient<T> {
    /// By the colours of the Gaussians, `[height, width, 3]`.
    pub rgb: Vec<T>,
    /// By their opacity, `[height, width]`.
    pub opacity: Vec<T>,
    /// By the background's colour in each pixel, `[height, width, 3]`. Their sum is that by a
    /// background of one colour.
    pub background: Vec<T>,
    pub exposure: Exposure<T>,
}

impl<T: Real> Exposure<T> {
    /// Colours as they are.
    pub fn identity() -> Self {
        let mut matrix = [[T::zero(); 3]; 3];
        for (k, row) in matrix.iter_mut().enumerate() {
            row[k] = T::one();
        }
        Self { matrix, offset: [T::zero(); 3] }
    }

    /// All colours times a factor.
    pub fn gain(factor: T) -> Self {
        let matrix = Self::identity().matrix.map(|row| row.map(|value| value * factor));
        Self { matrix, offset: [T::zero(); 3] }
    }

    /// Whether the squares of all values are finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.matrix.iter().flatten().chain(&self.offset).all(|&v| (v * v).is_finite())
    }

    fn apply(&self, rgb: [T; 3]) -> [T; 3] {
        std::array::from_fn(|k| {
            let [r, g, b] = self.matrix[k];
            r * rgb[0] + g * rgb[1] + b * rgb[2] + self.offset[k]
        })
    }
}

impl<T: Real> Background<'_, T> {
    fn rgb(&self, pixel: usize) -> [T; 3] {
        match self {
            Self::Color(rgb) => *rgb,
            Self::Image(image) => [0, 1, 2].map(|c| image[3 * pixel + c]),
        }
    }
}

/// Pixels of a part of an image. Sums of a part are added in the order of the parts, so that they
/// are the same at any number of threads.
const PART: usize = 1 << 12;

/// Pixels whose products are summed in `T`: a million of them in f32 would lose three digits.
const FEW: usize = 64;

/// The image of a camera, `[height, width, 3]`.
///
/// # Panics
/// The images are not of one size.
pub fn compose<T: Real>(
    rgb: &[T],
    opacity: &[T],
    background: Background<'_, T>,
    exposure: &Exposure<T>,
) -> Vec<T> {
    assert_eq!(rgb.len(), 3 * opacity.len(), "colours and opacities of as many pixels");
    let mut image = vec![T::zero(); rgb.len()];
    let parts = image.par_chunks_mut(3 * PART).zip(rgb.par_chunks(3 * PART)).enumerate();
    parts.for_each(|(part, (image, rgb))| {
        let pixels = image.as_chunks_mut().0.iter_mut().zip(rgb.as_chunks().0);
        // Pixels are counted through the image, since the opacity and the background are not
        // divided.
        for (pixel, (to, rgb)) in (part * PART..).zip(pixels) {
            let shows = T::one() - opacity[pixel];
            *to = exposure.apply(before(rgb, shows, background.rgb(pixel)));
        }
    });
    image
}

/// A colour before the exposure.
fn before<T: Real>(rgb: &[T; 3], shows: T, behind: [T; 3]) -> [T; 3] {
    [0, 1, 2].map(|c| rgb[c] + shows * behind[c])
}

/// The derivatives of a loss by all that [`compose`] takes, given those by its image.
///
/// # Panics
/// The images are not of one size.
pub fn compose_gradient<T: Real>(
    rgb: &[T],
    opacity: &[T],
    background: Background<'_, T>,
    exposure: &Exposure<T>,
    by_image: &[T],
) -> ComposedGradient<T> {
    let lengths = [rgb.len(), by_image.len()];
    assert_eq!(lengths, [3 * opacity.len(); 2], "colours and opacities of as many pixels");
    let zeros = |of: &[T]| vec![T::zero(); of.len()];
    let [mut by_rgb, mut by_background, mut by_opacity] = [rgb, rgb, opacity].map(zeros);
    let parts = by_rgb
        .par_chunks_mut(3 * PART)
        .zip(by_background.par_chunks_mut(3 * PART))
        .zip(by_opacity.par_chunks_mut(PART))
        .enumerate();
    let sums: Vec<[[f64; 4]; 3]> = parts
        .map(|(part, ((by_rgb, by_background), by_opacity))| {
            let mut sums = [[0.0; 4]; 3];
            let few = by_rgb
                .chunks_mut(3 * FEW)
                .zip(by_background.chunks_mut(3 * FEW))
                .zip(by_opacity.chunks_mut(FEW));
            let first = (part * PART..).step_by(FEW);
            for (first, ((by_rgb, by_background), by_opacity)) in first.zip(few) {
                let range = 3 * first..3 * first + by_rgb.len();
                let given =
                    rgb[range.clone()].as_chunks().0.iter().zip(by_image[range].as_chunks().0);
                let by = by_rgb.as_chunks_mut().0.iter_mut().zip(by_background.as_chunks_mut().0);
                let mut few_sums = [[T::zero(); 4]; 3];
                for (k, (given, (by_rgb, by_background))) in given.zip(by).enumerate() {
                    let (rgb, by): (&[T; 3], &[T; 3]) = given;
                    let shows = T::one() - opacity[first + k];
                    let behind = background.rgb(first + k);
                    let before = before(rgb, shows, behind);
                    for (sums, &by) in few_sums.iter_mut().zip(by) {
                        for (sum, before) in sums.iter_mut().zip(before) {
                            // A row of the matrix takes the colour before the exposure, and the
                            // offset takes 1.
                            *sum += by * before;
                        }
                        sums[3] += by;
                    }
                    let [r, g, b] = exposure.matrix;
                    // The transpose of the exposure's matrix leads the derivatives back.
                    *by_rgb = [0, 1, 2].map(|c| r[c] * by[0] + g[c] * by[1] + b[c] * by[2]);
                    *by_background = by_rgb.map(|by| shows * by);
                    // The background is weighted by 1 - opacity, hence the sign.
                    by_opacity[k] =
                        -(by_rgb[0] * behind[0] + by_rgb[1] * behind[1] + by_rgb[2] * behind[2]);
                }
                for (sum, few) in sums.as_flattened_mut().iter_mut().zip(few_sums.as_flattened()) {
                    *sum += few.to_double();
                }
            }
            sums
        })
        .collect();
    let sum = |row: usize, k: usize| T::from_f64(sums.iter().map(|sums| sums[row][k]).sum());
    ComposedGradient {
        rgb: by_rgb,
        opacity: by_opacity,
        background: by_background,
        exposure: Exposure {
            matrix: [0, 1, 2].map(|row| [0, 1, 2].map(|k| sum(row, k))),
            offset: [0, 1, 2].map(|row| sum(row, 3)),
        },
    }
}
