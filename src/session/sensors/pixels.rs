//! Noise, exposure and dirt: from the pixels of a rendered image to those of a sensor.
//!
//! All of it happens in linear light L, which [`wildcity_scene::srgb`] decodes from stored values.
//! For each pixel and channel,
//!
//! ```text
//! L' = L 2^e (1 - a)            e stops of exposure; dirt takes the fraction a of the light
//! L" = L' + σ(L') n             n normal; σ² = L'/N + (r/N)², for N electrons at full white and r of read noise
//! ```
//!
//! The result is clamped to 0 to 1 (a full pixel is white), encoded, and rounded. The noise is the
//! linear model of a sensor (EMVA Standard 1288, chapter 2; Foi, Trimeche, Katkovnik and
//! Egiazarian, "Practical Poissonian-Gaussian noise modeling", 2008), with the normal distribution
//! for that of Poisson. Dirt is out of focus, so that it has soft edges and only takes light (Gu,
//! Ramamoorthi, Belhumeur and Nayar, "Removing image artifacts due to dirty camera lenses and thin
//! occluders", 2009): in a spot of radius R, a = opacity (1 - s²(3 - 2s)) at s = (d/R - 1/2) 2,
//! clamped to 0 to 1, for the distance d. The light that passes several spots is multiplied.

use std::sync::LazyLock;

use wildcity_scene::random::{Random, mix};
use wildcity_scene::srgb::{linear_from_stored, stored_from_linear};

use super::draw::{drift, normal_table};
use wildcity_options::{CameraSensor, ImageNoise, LensDirt};

use super::settings::changes_pixels;

/// The effects on one image.
#[derive(Clone, Debug)]
pub(crate) struct PixelEffects {
    noise: Option<ImageNoise>,
    /// Key of the noise of this image.
    key: u64,
    /// Offset of the exposure, in stops.
    pub(crate) stops: Option<f64>,
    spots: Vec<Spot>,
    opacity: f32,
}

/// A spot of dirt; lengths in widths of the image.
#[derive(Clone, Copy, Debug)]
struct Spot {
    x: f32,
    y: f32,
    radius: f32,
}

/// Steps of the table that encodes linear light: 20 to the darkest of the 256 values.
const ENCODE_STEPS: usize = 1 << 16;

/// Linear light of each stored value.
static LINEAR: LazyLock<[f32; 256]> =
    LazyLock::new(|| std::array::from_fn(|value| linear_from_stored(value as f64 / 255.0) as f32));

/// The stored value of linear light in steps.
static STORED: LazyLock<Box<[u8]>> = LazyLock::new(|| {
    let stored = |step: usize| stored_from_linear(step as f64 / (ENCODE_STEPS - 1) as f64);
    (0..ENCODE_STEPS).map(|step| (255.0 * stored(step)).round() as u8).collect()
});

impl PixelEffects {
    /// The effects on the picture that a camera takes at a time, in microseconds; `None` if it has
    /// none.
    pub(crate) fn new(
        sensor: &CameraSensor,
        seed: u64,
        camera: &str,
        taken_us: i64,
        [width, height]: [u32; 2],
    ) -> Option<Self> {
        if !changes_pixels(sensor) {
            return None;
        }
        // Lengths are in widths of the image, so that spots are round.
        let aspect = f64::from(height) / f64::from(width);
        let stops = sensor.exposure.map(|exposure| {
            let name = format!("{camera}/exposure");
            exposure.stops * drift(seed, &name, exposure.period_us, taken_us)
        });
        // The time is the index, so that two pictures have different noise, and one picture always
        // the same.
        let key = Random::new(seed, &format!("{camera}/noise"), taken_us as usize).seed();
        Some(Self {
            noise: sensor.noise,
            key,
            stops,
            spots: sensor.dirt.map_or(Vec::new(), |dirt| spots(&dirt, seed, camera, aspect)),
            opacity: sensor.dirt.map_or(0.0, |dirt| dirt.opacity as f32),
        })
    }

