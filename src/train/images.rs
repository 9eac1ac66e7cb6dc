//! The images of a run.

use wildcity_render::View;

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

    /// Whether some pixel counts: what moves may hide all of an image.
    pub(crate) fn counts(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.contains(&true))
    }
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
