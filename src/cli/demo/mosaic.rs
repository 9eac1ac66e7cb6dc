//! One picture of all cameras, where they look: the front ones above, the others below.

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
    let [width, height] = CELL_PX.map(|side| side + GAP_PX);
    let mut mosaic = RgbImage::new(3 * width - GAP_PX, 2 * height - GAP_PX);
    for (row, cameras) in ROWS.iter().enumerate() {
        for (column, camera) in cameras.iter().enumerate() {
            let image = seen.camera(camera).with_context(|| format!("no camera {camera:?}"))?;
            let cell = fit(&image)?;
            let x = column as u32 * width + (CELL_PX[0] - cell.width()) / 2;
            let y = row as u32 * height + (CELL_PX[1] - cell.height()) / 2;
            imageops::replace(&mut mosaic, &cell, x.into(), y.into());
        }
    }
    let file = wildcity_session::png(&mosaic, mosaic.width(), mosaic.height());
    output::write(path, &file.map_err(anyhow::Error::msg)?)
}

/// The whole image, as large as a cell allows.
fn fit(image: &ImageView<'_>) -> anyhow::Result<RgbImage> {
    let metadata = image.metadata();
    let (width, height) = (u32::try_from(metadata.width)?, u32::try_from(metadata.height)?);
    let rgb = RgbImage::from_raw(width, height, image.rgb()?.into_owned())
        .context("an image of another size than it says")?;
    let scale =
        (f64::from(CELL_PX[0]) / f64::from(width)).min(f64::from(CELL_PX[1]) / f64::from(height));
    let side = |px: u32| ((f64::from(px) * scale) as u32).max(1);
    Ok(imageops::resize(&rgb, side(width), side(height), FilterType::Triangle))
}
