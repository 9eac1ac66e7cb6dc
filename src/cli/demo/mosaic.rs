//! One image with all cameras, in the order of the rig, as the viewer shows them: those that look
//! ahead above, the others below. A line above them has the time and the speed, and each camera its
//! name.

use std::path::Path;

use anyhow::Context;
use glam::DVec3;
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};

use wildcity_client::{ImageView, Observation};
use wildcity_scene::geometry::Pose;

use crate::cli::{caption, output};

/// Cameras that look farther to the side than this, in radians, are in the second row.
const FRONT_RAD: f64 = 1.2;
/// Width of an image, in pixels: a third of the front cameras'.
const WIDTH_PX: u32 = 480;
/// Pixels between images, and around all of them.
const GAP_PX: u32 = 4;
const GROUND: Rgb<u8> = Rgb([16, 20, 24]);

/// Writes a PNG of all images.
pub(super) fn write(seen: &Observation, path: &Path) -> anyhow::Result<()> {
    let rows = rows(seen)?;
    let tallest =
        |row: &Row| row.iter().map(|(_, image)| image.height()).max().unwrap_or(0) + GAP_PX;
    let mut top = GAP_PX + caption::HEIGHT_PX;
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let size_px =
        [columns * (WIDTH_PX + GAP_PX) + GAP_PX, top + rows.iter().map(tallest).sum::<u32>()];
    let mut mosaic = RgbImage::from_pixel(size_px[0], size_px[1], GROUND);
    caption::draw(&mut mosaic, &headline(seen), [GAP_PX, GAP_PX / 2]);
    for row in &rows {
        for (column, (camera, image)) in row.iter().enumerate() {
            let left = GAP_PX + column as u32 * (WIDTH_PX + GAP_PX);
            imageops::replace(&mut mosaic, image, left.into(), top.into());
            caption::draw(&mut mosaic, camera, [left, top]);
        }
        top += tallest(row);
    }
    let file = wildcity_session::png(&mosaic, mosaic.width(), mosaic.height());
    output::write(path, &file.map_err(anyhow::Error::msg)?)
}

/// The images of a row, with the names of their cameras.
type Row = Vec<(String, RgbImage)>;

fn rows(seen: &Observation) -> anyhow::Result<[Row; 2]> {
    let mut rows = [Row::new(), Row::new()];
    for image in seen.images() {
        let metadata = image.metadata();
        let mount = &metadata.camera_to_rig;
        let row = row(&Pose::checked(mount.xyz, mount.q)?);
        rows[row].push((metadata.camera.clone(), fit(&image)?));
    }
    Ok(rows)
}

/// The row of a camera: 0 if it looks ahead.
fn row(rig_from_camera: &Pose) -> usize {
    let toward = rig_from_camera.rotation * DVec3::Z;
    usize::from(toward.y.atan2(toward.x).abs() >= FRONT_RAD)
}

/// The line above the images: the time and the speed at which they were taken.
fn headline(seen: &Observation) -> String {
    let metadata = seen.metadata();
    let speed_m_s = metadata.ego.velocity.iter().map(|v| v * v).sum::<f64>().sqrt();
    let time_s = metadata.time_us as f64 * 1e-6;
    format!("{} {time_s:6.1} s {speed_m_s:6.1} m/s {:5.0} km/h", metadata.twin, 3.6 * speed_m_s)
}

/// The whole image in the width of a mosaic's, without a change of its aspect ratio.
fn fit(image: &ImageView<'_>) -> anyhow::Result<RgbImage> {
    let metadata = image.metadata();
    let width = u32::try_from(metadata.width)?;
    let height = u32::try_from(metadata.height)?;
    let rgb = RgbImage::from_raw(width, height, image.rgb()?.into_owned())
        .context("the image does not have the size that its metadata says")?;
    // Images of the rig differ in shape: they get one width, so that columns line up.
    let scaled = (f64::from(WIDTH_PX) / f64::from(width) * f64::from(height)) as u32;
    Ok(imageops::resize(&rgb, WIDTH_PX, scaled.max(1), FilterType::Triangle))
}

#[cfg(test)]
mod tests {
    use wildcity_scene::Rig;

    use super::*;

    #[test]
    fn three_cameras_of_the_demo_look_ahead() {
        let rig = Rig::preset("vehicle6").unwrap();
        let rows: Vec<usize> = rig.cameras.iter().map(|c| row(&c.rig_from_camera)).collect();
        assert_eq!(rows, [0, 0, 0, 1, 1, 1]);
    }
}