    /// Changes the pixels of an image, `[height, width, 3]`.
    pub(crate) fn apply(&self, rgb8: &mut [u8], width: usize) {
        let normal = normal_table();
        let gain = self.stops.unwrap_or(0.0).exp2() as f32;
        // σ² = L (1 / N) + (r / N)².
        let [per_light, dark] = self.noise.map_or([0.0; 2], |noise| {
            [1.0 / noise.full_well, (noise.read / noise.full_well).powi(2)].map(|one| one as f32)
        });
        // Without spots, all pixels of all rows get the same share.
        let mut passing = vec![gain; width];
        for (row, pixels) in rgb8.chunks_exact_mut(3 * width).enumerate() {
            if !self.spots.is_empty() {
                passing.fill(gain);
                self.pass_spots(row, &mut passing);
            }
            let first = row * width;
            for (column, (pixel, &passing)) in
                pixels.as_chunks_mut::<3>().0.iter_mut().zip(&passing).enumerate()
            {
                let bits = match self.noise {
                    Some(_) => {
                        // A function of the pixel's number and not a running stream: rows may be
                        // computed in any order.
                        let counter = ((first + column) as u64).wrapping_mul(GOLDEN);
                        mix(self.key.wrapping_add(counter))
                    }
                    None => 0,
                };
                for (channel, value) in pixel.iter_mut().enumerate() {
                    let mut light = LINEAR[usize::from(*value)] * passing;
                    if self.noise.is_some() {
                        // 16 of the 64 bits for each of three channels.
                        let n = normal[(bits >> (16 * channel)) as usize & 0xFFFF];
                        // Light is not negative here, so that the root is real.
                        light += (light * per_light + dark).sqrt() * n;
                    }
                    // + 0.5 rounds to the nearest step. The largest is 65,535.5, which is cut to
                    // the last index.
                    let step = light.clamp(0.0, 1.0) * (ENCODE_STEPS - 1) as f32 + 0.5;
                    *value = STORED[step as usize];
                }
            }
        }
    }

    /// Multiplies the light of a row of pixels with the share that passes the spots.
    fn pass_spots(&self, row: usize, passing: &mut [f32]) {
        let width = passing.len() as f32;
        let y = (row as f32 + 0.5) / width;
        for &Spot { x, y: middle, radius } in &self.spots {
            let down = y - middle;
            // Half of the chord in which the row cuts the spot; 0 if it passes by.
            let half = (radius * radius - down * down).max(0.0).sqrt();
            if half == 0.0 {
                continue;
            }
            // Rounded outwards: at the edge of a spot s is 1, and nothing changes.
            let first = ((x - half) * width).max(0.0) as usize;
            let end = ((x + half) * width).ceil().clamp(0.0, width) as usize;
            for (column, passing) in passing.iter_mut().enumerate().take(end).skip(first) {
                let right = (column as f32 + 0.5) / width - x;
                let s = (2.0 * (right * right + down * down).sqrt() / radius - 1.0).clamp(0.0, 1.0);
                *passing *= 1.0 - self.opacity * (1.0 - s * s * (3.0 - 2.0 * s));
            }
        }
    }
}

