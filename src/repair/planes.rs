//! Images as planes of f32, channel by channel.

use half::f16;

/// `channels` planes of `height` rows of `width` values.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Planes {
    pub(crate) channels: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) values: Vec<f32>,
}

/// A rectangle, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rect {
    pub(crate) top: usize,
    pub(crate) left: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
}

impl Rect {
    /// This rectangle in an image `by` times as large.
    pub(crate) fn scaled(self, by: usize) -> Rect {
        Rect {
            top: self.top * by,
            left: self.left * by,
            height: self.height * by,
            width: self.width * by,
        }
    }
}

impl Planes {
    pub(crate) fn zeros(channels: usize, height: usize, width: usize) -> Planes {
        Planes { channels, height, width, values: vec![0.0; channels * height * width] }
    }

    pub(crate) fn at(&self, channel: usize, y: usize, x: usize) -> f32 {
        self.values[(channel * self.height + y) * self.width + x]
    }

    pub(crate) fn row(&self, channel: usize, y: usize) -> &[f32] {
        let start = (channel * self.height + y) * self.width;
        &self.values[start..start + self.width]
    }

    pub(crate) fn row_mut(&mut self, channel: usize, y: usize) -> &mut [f32] {
        let start = (channel * self.height + y) * self.width;
        &mut self.values[start..start + self.width]
    }

    pub(crate) fn map(mut self, f: impl Fn(f32) -> f32) -> Planes {
        self.values.iter_mut().for_each(|value| *value = f(*value));
        self
    }

    /// The values that an f16 can have.
    pub(crate) fn rounded_to_f16(self) -> Planes {
        self.map(|value| f16::from_f32(value).to_f32())
    }

    pub(crate) fn crop(&self, rect: Rect) -> Planes {
        let mut cropped = Planes::zeros(self.channels, rect.height, rect.width);
        cropped.paste(self, rect, 0, 0);
        cropped
    }

    /// Copies the rectangle `from` of `source` to the place that begins at `top`, `left`.
    pub(crate) fn paste(&mut self, source: &Planes, from: Rect, top: usize, left: usize) {
        // Row by row: a row of the rectangle is contiguous in both.
        for channel in 0..self.channels {
            for y in 0..from.height {
                let row = &source.row(channel, from.top + y)[from.left..from.left + from.width];
                self.row_mut(channel, top + y)[left..left + from.width].copy_from_slice(row);
            }
        }
    }

    /// Larger planes. The added pixels, on the right and below, mirror the image at its last pixel.
    pub(crate) fn padded(&self, height: usize, width: usize) -> Planes {
        if self.height == height && self.width == width {
            return self.clone();
        }
        let mut padded = Planes::zeros(self.channels, height, width);
        for channel in 0..self.channels {
            for y in 0..height {
                // Rows and columns mirror independently of each other.
                let source = self.row(channel, mirrored(y, self.height));
                for (x, value) in padded.row_mut(channel, y).iter_mut().enumerate() {
                    *value = source[mirrored(x, self.width)];
                }
            }
        }
        padded
    }
}

/// The index below `len` that `at` mirrors: 0, 1, 2, 1, 0, 1, .. for three.
fn mirrored(at: usize, len: usize) -> usize {
    if len == 1 {
        return 0;
    }
    // Forth and back, without the two ends twice.
    let period = 2 * (len - 1);
    let phase = at % period;
    phase.min(period - phase)
}
