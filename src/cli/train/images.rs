//! The images of a capture as a run of training reads them.

use std::path::Path;

use anyhow::{Context, ensure};
use image::imageops::{self, FilterType};
use image::{ImageBuffer, Rgb};

use wildcity_eval::images::{ImageList, RealImage, picture};
use wildcity_render::View;
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_train::poses::Place;
use wildcity_train::run::{TrainingImage, TrainingImages};

use crate::cli::exit;

/// Images of lists, at a fraction of their size.
pub(super) struct ListedImages {
    images: Vec<ListedImage>,
    size: f64,
    held_out_every: usize,
}

struct ListedImage {
    image: RealImage,
    /// In the axes and the unit of the scene that is trained.
    world_from_camera: Pose,
}

impl TrainingImages for ListedImages {
    fn count(&self) -> usize {
        self.images.len()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.held_out_every > 0 && index.is_multiple_of(self.held_out_every)
    }

    fn place(&self, _: usize) -> Option<Place> {
        None
    }

    fn view(&self, index: usize) -> View {
        let ListedImage { image, world_from_camera } = &self.images[index];
        View::new(image.camera, *world_from_camera)
    }

    fn name(&self, index: usize) -> String {
        self.images[index].image.name.clone()
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        self.decode(&self.images[index]).map_err(|error| exit::chain(&error))
    }
}

impl ListedImages {
    /// No images yet. One of `held_out_every` is held out.
    pub(super) fn new(size: f64, held_out_every: usize) -> Self {
        Self { images: Vec::new(), size, held_out_every }
    }

    /// Adds the images of a list with their poses in the axes of the scene.
    ///
    /// # Errors
    /// An image is missing: each is looked at before a long run finds one that is.
    pub(super) fn add(&mut self, list: &ImageList, alignment: &Alignment) -> anyhow::Result<()> {
        list.every(1).into_iter().try_for_each(|image| self.add_one(image, alignment))
    }

    /// The same for one of a list.
    pub(super) fn add_one(
        &mut self,
        image: &RealImage,
        alignment: &Alignment,
    ) -> anyhow::Result<()> {
        let file = &image.file;
        ensure!(file.is_file(), "there is no image {}: give --image-dir", file.display());
        let world_from_camera = alignment.pose(&image.world_from_camera);
        self.images.push(ListedImage { image: image.clone(), world_from_camera });
        Ok(())
    }

    /// The recorded pose of each image.
    pub(super) fn poses(&self) -> Vec<Pose> {
        self.images.iter().map(|image| image.world_from_camera).collect()
    }

    /// A text by which a checkpoint knows its images.
    pub(super) fn inputs(&self) -> String {
        let mut text = format!("{} {}\n", self.size, self.held_out_every);
        for ListedImage { image, world_from_camera } in &self.images {
            let RealImage { name, camera, file, mask, depth, weight, exposure_stops, .. } = image;
            text +=
                &format!("{name} {camera:?} {world_from_camera:?} {weight:?} {exposure_stops:?}");
            // Sizes stand for contents, which would take long to hash.
            for file in [Some(file), mask.as_ref(), depth.as_ref()] {
                text +=
                    &format!(" {:?}", file.and_then(|file| file.metadata().ok()).map(|m| m.len()));
            }
            text.push('\n');
        }
        text
    }

    fn decode(&self, listed: &ListedImage) -> anyhow::Result<TrainingImage> {
        let image = &listed.image;
        let Shrunk { rgb8, mask, camera, own_px } =
            Shrunk::read(&image.file, image.mask.as_deref(), &image.camera, self.size)?;
        let depth_m = image.depth.as_deref().map(|file| picture::depth_m(file, own_px));
        let small_px = [camera.width_px, camera.height_px];
        let depth_m = depth_m.transpose()?.map(|depth_m| shrink(&depth_m, own_px, small_px));
        let view = View::new(camera, listed.world_from_camera);
        let weight = image.weight.map_or(1.0, |weight| weight as f32);
        let exposure = factor(image.exposure_stops);
        Ok(TrainingImage { view, rgb8, mask, sky: None, depth_m, weight, exposure })
    }
}

/// Recorded images, then views that were rendered and repaired. Only the first judge a run.
pub(super) struct WithAugmented<'a> {
    pub(super) recorded: &'a dyn TrainingImages,
    pub(super) augmented: &'a dyn TrainingImages,
}

