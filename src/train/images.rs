//! The images of a run.

use wildcity_render::View;
use wildcity_scene::geometry::CameraError;

use crate::poses::Place;

/// An image that has been decoded.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingImage {
    pub view: View,
    /// `[height, width, 3]`: red, green and blue.
    pub rgb8: Vec<u8>,
    /// `[height, width]`: the pixels that count; all without it.
    pub mask: Option<Vec<bool>>,
    /// `[height, width]`: the pixels that show the sky, where that is known.
    pub sky: Option<Vec<bool>>,
    /// `[height, width]`: measured depths in metres; 0 where there is none.
    pub depth_m: Option<Vec<f32>>,
    /// Factor of the losses, 1 for an image that was recorded.
    pub weight: f32,
    /// Recorded factor of all colours against the other images.
    pub exposure: f32,
}

impl TrainingImage {
    /// What it takes in memory.
    pub(crate) fn bytes(&self) -> usize {
        let flags = [&self.mask, &self.sky].into_iter().flatten().map(Vec::len).sum::<usize>();
        self.rgb8.len() + flags + 4 * self.depth_m.as_ref().map_or(0, Vec::len)
    }

    /// The image after it was halved some times, as far as it can be ([`halvings`]): each pixel is
    /// the mean of those that it covers. What is left over at the right and below is cut off. A
    /// clipped value may become one that is not, and its pixel darker than it was, until whole
    /// images correct it.
    ///
    /// # Errors
    /// The camera cannot be scaled.
    pub(crate) fn halved(self, times: u32) -> Result<Self, CameraError> {
        let [width, height] = self.view.camera.size_px().to_array().map(|px| px as usize);
        let factor = 1_usize << halvings(&self.view, times);
        if factor == 1 {
            return Ok(self);
        }
        let small = [width / factor, height / factor];
        let covered = small.map(|px| (px * factor) as u64);
        // Whole blocks only, so that the camera is scaled by the factor exactly.
        let covering = self.view.camera.cropped([0, 0], covered)?;
        let mut camera = covering.scaled(small[0] as u64, small[1] as u64)?;
        // As a photograph of this size: no filter of a larger one is part of it.
        camera.native_size_px = None;
        let blocks = Blocks { width, small, factor };
        let all = |flags: Vec<bool>| blocks.reduce(&flags, 1, |flags| flags.iter().all(|&is| is));
        Ok(Self {
            view: View { camera, ..self.view },
            rgb8: blocks.reduce(&self.rgb8, 3, |values| mean(values)),
            mask: self.mask.map(all),
            sky: self.sky.map(all),
            depth_m: self.depth_m.map(|depth_m| blocks.reduce(&depth_m, 1, middle)),
            ..self
        })
    }

    /// Whether some pixel counts: what moves may hide all of an image.
    pub(crate) fn counts(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.contains(&true))
    }
}

/// Least side of an image that was halved: four windows of D-SSIM, of 11 pixels each, and some
/// more.
const MIN_SIDE_PX: u32 = 48;

/// How often the image of a view is halved if it should be so many times. It stays large enough,
/// and one that is exposed row by row is divided evenly: a row that is cut off takes its share of
/// the exposure with it.
pub fn halvings(view: &View, wanted: u32) -> u32 {
    let sides_px = [view.camera.width_px, view.camera.height_px];
    let is_even = |times: u32| {
        view.rolling_shutter.is_none() || sides_px.iter().all(|px| px % (1 << times) == 0)
    };
    let is_large = |times: u32| sides_px.iter().all(|px| px >> times >= MIN_SIDE_PX);
    (1..=wanted).take_while(|&times| is_large(times) && is_even(times)).last().unwrap_or(0)
}

/// Squares of pixels of an image, each of which is a pixel of a smaller one.
#[derive(Clone, Copy)]
struct Blocks {
    /// Of the large image.
    width: usize,
    /// Width and height of the smaller one.
    small: [usize; 2],
    factor: usize,
}

impl Blocks {
    /// A value for each block and channel of an image.
    fn reduce<T: Copy>(
        self,
        values: &[T],
        channels: usize,
        one: impl Fn(&mut Vec<T>) -> T,
    ) -> Vec<T> {
        let Self { width, small: [small_width, small_height], factor } = self;
        let mut block = Vec::with_capacity(factor * factor);
        let mut reduced = Vec::with_capacity(small_width * small_height * channels);
        for y in 0..small_height {
            for x in 0..small_width {
                for channel in 0..channels {
                    block.clear();
                    for row in y * factor..(y + 1) * factor {
                        let begin = (row * width + x * factor) * channels + channel;
                        block.extend(values[begin..].iter().step_by(channels).take(factor));
                    }
                    reduced.push(one(&mut block));
                }
            }
        }
        reduced
    }
}

fn mean(values: &[u8]) -> u8 {
    let sum: u32 = values.iter().copied().map(u32::from).sum();
    let count = values.len() as u32;
    ((sum + count / 2) / count) as u8
}

