//! The images that are held out, which judge a run.

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::gradient::Differentiate;
use wildcity_render::{Frame, Target};
use wildcity_scene::{RenderProfile, Scene};

use crate::images::{TrainingImage, TrainingImages};
use crate::trainer::{TrainError, Trainer};

/// An image that was held out, beside what the scene shows in its place.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldOut {
    pub name: String,
    /// Its width and its height.
    pub size_px: [u32; 2],
    /// `[height, width, 3]`: its own colours.
    pub recorded: Vec<u8>,
    /// `[height, width, 3]`, at the pose that is trained and with the exposure that was recorded.
    pub drawn: Vec<u8>,
    /// `[height, width]`: expected depth in metres; 0 where there is none.
    pub depth_m: Vec<f32>,
    /// `[height, width, 3]`: unit normals in the camera's axes, towards it; 0 where there is none.
    pub normals: Vec<f32>,
    /// Of the pixels that count.
    pub psnr_db: f64,
}

/// The mean PSNR of the images that are held out; `None` without any.
///
/// # Errors
/// An image cannot be read or drawn.
pub fn held_out_db(
    trainer: &Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
) -> Result<Option<f64>, TrainError> {
    Evaluator::new(images, backend).mean_db(trainer)
}

/// The mean PSNR of the images that are held out against what another scene shows at the poses of
/// a run; `None` without any.
///
/// # Errors
/// An image cannot be read or drawn.
pub fn scene_db(
    scene: &Scene,
    trainer: &Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
) -> Result<Option<f64>, TrainError> {
    Ok(mean(&Evaluator::new(images, backend).each_db(scene, trainer)?))
}

/// What the images that are held out say of a run.
#[derive(Clone, Debug)]
pub struct Judged {
    /// The mean PSNR of those with a pixel that counts.
    pub mean_db: f64,
    /// Number of images with a pixel that counts.
    pub images: usize,
    /// The one in the middle of their order, which is the same for all runs.
    pub middle: HeldOut,
}

/// Judges a run by the images that are held out; `None` without any.
///
/// # Errors
/// An image cannot be read or drawn.
pub fn judge(
    trainer: &Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
) -> Result<Option<Judged>, TrainError> {
    let evaluator = Evaluator::new(images, backend);
    let scene = trainer.scene()?;
    let all_db = evaluator.each_db(&scene, trainer)?;
    let Some(mean_db) = mean(&all_db) else { return Ok(None) };
    let (index, psnr_db) = all_db[all_db.len() / 2];
    let middle = evaluator.beside(trainer, &scene, index, psnr_db)?;
    Ok(Some(Judged { mean_db, images: all_db.len(), middle }))
}

/// Up to `most` of the images that are held out, from the one with the lowest PSNR to the one with
/// the highest.
///
/// # Errors
/// An image cannot be read or drawn.
pub fn held_out_images(
    trainer: &Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
    most: usize,
) -> Result<Vec<HeldOut>, TrainError> {
    let evaluator = Evaluator::new(images, backend);
    let scene = trainer.scene()?;
    let mut all_db = evaluator.each_db(&scene, trainer)?;
    all_db.sort_by(|a, b| a.1.total_cmp(&b.1));
    let count = all_db.len().min(most);
    // The first and the last of all are among them.
    // Evenly spaced between them, and the first one if only one is asked for.
    let place = |k: usize| k * (all_db.len() - 1) / (count - 1).max(1);
    (0..count)
        .map(|k| {
            let (index, psnr_db) = all_db[place(k)];
            evaluator.beside(trainer, &scene, index, psnr_db)
        })
        .collect()
}

/// Draws the images that are held out.
pub(crate) struct Evaluator<'a> {
    images: &'a dyn TrainingImages,
    backend: &'a dyn Differentiate,
    held_out: Vec<usize>,
}

/// What the scene shows in the place of an image.
struct Drawn {
    rgb8: Vec<u8>,
    depth_m: Vec<f32>,
    normals: Vec<f32>,
}