impl TrainingImages for WithAugmented<'_> {
    fn count(&self) -> usize {
        self.recorded.count() + self.augmented.count()
    }

    fn is_held_out(&self, index: usize) -> bool {
        // A drawn image is no truth, by which a scene could be judged.
        !self.is_augmented(index) && self.recorded.is_held_out(index)
    }

    fn is_augmented(&self, index: usize) -> bool {
        index >= self.recorded.count()
    }

    fn place(&self, index: usize) -> Option<Place> {
        if self.is_augmented(index) { None } else { self.recorded.place(index) }
    }

    fn view(&self, index: usize) -> View {
        match index.checked_sub(self.recorded.count()) {
            None => self.recorded.view(index),
            Some(index) => self.augmented.view(index),
        }
    }

    fn name(&self, index: usize) -> String {
        match index.checked_sub(self.recorded.count()) {
            None => self.recorded.name(index),
            Some(index) => self.augmented.name(index),
        }
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        match index.checked_sub(self.recorded.count()) {
            None => self.recorded.load(index),
            Some(index) => self.augmented.load(index),
        }
    }
}

/// Some of all images.
pub(super) struct ChosenImages<'a> {
    pub(super) all: &'a dyn TrainingImages,
    /// Their numbers among all.
    pub(super) chosen: Vec<usize>,
}

impl TrainingImages for ChosenImages<'_> {
    fn count(&self) -> usize {
        self.chosen.len()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.all.is_held_out(self.chosen[index])
    }

    fn is_augmented(&self, index: usize) -> bool {
        self.all.is_augmented(self.chosen[index])
    }

    fn place(&self, index: usize) -> Option<Place> {
        self.all.place(self.chosen[index])
    }

    fn view(&self, index: usize) -> View {
        self.all.view(self.chosen[index])
    }

    fn name(&self, index: usize) -> String {
        self.all.name(self.chosen[index])
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        self.all.load(self.chosen[index])
    }
}

/// An image with its mask and its camera, at the size of a run.
pub(super) struct Shrunk {
    pub(super) rgb8: Vec<u8>,
    pub(super) mask: Option<Vec<bool>>,
    pub(super) camera: Camera,
    /// Width and height of the file.
    pub(super) own_px: [u32; 2],
}

impl Shrunk {
    /// Reads an image at a fraction of its size.
    pub(super) fn read(
        file: &Path,
        mask: Option<&Path>,
        camera: &Camera,
        size: f64,
    ) -> anyhow::Result<Self> {
        let background = RenderProfile::default().background;
        let (mut rgb8, mut camera) = picture::real(file, camera, background)?;
        let own_px = [camera.width_px, camera.height_px];
        let mut mask = mask.map(|file| read_mask(file, own_px)).transpose()?;
        if size < 1.0 {
            let small_px = own_px.map(|px| ((f64::from(px) * size).round() as u32).max(1));
            camera = camera.scaled(small_px[0].into(), small_px[1].into())?;
            let whole: ImageBuffer<Rgb<u8>, Vec<u8>> =
                ImageBuffer::from_raw(own_px[0], own_px[1], rgb8).context("an image's size")?;
            let small = imageops::resize(&whole, small_px[0], small_px[1], FilterType::Triangle);
            rgb8 = small.into_raw();
            mask = mask.map(|mask| shrink(&mask, own_px, small_px));
        }
        // The scene is trained at this size: no filter of a larger native size is part of it.
        camera.native_size_px = None;
        Ok(Self { rgb8, mask, camera, own_px })
    }
}

/// The factor of colours of an exposure in stops.
pub(super) fn factor(exposure_stops: Option<f64>) -> f32 {
    exposure_stops.map_or(1.0, |stops| stops.exp2() as f32)
}

fn read_mask(file: &Path, size_px: [u32; 2]) -> anyhow::Result<Vec<bool>> {
    let mask = picture::mask(file, size_px)?;
    let name = file.display();
    // Most often the mask is inverted, which a training would show only as a poor scene.
    ensure!(mask.contains(&true), "the mask {name} leaves no pixel: dark pixels do not count");
    Ok(mask)
}

/// A mask or a depth at a smaller size: a pixel has the value of the one at its middle.
pub(super) fn shrink<T: Copy>(values: &[T], own_px: [u32; 2], small_px: [u32; 2]) -> Vec<T> {
    let at = |axis: usize, px: u32| {
        // A mask and a depth have no values in between.
        ((f64::from(px) + 0.5) * f64::from(own_px[axis]) / f64::from(small_px[axis])) as usize
    };
    let row = |y: u32| &values[at(1, y) * own_px[0] as usize..][..own_px[0] as usize];
    (0..small_px[1]).flat_map(|y| (0..small_px[0]).map(move |x| row(y)[at(0, x)])).collect()
}
