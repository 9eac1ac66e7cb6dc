//! From the images of the Gaussians to those of a camera: `E(C + (1 - A) B)` with the colours C and
//! opacity A of the Gaussians, the background or sky B, and the exposure E, an affine map of
//! colours.
//!
//! As the renderer does, the sky is left out where less than 1/255 of it shows, which a loss of 8
//! bits cannot see; a background of one colour is added everywhere.

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

/// The image of a camera, `[height, width, 3]`.
pub fn compose<T: Real>(
    rgb: &[T],
    opacity: &[T],
    background: Background<'_, T>,
    exposure: &Exposure<T>,
) -> Vec<T> {
    let mut image = vec![T::zero(); rgb.len()];
    for (pixel, to) in image.chunks_exact_mut(3).enumerate() {
        let shows = T::one() - opacity[pixel];
        let behind = background.rgb(pixel);
        let before = std::array::from_fn(|c| rgb[3 * pixel + c] + shows * behind[c]);
        to.copy_from_slice(&exposure.apply(before));
    }
    image
}

/// The derivatives of a loss by all that [`compose`] takes, given those by its image.
pub fn compose_gradient<T: Real>(
    rgb: &[T],
    opacity: &[T],
    background: Background<'_, T>,
    exposure: &Exposure<T>,
    by_image: &[T],
) -> ComposedGradient<T> {
    let mut gradient = ComposedGradient {
        rgb: Vec::with_capacity(rgb.len()),
        opacity: Vec::with_capacity(opacity.len()),
        background: Vec::with_capacity(rgb.len()),
        exposure: Exposure { matrix: [[T::zero(); 3]; 3], offset: [T::zero(); 3] },
    };
    // In f64: a million products in f32 would lose three digits.
    let mut sums = [[0.0; 4]; 3];
    for (pixel, by) in by_image.chunks_exact(3).enumerate() {
        let shows = T::one() - opacity[pixel];
        let behind = background.rgb(pixel);
        let before: [T; 3] = std::array::from_fn(|c| rgb[3 * pixel + c] + shows * behind[c]);
        for (row, &by) in by.iter().enumerate() {
            for (to, value) in sums[row].iter_mut().zip([before[0], before[1], before[2], T::one()])
            {
                *to += by.to_double() * value.to_double();
            }
        }
        let by_before: [T; 3] =
            std::array::from_fn(|c| (0..3).map(|row| exposure.matrix[row][c] * by[row]).sum());
        gradient.rgb.extend(by_before);
        gradient.background.extend(by_before.map(|by| shows * by));
        let by_opacity = by_before.iter().zip(behind).map(|(&by, behind)| by * behind).sum::<T>();
        gradient.opacity.push(-by_opacity);
    }
    for (row, [r, g, b, offset]) in sums.into_iter().enumerate() {
        gradient.exposure.matrix[row] = [r, g, b].map(T::from_f64);
        gradient.exposure.offset[row] = T::from_f64(offset);
    }
    gradient
}