/// SplitMix64's step: numbers at its multiples are those of one stream.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// The spots of a camera's lens in an episode: uniform over the image, with radii from a half to
/// one and a half times the mean.
fn spots(dirt: &LensDirt, seed: u64, camera: &str, aspect: f64) -> Vec<Spot> {
    let spot = |index: u64| {
        // Without the time: dirt stays where it is for an episode.
        let mut random = Random::new(seed, &format!("{camera}/dirt"), index as usize);
        Spot {
            x: random.unit() as f32,
            y: (aspect * random.unit()) as f32,
            radius: (dirt.radius * random.range(0.5, 1.5)) as f32,
        }
    };
    (0..dirt.spots).map(spot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_options::ExposureDrift;

    const WIDTH: u32 = 400;
    const HEIGHT: u32 = 250;

    fn applied(sensor: &CameraSensor, seed: u64, taken_us: i64, value: u8) -> Vec<u8> {
        let mut rgb8 = vec![value; 3 * (WIDTH * HEIGHT) as usize];
        let effects = PixelEffects::new(sensor, seed, "front", taken_us, [WIDTH, HEIGHT]).unwrap();
        effects.apply(&mut rgb8, WIDTH as usize);
        rgb8
    }

    fn noise(full_well: f64, read: f64) -> CameraSensor {
        let noise = Some(ImageNoise { full_well, read });
        CameraSensor { noise, ..CameraSensor::default() }
    }

    /// Mean and variance of the linear light of stored values.
    fn moments(rgb8: &[u8]) -> [f64; 2] {
        let light = || rgb8.iter().map(|&value| linear_from_stored(f64::from(value) / 255.0));
        let count = rgb8.len() as f64;
        let mean = light().sum::<f64>() / count;
        [mean, light().map(|one| (one - mean).powi(2)).sum::<f64>() / count]
    }

    /// The formula of the model, with the variance 1/12 of a rounded stored value on top.
    #[test]
    fn mean_and_variance_of_the_noise_are_those_of_the_formula_at_every_level() {
        for (full_well, read) in [(2000.0, 0.0), (2000.0, 30.0), (400.0, 5.0)] {
            for value in [60_u8, 90, 128, 160, 200] {
                let light = linear_from_stored(f64::from(value) / 255.0);
                let [mean, variance] = moments(&applied(&noise(full_well, read), 5, 0, value));
                let slope = (linear_from_stored((f64::from(value) + 1.0) / 255.0)
                    - linear_from_stored((f64::from(value) - 1.0) / 255.0))
                    / 2.0;
                let model = light / full_well + (read / full_well).powi(2);
                let expected = model + slope * slope / 12.0;
                // 300,000 samples: standard errors √(σ²/n) and σ² √(2/n) = 0.26 %. Rounding to a
                // curve adds 0.1 %.
                let error = (expected / 3e5).sqrt();
                assert!((mean - light).abs() < 5.0 * error + 1e-5, "{full_well} {value}: {mean}");
                let off = variance / expected - 1.0;
                assert!(off.abs() < 0.02, "{full_well} {read} {value}: {variance} {expected}");
            }
        }
    }

    #[test]
    fn noise_is_white_and_channels_are_independent() {
        let rgb8 = applied(&noise(400.0, 5.0), 1, 0, 128);
        let [mean, variance] = moments(&rgb8);
        let light: Vec<f64> =
            rgb8.iter().map(|&value| linear_from_stored(f64::from(value) / 255.0) - mean).collect();
        let width = 3 * WIDTH as usize;
        for apart in [1, 2, 3, width, width + 3] {
            let pairs = light.iter().zip(&light[apart..]).map(|(a, b)| a * b);
            let correlation = pairs.sum::<f64>() / light.len() as f64 / variance;
            // The correlation of n independent pairs has a standard error of 1/√n.
            assert!(correlation.abs() < 5.0 / 3e5_f64.sqrt(), "{apart}: {correlation}");
        }
    }

    #[test]
    fn seed_camera_and_time_decide_the_noise_alone() {
        let sensor = noise(1000.0, 5.0);
        let one = applied(&sensor, 1, 100_000, 128);
        assert_eq!(one, applied(&sensor, 1, 100_000, 128));
        assert_ne!(one, applied(&sensor, 2, 100_000, 128));
        assert_ne!(one, applied(&sensor, 1, 200_000, 128));
        let mut rear = vec![128; one.len()];
        let effects = PixelEffects::new(&sensor, 1, "rear", 100_000, [WIDTH, HEIGHT]).unwrap();
        effects.apply(&mut rear, WIDTH as usize);
        assert_ne!(one, rear);
    }

    #[test]
    fn exposure_multiplies_linear_light() {
        let exposure = ExposureDrift { stops: 1.0, period_us: 1_000_000 };
        let sensor = CameraSensor { exposure: Some(exposure), ..CameraSensor::default() };
        for taken_us in [0, 400_000, 7_300_000] {
            let stops = drift(9, "front/exposure", 1_000_000, taken_us);
            let expected = 255.0
                * stored_from_linear((linear_from_stored(90.0 / 255.0) * stops.exp2()).min(1.0));
            let [value, ..] = applied(&sensor, 9, taken_us, 90)[..] else { panic!("no pixels") };
            // Half a stored value from rounding, and a little from the table.
            assert!((f64::from(value) - expected).abs() < 0.6, "{value} {expected}");
        }
        let still = ExposureDrift { stops: 0.0, period_us: 1_000_000 };
        let sensor = CameraSensor { exposure: Some(still), ..CameraSensor::default() };
        for value in 0..=255 {
            assert_eq!(applied(&sensor, 9, 0, value)[0], value, "nothing is lost");
        }
    }

    #[test]
    fn dirt_darkens_spots_and_stays() {
        let dirt = LensDirt { spots: 6, radius: 0.05, opacity: 1.0 };
        let sensor = CameraSensor { dirt: Some(dirt), ..CameraSensor::default() };
        let rgb8 = applied(&sensor, 4, 0, 200);
        assert_eq!(rgb8, applied(&sensor, 4, 900_000, 200), "it does not move");
        let pixels = (WIDTH * HEIGHT) as f64;
        let black = rgb8.iter().step_by(3).filter(|&&value| value == 0).count() as f64;
        let clean = rgb8.iter().step_by(3).filter(|&&value| value == 200).count() as f64;
        // The black part of a spot has half its radius; E[r²] = 0.05² (1 + 1/12), in widths. Spots
        // overlap and are cut.
        let area =
            6.0 * std::f64::consts::PI * 0.0025 * (1.0 + 1.0 / 12.0) * f64::from(WIDTH * WIDTH);
        assert!(black > 0.1 * area / 4.0 && black < 2.0 * area / 4.0, "{black} of {area}");
        assert!(clean > pixels - 2.0 * area && clean < pixels - 0.3 * area, "{clean}");
    }
}
