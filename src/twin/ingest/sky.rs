//! Skies: the network of a drivestudio checkpoint as safetensors, or images.
//!
//! safetensors: `sky_head.layers.{0,1,2}.{weight,bias}` and, if there are appearances,
//! `appearance_embedding.weight` `[images, n]`; F32 or F16; tensors of other names are skipped.
//!
//! Images, PNG or JPEG, are distinguished by their aspect ratio: 2:1 is an equirectangular
//! panorama, 4:3 and 3:4 are crosses, 1:6 and 6:1 strips of the faces +x, -x, +y, -y, +z, -z. A
//! folder has the faces as px, nx, py, ny, pz, nz. x is right, y up and z ahead, in the middle of a
//! panorama and of a cross: left-handed, like cube maps.
//!
//! A twin stores one of two: those tensors in F32 and no others, or a PNG of six faces, one
//! below the other.

use std::f64::consts::{PI, TAU};
use std::io::Cursor;
use std::path::Path;

use ::safetensors::tensor::{Dtype, TensorView};
use ::safetensors::{SafeTensors, serialize};
use glam::DVec3;
use half::f16;
use image::{DynamicImage, ImageFormat, ImageReader, RgbImage};

use crate::limits;
use wildcity_scene::sky::{CubeMap, FACES, Layer, Network, SkyError, SkyModel};

use super::file::{self, FileError};
use super::{IngestError, read_whole};

/// A sky that was read from a file.
#[derive(Clone, Debug)]
pub struct SkyFile {
    /// The sky as a twin stores it, which [`decode`] reads.
    pub bytes: Vec<u8>,
    pub model: SkyModel,
}

/// Reads a sky from a file, or from the six images of a folder. `image` is the index of the
/// training image with the appearance that a network is evaluated for; the mean of all if `None`.
///
/// # Errors
/// It is not a sky, or one that cannot be used.
pub fn read(path: &Path, image: Option<u32>) -> Result<SkyFile, IngestError> {
    if path.is_dir() {
        return stored_faces(&folder(path)?, image);
    }
    read_bytes(&read_whole(path, limits::SKY_FILE_BYTES)?, image)
}

/// Reads a sky from the bytes of a file.
///
/// # Errors
/// As [`read`].
pub fn read_bytes(bytes: &[u8], image: Option<u32>) -> Result<SkyFile, IngestError> {
    // safetensors has a length in 8 bytes and then JSON. In a PNG this byte is 0.
    if bytes.get(8) == Some(&b'{') {
        let Weights { layers, appearances } = Weights::read(bytes)?;
        let bytes = stored_network(&layers, &appearances)?;
        return Ok(SkyFile { model: decode(&bytes, image)?, bytes });
    }
    stored_faces(&faces(&picture(bytes)?)?, image)
}

/// Decodes a sky as a twin stores it.
///
/// # Errors
/// As [`read`].
pub fn decode(bytes: &[u8], image: Option<u32>) -> Result<SkyModel, IngestError> {
    if bytes.get(8) == Some(&b'{') {
        let Weights { layers, appearances } = Weights::read(bytes)?;
        return Ok(SkyModel::network(Network::new(layers, appearances.row(image)?)?));
    }
    // Only a network has appearances. An index that has no effect is an error of the caller.
    if let Some(image) = image {
        return Err(SkyError::Image { image, count: 0 }.into());
    }
    let strip = picture(bytes)?;
    let map = CubeMap::from_faces(strip.width() as usize, strip.as_raw())?;
    Ok(SkyModel::cube(map))
}

/// A network's tensors.
struct Weights {
    layers: [Layer; 3],
    appearances: Appearances,
}

/// The appearance embedding: a row of numbers for every image of the training set; empty if the
/// network has none.
struct Appearances {
    count: usize,
    length: usize,
    values: Vec<f32>,
}

impl Weights {
    fn read(bytes: &[u8]) -> Result<Self, IngestError> {
        let tensors =
            SafeTensors::deserialize(bytes).map_err(|error| bad("header", error.to_string()))?;
        let layer = |number: usize| {
            let name = |what: &str| format!("sky_head.layers.{number}.{what}");
            let (shape, weight) = floats(&tensors, &name("weight"), 2)?;
            let (_, bias) = floats(&tensors, &name("bias"), 1)?;
            Ok::<_, IngestError>(Layer { outputs: shape[0], inputs: shape[1], weight, bias })
        };
        let layers = [layer(0)?, layer(1)?, layer(2)?];
        let appearances = if tensors.names().contains(&APPEARANCES) {
            let (shape, values) = floats(&tensors, APPEARANCES, 2)?;
            Appearances { count: shape[0], length: shape[1], values }
        } else {
            Appearances { count: 0, length: 0, values: Vec::new() }
        };
        Ok(Self { layers, appearances })
    }
}

