//! The images that are compared with LiDAR, and the sweeps around their times.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use image::{DynamicImage, ImageReader, RgbImage};

use super::projection::rig_points;
use crate::error::LogError;
use crate::log::Log;
use crate::poses::Poses;
use crate::row::{ImageRow, SweepRow};

/// Points of a sweep count for an image if the sweep is this near to its time, in microseconds: a
/// turn at 10 Hz.
const NEAR_US: i64 = 100_000;

/// An image that is compared, with the sweeps around its time.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    pub image: ImageRow,
    pub sweeps: Vec<SweepRow>,
}

/// A compared image with the LiDAR points that it shows, for a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct SampledImage {
    pub image: ImageRow,
    /// Size of the file in `rgb8`, in pixels.
    pub size_px: [u32; 2],
    /// The image, shrunk: `[height, width, 3]`.
    pub rgb8: Vec<u8>,
    /// Place in this image and distance of each point that is in it: column, row, metres.
    pub points: Vec<[f32; 3]>,
}

/// The chosen images, in order of time.
pub(super) struct Samples {
    pub(super) samples: Vec<Sample>,
}

impl Samples {
    /// Chooses images of each camera, spread evenly over its rows, and the sweeps near them. Two
    /// passes over tables, of which only what is chosen stays in memory.
    pub(super) fn choose(
        log: &Log,
        counts: &BTreeMap<String, usize>,
        most: usize,
    ) -> Result<Self, LogError> {
        let mut samples: Vec<Sample> = Vec::new();
        let Some(images) = log.images()? else { return Ok(Self { samples }) };
        // Without LiDAR there is nothing to compare, and no image needs to be chosen.
        let Some(sweeps) = log.sweeps()? else { return Ok(Self { samples }) };
        let mut seen: BTreeMap<String, usize> = BTreeMap::new();
        super::for_each(images, |image| {
            let count = counts.get(&image.camera).copied().unwrap_or(0);
            let place = seen.entry(image.camera.clone()).or_default();
            // A file that is missing is reported by its count.
            if is_chosen(*place, count, most) && log.path(&image.file).is_file() {
                samples.push(Sample { image, sweeps: Vec::new() });
            }
            *place += 1;
            Ok(())
        })?;
        super::for_each(sweeps, |sweep| {
            if !log.path(&sweep.file).is_file() {
                return Ok(());
            }
            let from_us = sweep.time_us.saturating_sub(NEAR_US);
            let to_us = sweep.until_us.saturating_add(NEAR_US);
            // The rows of a table are in order of time, and so are the samples that were taken from
            // them.
            let first = samples.partition_point(|sample| sample.image.time_us < from_us);
            let near = samples[first..].iter_mut();
            for sample in near.take_while(|sample| sample.image.time_us <= to_us) {
                sample.sweeps.push(sweep.clone());
            }
            Ok(())
        })?;
        Ok(Self { samples })
    }
}

/// Chosen images with the points of the sweeps around them, read one after the other.
pub(crate) struct SampleReader<'a> {
    log: &'a Log,
    samples: Vec<Sample>,
}

/// A point in the world, and when it was seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WorldPoint {
    pub(crate) world_m: DVec3,
    pub(crate) time_us: i64,
}

/// An image whose camera may have another size.
pub(crate) struct ReadImage {
    image: RgbImage,
    /// Pixels of the file for one of the camera's.
    scale: DVec2,
}

impl ReadImage {
    /// The colour at a place, in pixels of the camera.
    pub(crate) fn color(&self, at_px: DVec2) -> [u8; 3] {
        let [column, row] = (at_px * self.scale).to_array().map(|place| place as u32);
        // Scaling can round a place at the right or lower edge to the size of the file itself.
        let column = column.min(self.image.width() - 1);
        self.image.get_pixel(column, row.min(self.image.height() - 1)).0
    }
}

impl<'a> SampleReader<'a> {
    /// Chooses images of each camera, spread evenly over its rows.
    pub(crate) fn choose(log: &'a Log, images_per_camera: usize) -> Result<Self, LogError> {
        let mut counts: BTreeMap<String, usize> = BTreeMap::new();
        if let Some(rows) = log.images()? {
            super::for_each(rows, |row| {
                *counts.entry(row.camera).or_default() += 1;
                Ok(())
            })?;
        }
        let Samples { samples } = Samples::choose(log, &counts, images_per_camera)?;
        Ok(Self { log, samples })
    }

    pub(crate) fn samples(&self) -> &[Sample] {
        &self.samples
    }

    pub(crate) fn image(&self, sample: &Sample) -> Result<ReadImage, LogError> {
        let image = read_image(self.log, sample)?.into_rgb8();
        let camera = &self.log.rig.cameras[self.log.camera_index(&sample.image.camera)?].camera;
        let own_px = DVec2::new(f64::from(image.width()), f64::from(image.height()));
        Ok(ReadImage { scale: own_px / camera.size_px(), image })
    }

    /// The points around an image in the world, those of which there is a pose.
    pub(crate) fn points(
        &self,
        sample: &Sample,
        poses: &Poses,
    ) -> Result<Vec<WorldPoint>, LogError> {
        let mut points = Vec::new();
        for row in &sample.sweeps {
            let read = rig_points(self.log, row)?.into_iter();
            points.extend(read.filter_map(|point| {
                let world_m = point.world_m(poses, 0)?;
                Some(WorldPoint { world_m, time_us: point.time_us })
            }));
        }
        Ok(points)
    }
}

/// The image of a sample.
pub(super) fn read_image(log: &Log, sample: &Sample) -> Result<DynamicImage, LogError> {
    let path = log.path(&sample.image.file);
    let reader = ImageReader::open(&path).map_err(|error| LogError::file(&path, &error))?;
    let guessed = reader.with_guessed_format().map_err(|error| LogError::file(&path, &error))?;
    guessed.decode().map_err(|error| LogError::malformed(&path, error))
}

/// Whether the image of this place is one of `most` that are spread over `count`: the middles of
/// equal parts.
fn is_chosen(place: usize, count: usize, most: usize) -> bool {
    if count <= most {
        return true;
    }
    // How many are chosen before a place: its share of all, rounded, as a line is drawn in pixels.
    let before = |place: usize| (2 * place * most + count) / (2 * count);
    before(place + 1) > before(place)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chosen_images_are_spread_over_all() {
        let chosen: Vec<usize> = (0..100).filter(|place| is_chosen(*place, 100, 4)).collect();
        assert_eq!(chosen, [12, 37, 62, 87]);
        assert_eq!((0..3).filter(|place| is_chosen(*place, 3, 4)).count(), 3);
        for count in 1..60 {
            let number = (0..count).filter(|place| is_chosen(*place, count, 12)).count();
            assert_eq!(number, count.min(12), "{count}");
        }
    }
}
