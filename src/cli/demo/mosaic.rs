//! One image with all cameras, in the order in which they look: the front ones above, the others
//! below. A line above them has the time and the speed, and each camera its name.

use std::path::Path;

use anyhow::Context;
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};

use wildcity_client::{ImageView, Observation};

use super::caption;
use crate::cli::output;

/// Cameras of the demo's rig from left to right, row by row.
const ROWS: [[&str; 3]; 2] = [["front_left", "front", "front_right"], ["left", "rear", "right"]];
/// Width of an image, in pixels: a third of the front cameras'.
const WIDTH_PX: u32 = 480;
/// Pixels between images, and around all of them.
const GAP_PX: u32 = 4;
const GROUND: Rgb<u8> = Rgb([16, 20, 24]);

/// Writes a PNG of the six images.
pub(super) fn write(seen: &Observation, path: &Path) -> anyhow::Result<()> {
    let rows = ROWS.iter().map(|cameras| row(seen, cameras)).collect::<anyhow::Result<Vec<_>>>()?;
    let tallest =
        |row: &Row| row.iter().map(|(_, image)| image.height()).max().unwrap_or(0) + GAP_PX;
    let mut top = GAP_PX + caption::HEIGHT_PX;
    let size_px = [3 * (WIDTH_PX + GAP_PX) + GAP_PX, top + rows.iter().map(tallest).sum::<u32>()];
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
type Row = Vec<(&'static str, RgbImage)>;

fn row(seen: &Observation, cameras: &[&'static str]) -> anyhow::Result<Row> {
    let named = cameras.iter().map(|camera| {
        let image = seen.camera(camera).with_context(|| format!("no camera {camera:?}"))?;
        Ok((*camera, fit(&image)?))
    });
    named.collect()
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
    let scaled = (f64::from(WIDTH_PX) / f64::from(width) * f64::from(height)) as u32;
    Ok(imageops::resize(&rgb, WIDTH_PX, scaled.max(1), FilterType::Triangle))
}