const APPEARANCES: &str = "appearance_embedding.weight";

impl Appearances {
    /// The row of an image, or the mean of all rows.
    fn row(&self, image: Option<u32>) -> Result<Vec<f32>, SkyError> {
        let Self { count, length, values } = self;
        let row = |row: usize| &values[row * length..(row + 1) * length];
        match image {
            Some(image) if (image as usize) < *count => Ok(row(image as usize).to_vec()),
            Some(image) => Err(SkyError::Image { image, count: *count }),
            None => {
                // The mean is summed in 64 bits, in the order of the rows, so that it is the same
                // everywhere.
                let sum = |k: usize| (0..*count).map(|i| f64::from(row(i)[k])).sum::<f64>();
                Ok((0..*length).map(|k| (sum(k) / (*count).max(1) as f64) as f32).collect())
            }
        }
    }
}

/// A tensor's shape and values.
fn floats(
    tensors: &SafeTensors<'_>,
    name: &str,
    dimensions: usize,
) -> Result<(Vec<usize>, Vec<f32>), IngestError> {
    let place = || format!("tensor {name}");
    let tensor = tensors.tensor(name).map_err(|_| bad(&place(), "is missing".to_owned()))?;
    let shape = tensor.shape().to_vec();
    if shape.len() != dimensions {
        return Err(bad(&place(), format!("has shape {shape:?}, not {dimensions} dimensions")));
    }
    let data = tensor.data();
    let values = match tensor.dtype() {
        Dtype::F32 => data.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect(),
        Dtype::F16 => {
            let halves = data.as_chunks().0.iter();
            halves.map(|&bytes| f16::from_le_bytes(bytes).to_f32()).collect()
        }
        other => return Err(bad(&place(), format!("is {other:?}; F32 or F16 is read"))),
    };
    Ok((shape, values))
}

fn stored_network(layers: &[Layer; 3], appearances: &Appearances) -> Result<Vec<u8>, IngestError> {
    // The twin stores F32 whatever the file had, so that each version decodes by one path.
    let bytes = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let mut tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    for (number, layer) in layers.iter().enumerate() {
        let Layer { outputs, inputs, weight, bias } = layer;
        let name = |what: &str| format!("sky_head.layers.{number}.{what}");
        tensors.push((name("weight"), vec![*outputs, *inputs], bytes(weight)));
        tensors.push((name("bias"), vec![bias.len()], bytes(bias)));
    }
    let Appearances { count, length, values } = appearances;
    // Without an embedding the tensor is left out, which `Weights::read` takes for no appearances.
    if *length > 0 {
        tensors.push((APPEARANCES.to_owned(), vec![*count, *length], bytes(values)));
    }
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, shape, bytes)| {
            TensorView::new(Dtype::F32, shape.clone(), bytes).map(|view| (name, view))
        })
        .collect();
    let kept = views.and_then(|views| serialize(views, None));
    kept.map_err(|error| bad("tensors", error.to_string()))
}

/// Six faces as a twin stores them, from a strip.
fn stored_faces(strip: &RgbImage, image: Option<u32>) -> Result<SkyFile, IngestError> {
    let mut bytes = Cursor::new(Vec::new());
    strip
        .write_to(&mut bytes, ImageFormat::Png)
        .map_err(|error| bad("image", error.to_string()))?;
    let bytes = bytes.into_inner();
    Ok(SkyFile { model: decode(&bytes, image)?, bytes })
}

fn picture(bytes: &[u8]) -> Result<RgbImage, IngestError> {
    let unreadable = |error: image::ImageError| bad("image", error.to_string());
    let mut reader = ImageReader::new(Cursor::new(bytes));
    reader = reader.with_guessed_format()?;
    let is_read = matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg));
    if !is_read {
        return Err(bad("start", "it is not a safetensors file, a PNG, or a JPEG".to_owned()));
    }
    // A few bytes may claim a picture of many gigabytes, so the decoder's memory is bounded.
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(limits::SKY_IMAGE_BYTES);
    reader.limits(limits);
    reader.decode().map(DynamicImage::into_rgb8).map_err(unreadable)
}

