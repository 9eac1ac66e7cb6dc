//! Separable resampling: Lanczos 3 and Keys' bicubic. When an image is made smaller, the kernel is
//! widened by the ratio, as Pillow does, so that nothing aliases. Weights are normalised, also at
//! the border.

use std::f64::consts::PI;

use crate::planes::Planes;

/// A kernel, and how far it reaches in source pixels at ratio 1.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Kernel {
    Lanczos3,
    /// Keys 1981 with a = -0.5.
    Bicubic,
}

impl Kernel {
    fn reach(self) -> f64 {
        match self {
            Kernel::Lanczos3 => 3.0,
            Kernel::Bicubic => 2.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        let x = x.abs();
        match self {
            Kernel::Lanczos3 if x < 3.0 => sinc(x) * sinc(x / 3.0),
            Kernel::Bicubic if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
            Kernel::Bicubic if x < 2.0 => ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0,
            _ => 0.0,
        }
    }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) }
}

/// The source pixels of one new pixel: the first, and their weights.
struct Taps {
    first: usize,
    weights: Vec<f32>,
}

/// The planes at another size. The same size gives the same values.
pub(crate) fn resample(planes: &Planes, height: usize, width: usize, kernel: Kernel) -> Planes {
    if planes.height == height && planes.width == width {
        return planes.clone();
    }
    // Taps depend on the column only, and are the same for all rows and channels.
    let across = taps(planes.width, width, kernel);
    let down = taps(planes.height, height, kernel);
    // Across first, into an image of the old height; then down. Two passes of n taps
    // instead of n^2.
    let mut wide = Planes::zeros(planes.channels, planes.height, width);
    for channel in 0..planes.channels {
        for y in 0..planes.height {
            let source = planes.row(channel, y);
            for (value, taps) in wide.row_mut(channel, y).iter_mut().zip(&across) {
                let pairs = source[taps.first..].iter().zip(&taps.weights);
                *value = pairs.map(|(value, weight)| value * weight).sum();
            }
        }
    }
    let mut resampled = Planes::zeros(planes.channels, height, width);
    for channel in 0..planes.channels {
        for (y, taps) in down.iter().enumerate() {
            // Row by row and not pixel by pixel, so that memory is read in order.
            for (at, weight) in taps.weights.iter().enumerate() {
                let source = wide.row(channel, taps.first + at);
                let sums = resampled.row_mut(channel, y).iter_mut().zip(source);
                sums.for_each(|(sum, value)| *sum += value * weight);
            }
        }
    }
    resampled
}

fn taps(from: usize, to: usize, kernel: Kernel) -> Vec<Taps> {
    let ratio = from as f64 / to as f64;
    // A larger image is interpolated with the kernel as it is.
    let widened = ratio.max(1.0);
    let reach = kernel.reach() * widened;
    let tap = |at: usize| {
        // The centre of the new pixel, in the old image's coordinates.
        let center = (at as f64 + 0.5) * ratio;
        let first = (center - reach).floor().max(0.0) as usize;
        let end = ((center + reach).ceil() as usize).min(from);
        let weight = |source: usize| kernel.weight((source as f64 + 0.5 - center) / widened);
        // Less than the whole kernel at the border, hence the division.
        let sum: f64 = (first..end).map(weight).sum();
        Taps { first, weights: (first..end).map(|source| (weight(source) / sum) as f32).collect() }
    };
    (0..to).map(tap).collect()
}