impl<'a> Evaluator<'a> {
    pub(crate) fn new(images: &'a dyn TrainingImages, backend: &'a dyn Differentiate) -> Self {
        Self { images, backend, held_out: images.held_out() }
    }

    /// The mean of the PSNR of those with a pixel that counts; `None` without any.
    pub(crate) fn mean_db(&self, trainer: &Trainer) -> Result<Option<f64>, TrainError> {
        Ok(mean(&self.each_db(&trainer.scene()?, trainer)?))
    }

    /// The PSNR of those with a pixel that counts, with their numbers.
    fn each_db(&self, scene: &Scene, trainer: &Trainer) -> Result<Vec<(usize, f64)>, TrainError> {
        let mut all_db = Vec::new();
        for &index in &self.held_out {
            let image = self.load(index)?;
            if image.counts() {
                let drawn = self.draw(trainer, scene, index, &image, false)?;
                all_db.push((index, psnr_db(&image, &drawn.rgb8)));
            }
        }
        Ok(all_db)
    }

    fn beside(
        &self,
        trainer: &Trainer,
        scene: &Scene,
        index: usize,
        psnr_db: f64,
    ) -> Result<HeldOut, TrainError> {
        let image = self.load(index)?;
        let Drawn { rgb8, depth_m, normals } = self.draw(trainer, scene, index, &image, true)?;
        let camera = &image.view.camera;
        Ok(HeldOut {
            name: self.images.name(index),
            size_px: [camera.width_px, camera.height_px],
            recorded: image.rgb8,
            drawn: rgb8,
            depth_m,
            normals,
            psnr_db,
        })
    }

    fn load(&self, index: usize) -> Result<TrainingImage, TrainError> {
        self.images.load(index).map_err(TrainError::Image)
    }

    /// The image as the scene shows it, with its depth and normals if `all` are asked for.
    fn draw(
        &self,
        trainer: &Trainer,
        scene: &Scene,
        index: usize,
        image: &TrainingImage,
        all: bool,
    ) -> Result<Drawn, TrainError> {
        let pixels = image.view.camera.pixels();
        let mut rgba = vec![0.0; 4 * pixels];
        let [mut depth_m, mut normals] =
            // An empty image is not bound to the target below.
            [1, 3].map(|n| vec![0.0; if all { n * pixels } else { 0 }]);
        // The sky is evaluated for every pixel: a map would be made for a few images.
        let profile = RenderProfile { sky_error: 0.0, ..*trainer.profile() };
        let views = [trainer.view(image.view, index, self.images.place(index))];
        let frame = Frame { scene, profile: &profile, views: &views };
        let mut target = Target { rgba: Some(&mut rgba), ..Target::default() };
        if all {
            target.depth_m = Some(&mut depth_m);
            target.normals = Some(&mut normals);
        }
        self.backend.render(&frame, &mut [target], &|_, _| {})?;
        // Exposed before it is rounded to 8 bits, so that nothing is clipped.
        let to_8_bits =
            |value: &f32| (255.0 * (value * image.exposure).clamp(0.0, 1.0)).round() as u8;
        let colors = rgba.as_chunks::<4>().0.iter();
        let rgb8 = colors.flat_map(|[r, g, b, _]| [r, g, b].map(to_8_bits)).collect();
        Ok(Drawn { rgb8, depth_m, normals })
    }
}

fn mean(all_db: &[(usize, f64)]) -> Option<f64> {
    let sum_db = all_db.iter().map(|(_, psnr_db)| psnr_db).sum::<f64>();
    (!all_db.is_empty()).then(|| sum_db / all_db.len() as f64)
}

/// Of the pixels that count.
fn psnr_db(image: &TrainingImage, drawn: &[u8]) -> f64 {
    // A mask has one value per pixel, and an index is that of a channel.
    let counts = |&index: &usize| image.mask.as_ref().is_none_or(|mask| mask[index / 3]);
    let values = (0..drawn.len()).filter(counts);
    psnr_db_u8(values.map(|i| (&drawn[i], &image.rgb8[i])))
}