/// The depth in the middle of those that were measured: the mean of a pole and what is behind it
/// would be a depth that nothing has.
fn middle(depths_m: &mut Vec<f32>) -> f32 {
    depths_m.retain(|&depth_m| depth_m > 0.0);
    depths_m.sort_by(f32::total_cmp);
    // Of an even number the nearer of the two in the middle, since their mean was not measured.
    depths_m.get(depths_m.len().saturating_sub(1) / 2).copied().unwrap_or(0.0)
}

/// The images of a run, by their numbers.
pub trait TrainingImages: Sync {
    /// The number of all images.
    fn count(&self) -> usize;

    /// Whether an image is kept from the run, to judge it.
    fn is_held_out(&self, index: usize) -> bool;

    /// The images that are kept from the run.
    fn held_out(&self) -> Vec<usize> {
        (0..self.count()).filter(|&index| self.is_held_out(index)).collect()
    }

    /// Whether an image was rendered and repaired, and not recorded: of these,
    /// [`augmented_share`](crate::settings::Settings::augmented_share) of the steps are made.
    fn is_augmented(&self, _: usize) -> bool {
        false
    }

    /// The poses of the run's rig that an image has; `None` for images without a rig.
    fn place(&self, index: usize) -> Option<Place>;

    /// The camera of an image at its whole size, at the recorded pose.
    fn view(&self, index: usize) -> View;

    /// The name of an image, for a person.
    fn name(&self, index: usize) -> String;

    /// Decodes an image.
    ///
    /// # Errors
    /// The error names the file, for a person.
    fn load(&self, index: usize) -> Result<TrainingImage, String>;
}

#[cfg(test)]
mod tests {
    use wildcity_render::RollingShutter;
    use wildcity_scene::geometry::camera::{Pinhole, ShutterDirection};
    use wildcity_scene::geometry::{Camera, Pose};

    use super::*;

    /// 201 x 99 px, with a value of its own for each pixel.
    fn image() -> TrainingImage {
        let pinhole = Pinhole { fx: 120.0, fy: 110.0, cx: 90.0, cy: 50.0 };
        let camera = Camera::from_pinhole(201, 99, pinhole);
        let pixels = camera.pixels();
        TrainingImage {
            view: View::new(camera, Pose::IDENTITY),
            rgb8: (0..3 * pixels).map(|k| (k * 7 % 251) as u8).collect(),
            mask: Some((0..pixels).map(|k| k != 202).collect()),
            sky: Some((0..pixels).map(|k| k % 201 < 3).collect()),
            // Of every other square, half of the pixels have one.
            depth_m: Some((0..pixels).map(|k| [9.0, 0.0, 4.0, 5.0][k % 201 % 4]).collect()),
            weight: 0.5,
            exposure: 2.0,
        }
    }

    #[test]
    fn a_pixel_is_the_mean_of_those_that_it_covers() {
        let whole = image();
        let half = image().halved(1).unwrap();
        let camera = &half.view.camera;
        assert_eq!([camera.width_px, camera.height_px], [100, 49]);
        assert_eq!(camera.native_size_px, None);
        let at = |x: usize, y: usize| u32::from(whole.rgb8[(y * 201 + x) * 3 + 1]);
        let sum = at(198, 96) + at(199, 96) + at(198, 97) + at(199, 97);
        assert_eq!(u32::from(half.rgb8[(48 * 100 + 99) * 3 + 1]), (sum + 2) / 4);
        // The middle of the pixel is seen where the corner of the four is.
        let ray = camera.unproject([99.5, 48.5].into()).unwrap();
        let same = whole.view.camera.unproject([199.0, 97.0].into()).unwrap();
        assert!((ray - same).length() < 1e-12, "{ray} {same}");
        // One pixel that does not count: the whole square does not.
        let mask = half.mask.unwrap();
        assert_eq!(mask.iter().position(|counts| !counts), Some(0));
        assert_eq!(mask.iter().filter(|counts| !**counts).count(), 1);
        // Of the sky's three columns one square is whole.
        let sky = half.sky.unwrap();
        assert_eq!(sky[..3], [true, false, false]);
        let depth_m = half.depth_m.unwrap();
        assert_eq!(depth_m[..4], [9.0, 4.0, 9.0, 4.0]);
        assert_eq!([half.weight, half.exposure], [0.5, 2.0]);
    }

    #[test]
    fn a_small_image_is_not_halved() {
        // A quarter would be 24 px high.
        assert_eq!(image().halved(2).unwrap(), image().halved(1).unwrap());
        let small = image().halved(1).unwrap();
        assert_eq!(small.clone().halved(3).unwrap(), small);
        assert_eq!(image().halved(0).unwrap(), image());
        // Row by row, and 201 px wide: a half would not have the last column.
        let mut rolling = image();
        rolling.view.rolling_shutter = Some(RollingShutter {
            direction: ShutterDirection::TopToBottom,
            world_from_camera_first: Pose::IDENTITY,
        });
        assert_eq!(rolling.clone().halved(1).unwrap(), rolling);
    }
}
