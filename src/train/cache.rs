//! Decoded images that are kept for the next time round, as many as a budget has room for.
//!
//! An image of a log costs its decoder and the sweeps of its LiDAR, which is more than a step on
//! it. The order of images is random, so that which ones are kept does not matter: the first are.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use wildcity_render::View;

use crate::images::{TrainingImage, TrainingImages};
use crate::poses::Place;

/// Images that are decoded once, as far as the budget has room.
pub struct CachedImages<'a> {
    images: &'a dyn TrainingImages,
    budget_bytes: usize,
    kept: Mutex<Kept>,
}

#[derive(Default)]
struct Kept {
    images: HashMap<usize, TrainingImage>,
    bytes: usize,
}

impl<'a> CachedImages<'a> {
    /// Nothing is decoded yet.
    pub fn new(images: &'a dyn TrainingImages, budget_bytes: usize) -> Self {
        Self { images, budget_bytes, kept: Mutex::default() }
    }
}

impl TrainingImages for CachedImages<'_> {
    fn count(&self) -> usize {
        self.images.count()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.images.is_held_out(index)
    }

    fn is_augmented(&self, index: usize) -> bool {
        self.images.is_augmented(index)
    }

    fn place(&self, index: usize) -> Option<Place> {
        self.images.place(index)
    }

    fn view(&self, index: usize) -> View {
        self.images.view(index)
    }

    fn name(&self, index: usize) -> String {
        self.images.name(index)
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        // A panic of another thread leaves whole images, which are as good as before.
        let lock = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(image) = lock().images.get(&index) {
            return Ok(image.clone());
        }
        // Not under the lock: another thread may look at the images that are held out.
        let image = self.images.load(index)?;
        let mut kept = lock();
        let bytes = image.bytes();
        // Another thread may have decoded the same image meanwhile, and its bytes count once.
        if kept.bytes + bytes <= self.budget_bytes && !kept.images.contains_key(&index) {
            kept.bytes += bytes;
            kept.images.insert(index, image.clone());
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::geometry::{Camera, Pose};

    use super::*;

    struct Counted(AtomicUsize);

    impl TrainingImages for Counted {
        fn count(&self) -> usize {
            3
        }

        fn is_held_out(&self, _: usize) -> bool {
            false
        }

        fn place(&self, _: usize) -> Option<Place> {
            None
        }

        fn view(&self, _: usize) -> View {
            let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 5.0, cy: 5.0 };
            View::new(Camera::from_pinhole(10, 10, pinhole), Pose::IDENTITY)
        }

        fn name(&self, index: usize) -> String {
            index.to_string()
        }

        fn load(&self, index: usize) -> Result<TrainingImage, String> {
            self.0.fetch_add(1, Relaxed);
            Ok(TrainingImage {
                view: self.view(index),
                rgb8: vec![index as u8; 300],
                mask: None,
                sky: None,
                depth_m: None,
                weight: 1.0,
                exposure: 1.0,
            })
        }
    }

    #[test]
    fn images_are_decoded_once_as_far_as_there_is_room() {
        for (budget_bytes, decoded) in [(10_000, 3), (650, 5), (0, 9)] {
            let images = Counted(AtomicUsize::new(0));
            let cached = CachedImages::new(&images, budget_bytes);
            for index in [0, 1, 2, 2, 1, 0, 0, 1, 2] {
                assert_eq!(cached.load(index).unwrap().rgb8[0], index as u8);
            }
            assert_eq!(images.0.load(Relaxed), decoded);
        }
    }
}