/// The faces of an image of any of the shapes, as a strip.
fn faces(picture: &RgbImage) -> Result<RgbImage, IngestError> {
    let (width, height) = picture.dimensions();
    // The position of each face, in faces from the left and the top.
    let (side, position): (u32, [[u32; 2]; FACES]) = match (width, height) {
        (w, h) if w == 2 * h => return panorama(picture),
        // A strip from top to bottom is the stored form already.
        (w, h) if h == 6 * w => return Ok(picture.clone()),
        (w, h) if w == 6 * h => (h, [[0, 0], [1, 0], [2, 0], [3, 0], [4, 0], [5, 0]]),
        (w, h) if w % 4 == 0 && 4 * h == 3 * w => {
            (w / 4, [[2, 1], [0, 1], [1, 0], [1, 2], [1, 1], [3, 1]])
        }
        (w, h) if w % 3 == 0 && 3 * h == 4 * w => {
            (w / 3, [[2, 1], [0, 1], [1, 0], [1, 2], [1, 1], [1, 3]])
        }
        _ => {
            let reason = format!(
                "{width} x {height} pixels are not a panorama (2:1), a cross (4:3, 3:4), or a \
                 strip of six faces (1:6, 6:1)"
            );
            return Err(bad("image", reason));
        }
    };
    // A side is at least 1: the decoder refuses pictures without pixels, and the cases above divide
    // evenly.
    let last = side - 1;
    Ok(RgbImage::from_fn(side, FACES as u32 * side, |column, y| {
        let face = (y / side) as usize;
        let row = y % side;
        // In an upright cross, -z is below the bottom face, and upside down.
        let is_upside_down = position[face] == [1, 3];
        let (column, row) =
            if is_upside_down { (last - column, last - row) } else { (column, row) };
        let [left, top] = position[face];
        *picture.get_pixel(left * side + column, top * side + row)
    }))
}

/// The faces of an equirectangular panorama, at its resolution in the middle of each face. There, a
/// face of `n` pixels has `n / 2` pixels per radian, and the panorama has `width / 2π`; so `n =
/// width / π`.
fn panorama(picture: &RgbImage) -> Result<RgbImage, IngestError> {
    let (width, height) = picture.dimensions();
    let side = (f64::from(width) / PI).ceil() as u32;
    if side as usize > CubeMap::MAX_SIDE_PX {
        return Err(SkyError::Side { side_px: side as usize }.into());
    }
    let colour = |away: DVec3| {
        let away = away.normalize();
        // Azimuth 0 is ahead, in the middle of the panorama. Pixel k has its middle at k + 0.5.
        let azimuth = away.x.atan2(away.z) / TAU + 0.5;
        let u = azimuth * f64::from(width) - 0.5;
        // Rows end at the poles and are clamped; columns wrap around.
        let v = (away.y.clamp(-1.0, 1.0).acos() / PI * f64::from(height) - 0.5)
            .clamp(0.0, f64::from(height - 1));
        // Bilinear interpolation.
        let fu = u - u.floor();
        let fv = v - v.floor();
        let at = |column: f64, row: f64| {
            let column = column.rem_euclid(f64::from(width)) as u32;
            let row = (row as u32).min(height - 1);
            DVec3::from_array(picture.get_pixel(column, row).0.map(f64::from))
        };
        let upper = at(u.floor(), v.floor()).lerp(at(u.floor() + 1.0, v.floor()), fu);
        let lower = at(u.floor(), v.floor() + 1.0).lerp(at(u.floor() + 1.0, v.floor() + 1.0), fu);
        upper.lerp(lower, fv).to_array().map(|c| c.round() as u8)
    };
    Ok(RgbImage::from_fn(side, FACES as u32 * side, |column, y| {
        let at = |k: u32| (f64::from(k) + 0.5) / f64::from(side);
        let face = (y / side) as usize;
        image::Rgb(colour(CubeMap::direction(face, [at(column), at(y % side)])))
    }))
}

/// The six images of a folder, as a strip.
fn folder(path: &Path) -> Result<RgbImage, IngestError> {
    let mut strip: Option<RgbImage> = None;
    for (face, name) in (0..).zip(["px", "nx", "py", "ny", "pz", "nz"]) {
        let candidates = ["png", "jpg", "jpeg"].map(|kind| path.join(format!("{name}.{kind}")));
        let found = candidates.iter().find(|candidate| candidate.exists()).ok_or_else(|| {
            bad(name, format!("there is no {name}.png or {name}.jpg in {}", path.display()))
        })?;
        let part =
            |cause: FileError| IngestError::Part { name: found.display().to_string(), cause };
        let bytes = file::read_whole(found, limits::SKY_FILE_BYTES).map_err(part)?;
        let picture = picture(&bytes)?;
        let side = strip.as_ref().map_or(picture.width(), RgbImage::width);
        // The first face decides the side, because all six must be equal for a cube.
        if picture.dimensions() != (side, side) {
            let (width, height) = picture.dimensions();
            return Err(bad(name, format!("is {width} x {height} pixels, not {side} x {side}")));
        }
        if side as usize > CubeMap::MAX_SIDE_PX {
            return Err(SkyError::Side { side_px: side as usize }.into());
        }
        let strip = strip.get_or_insert_with(|| RgbImage::new(side, FACES as u32 * side));
        image::imageops::replace(strip, &picture, 0, i64::from(face * side));
    }
    strip.ok_or_else(|| bad("folder", "it is empty".to_owned()))
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: "sky", place: place.to_owned(), reason }
}
