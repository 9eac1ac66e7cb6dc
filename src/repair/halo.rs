//! Measures the halo: the distance within which a pixel of the output depends on the input.
//!
//! A NaN goes into one pixel of every input that has pixels. Sums and products carry it on whatever
//! the other values are, so the outputs that become NaN are all that depend on that pixel. (A small
//! change of the value may vanish in an activation and then shows too little.) With strides the
//! answer depends on the phase of the pixel, so each is tried. An operation that does not propagate
//! NaN would hide a dependency, so the caller compares tiles with the whole image once, before it
//! relies on the halo.

use crate::error::RepairError;
use crate::limits::MAX_HALO_PROBE_PX;
use crate::planes::Planes;

/// Pixels in a row and in a column that are tried in a model of a fixed size: enough for strides up
/// to 8.
const FIXED_PHASES: usize = 8;

/// The distance within which the output depends on the input.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Halo {
    /// At most this number of pixels of the input, in each direction.
    Pixels(usize),
    /// On the whole image, or on more than the probe could show.
    Whole,
}

/// Runs a model: planes of each input with pixels to planes of the output. A NaN in the output is
/// not an error.
pub(crate) type Run<'a> = dyn FnMut(&[Planes]) -> Result<Planes, RepairError> + 'a;

/// The model that is probed.
pub(crate) struct Probe {
    /// Channels of each input with pixels, and its range.
    pub(crate) inputs: Vec<(usize, [f32; 2])>,
    pub(crate) multiple_of: usize,
    /// Height and width, if the model takes no other.
    pub(crate) fixed: Option<[usize; 2]>,
    pub(crate) scale: usize,
}

impl Probe {
    /// Measures the halo in images that grow until it fits.
    pub(crate) fn halo(&self, run: &mut Run<'_>) -> Result<Halo, RepairError> {
        // At least four multiples, so that the border is more than one of them away from the
        // middle.
        let largest = MAX_HALO_PROBE_PX.max(4 * self.multiple_of);
        let mut side = 64_usize.next_multiple_of(self.multiple_of).max(4 * self.multiple_of);
        loop {
            let size = self.fixed.unwrap_or([side; 2]);
            // A NaN that reaches the border may reach farther: the image is doubled.
            if let Halo::Pixels(halo) = self.halo_at(size, run)? {
                return Ok(Halo::Pixels(halo));
            }
            if self.fixed.is_some() || side >= largest {
                return Ok(Halo::Whole);
            }
            side *= 2;
        }
    }

    fn halo_at(&self, [height, width]: [usize; 2], run: &mut Run<'_>) -> Result<Halo, RepairError> {
        let mut halo = 0;
        // The strides of a model of a fixed size are not known: windows of it begin anywhere.
        let phases = if self.fixed.is_some() { FIXED_PHASES } else { self.multiple_of };
        for phase in 0..phases {
            // A multiple near the middle, so that all phases of the strides are tried in turn.
            let middle = |side: usize| {
                (side / 2 / self.multiple_of * self.multiple_of + phase).min(side - 1)
            };
            let y = middle(height);
            let x = middle(width);
            let mut inputs = self.images(height, width);
            for planes in &mut inputs {
                // All inputs at once: the halo is that of the output on any of them.
                for channel in 0..planes.channels {
                    planes.row_mut(channel, y)[x] = f32::NAN;
                }
            }
            let output = run(&inputs)?;
            match reach(&output, [y, x], self.scale) {
                Some(reach) => halo = halo.max(reach),
                None => return Ok(Halo::Whole),
            }
        }
        Ok(Halo::Pixels(halo))
    }

    /// Test images, equal in every call: a pattern with all frequencies, in the range of each
    /// input.
    pub(crate) fn images(&self, height: usize, width: usize) -> Vec<Planes> {
        let image = |(at, (channels, [black, white])): (usize, &(usize, [f32; 2]))| {
            let mut planes = Planes::zeros(*channels, height, width);
            // The golden ratio's bits; another start for each input, and never 0, which
            // xorshift keeps.
            let mut state = 0x9e37_79b9_u32 ^ at as u32;
            for value in &mut planes.values {
                // xorshift32 (Marsaglia 2003); 24 bits are a fraction of f32.
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                *value = black + (white - black) * ((state >> 8) as f32 / 16_777_216.0);
            }
            planes
        };
        self.inputs.iter().enumerate().map(image).collect()
    }
}

/// Largest distance of a NaN from the pixel, in pixels of the input. `None` if a NaN is at the
/// border, because more may lie beyond it, or if there is no NaN, because the model then hides
/// them.
fn reach(output: &Planes, [y, x]: [usize; 2], scale: usize) -> Option<usize> {
    let mut reach = None;
    for channel in 0..output.channels {
        for at_y in 0..output.height {
            for (at_x, value) in output.row(channel, at_y).iter().enumerate() {
                if !value.is_nan() {
                    continue;
                }
                let is_border = [at_y, at_x].contains(&0)
                    || at_y + 1 == output.height
                    || at_x + 1 == output.width;
                if is_border {
                    return None;
                }
                // The pixel of the input below this one of the output. The larger of both axes: a
                // halo is a square.
                let distance = (at_y / scale).abs_diff(y).max((at_x / scale).abs_diff(x));
                reach = reach.max(Some(distance));
            }
        }
    }
    reach
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A model that takes the mean of 4 x 4 pixels for each of them: from 0 to 3 pixels far, by the
    /// phase.
    fn means_of_four(inputs: &[Planes]) -> Result<Planes, RepairError> {
        // In whole blocks of 4 x 4, so that the last pixel of a block depends on the first, three
        // pixels away, and no pixel of a block on the next block.
        let input = &inputs[0];
        let mut output = Planes::zeros(1, input.height, input.width);
        for y in 0..input.height {
            for x in 0..input.width {
                let mut sum = 0.0;
                for row in y / 4 * 4..(y / 4 * 4 + 4).min(input.height) {
                    sum += input.row(0, row)[x / 4 * 4..(x / 4 * 4 + 4).min(input.width)]
                        .iter()
                        .sum::<f32>();
                }
                output.row_mut(0, y)[x] = sum / 16.0;
            }
        }
        Ok(output)
    }

    #[test]
    fn the_halo_is_the_largest_of_all_phases_also_of_a_fixed_size() {
        let probe = |multiple_of, fixed| Probe {
            inputs: vec![(1, [0.0, 1.0])],
            multiple_of,
            fixed,
            scale: 1,
        };
        // Without a fixed size four phases are tried, with one eight; both include the farthest.
        assert_eq!(probe(4, None).halo(&mut means_of_four).unwrap(), Halo::Pixels(3));
        assert_eq!(probe(1, Some([40, 24])).halo(&mut means_of_four).unwrap(), Halo::Pixels(3));
    }
}
