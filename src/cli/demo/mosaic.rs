//! One image with all cameras, in the order in which they look: the front ones above, the others
//! below.

use std::path::Path;

use anyhow::Context;
use image::RgbImage;
use image::imageops::{self, FilterType};

use wildcity_client::{ImageView, Observation};

use crate::cli::output;

/// Cameras of the demo's rig from left to right, row by row.
const ROWS: [[&str; 3]; 2] = [["front_left", "front", "front_right"], ["left", "rear", "right"]];
/// Size of a cell, in pixels: a third of the front cameras'.
const CELL_PX: [u32; 2] = [480, 310];
/// Pixels between cells.
const GAP_PX: u32 = 4;

/// Writes a PNG of the six images.
pub(super) fn write(seen: &Observation, path: &Path) -> anyhow::Result<()> {
    let [pitch_x, pitch_y] = CELL_PX.map(|side| side + GAP_PX);
    let mut mosaic = RgbImage::new(3 * pitch_x - GAP_PX, 2 * pitch_y - GAP_PX);
    for (row, cameras) in ROWS.iter().enumerate() {
        for (column, camera) in cameras.iter().enumerate() {
            let image = seen.camera(camera).with_context(|| format!("no camera {camera:?}"))?;
            let cell = fit(&image)?;
            let x = column as u32 * pitch_x + (CELL_PX[0] - cell.width()) / 2;
            let y = row as u32 * pitch_y + (CELL_PX[1] - cell.height()) / 2;
            imageops::replace(&mut mosaic, &cell, x.into(), y.into());
        }
    }
    let file = wildcity_session::png(&mosaic, mosaic.width(), mosaic.height());
    output::write(path, &file.map_err(anyhow::Error::msg)?)
}

/// The whole image, scaled to the size of a cell without a change of its aspect ratio.
fn fit(image: &ImageView<'_>) -> anyhow::Result<RgbImage> {
    let metadata = image.metadata();
    let width = u32::try_from(metadata.width)?;
    let height = u32::try_from(metadata.height)?;
    let rgb = RgbImage::from_raw(width, height, image.rgb()?.into_owned())
        .context("the image does not have the size that its metadata says")?;
    let scale_x = f64::from(CELL_PX[0]) / f64::from(width);
    let scale_y = f64::from(CELL_PX[1]) / f64::from(height);
    let scale = scale_x.min(scale_y);
    let scaled = |px: u32| ((f64::from(px) * scale) as u32).max(1);
    Ok(imageops::resize(&rgb, scaled(width), scaled(height), FilterType::Triangle))
}
