//! SOG, the spatially ordered Gaussians of PlayCanvas: a meta.json and lossless WebP images, one
//! pixel per Gaussian, in a folder or an archive.
//!
//! Source: the format's description and readers in playcanvas/splat-transform. Images: means_l and
//! means_u (low and high bytes of 16 bits between mins and maxs, of `sign(x) ln(1 + |x|)`), quats
//! (three smallest components in 8 bits, alpha 252 to 255 says which is omitted), scales (ln), sh0
//! (colour; opacity in alpha) and, for higher degrees, shN: labels of 16 bits into centroids, 64 in
//! a row. Version 2 looks bytes up in codebooks of 256, and alpha is the opacity; version 1, which
//! names no version, spreads bytes between mins and maxs, and alpha is the logit.

mod files;
mod image;
mod meta;
mod streamed;

use crate::limits;
use wildcity_scene::{Gaussians, sh};

use super::notes::{BLUR_PX2, Reading};
use super::scene_files::SceneFiles;
use super::validate::Field;
use super::{IngestError, activation, check_count};
pub use files::SogFiles;
use image::{Image, NamedFile};
use meta::{Meta, Tables};

const FORMAT: &str = "SOG";

/// Files that describe a SOG: that of a streamed scene first, which has the other one in its
/// folders as well.
pub const DESCRIPTIONS: [&str; 2] = [streamed::NAME, "meta.json"];

/// The file that describes a streamed scene.
pub(super) const STREAMED: &str = streamed::NAME;

/// Reads a scene, given its meta.json or lod-meta.json and the folder of that file, which is empty
/// or ends in `/`.
pub(super) fn read(
    json: &[u8],
    folder: &str,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    match serde_json::from_slice::<Kind>(json) {
        Ok(Kind { lod_levels: Some(_), .. }) => streamed::read(json, folder, parts, reading),
        Ok(Kind { means: Some(_), .. }) => {
            let gaussians = read_one(json, "meta.json", folder, parts, reading)?;
            reading.accept(gaussians, &Field::plain_name)
        }
        Ok(_) => Err(bad("meta.json", "has neither means nor lodLevels".into())),
        Err(e) => Err(bad("meta.json", e.to_string())),
    }
}

/// The keys that distinguish the two JSON files.
#[derive(serde::Deserialize)]
struct Kind {
    means: Option<serde::de::IgnoredAny>,
    #[serde(rename = "lodLevels")]
    lod_levels: Option<serde::de::IgnoredAny>,
}

/// Reads a scene of one meta.json, whose Gaussians are not checked yet; errors call that file
/// `name`.
fn read_one(
    json: &[u8],
    name: &str,
    folder: &str,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let meta: Meta = serde_json::from_slice(json).map_err(|e| bad(name, e.to_string()))?;
    note_model(&meta, reading);
    let skipped: Vec<&str> = meta.skipped().collect();
    if !skipped.is_empty() {
        reading.warn_skipped(&format!("keys of {name}"), &skipped);
    }
    let tables = Tables::from_meta(&meta).map_err(|reason| bad(name, reason))?;
    let count = check_count(tables.count)?;
    // All files are read first, because the limit of unpacking depends on their total size.
    let mut fetch = |file: &str| -> Result<NamedFile, IngestError> {
        let file = format!("{folder}{file}");
        let bytes = parts.read(&file, limits::SCENE_PART_BYTES)?;
        Ok(NamedFile { name: file, bytes })
    };
    let means_l = fetch(&meta.means.files.0)?;
    let means_u = fetch(&meta.means.files.1)?;
    let scales = fetch(&meta.scales.files.0)?;
    let quats = fetch(&meta.quats.files.0)?;
    let sh0 = fetch(&meta.sh0.files.0)?;
    let higher = match &meta.sh_n {
        Some(sh_n) => Some([fetch(&sh_n.files.0)?, fetch(&sh_n.files.1)?]),
        None => None,
    };
    let mut decode = |file: NamedFile| Image::decode(file, count, parts.budget());

    // Centres: 16 bits between mins and maxs, of the signed logarithm.
    let low = decode(means_l)?;
    let high = decode(means_u)?;
    let mut gaussians = Gaussians { means_m: Vec::with_capacity(count), ..Gaussians::default() };
    for (low, high) in low.pixels(count).zip(high.pixels(count)) {
        let mean = std::array::from_fn(|axis| {
            let unit = f64::from(u16::from_le_bytes([low[axis], high[axis]])) / 65535.0;
            let [least, most] = tables.means[axis];
            let logarithm = least + (most - least) * unit;
            // The inverse of sign(x) ln(1 + |x|). `exp_m1` keeps the digits of small values.
            logarithm.signum() * logarithm.abs().exp_m1()
        });
        gaussians.means_m.push(mean);
    }
    // Freed before the other images are decoded, which take as much memory.
    drop([low, high]);

    // Rotations, scales, and opacities.
    for [r, g, b, largest] in decode(quats)?.pixels(count) {
        if largest < 252 {
            let index = gaussians.quats_wxyz.len();
            let reason =
                format!("Gaussian {index}: alpha is {largest}; 252 to 255 name a component");
            return Err(body(&meta.quats.files.0, reason));
        }
        // The three smaller components of a unit quaternion lie within ±√½.
        let others = [r, g, b].map(|byte| (f64::from(byte) / 255.0 - 0.5) * 2f64.sqrt());
        let largest = usize::from(largest - 252);
        gaussians.quats_wxyz.push(activation::quat_of_smallest_three(largest, others));
    }
    let pick = |table: &[f32; 256], byte: u8| table[usize::from(byte)];
    for pixel in decode(scales)?.pixels(count) {
        gaussians.ln_scales.push(std::array::from_fn(|i| pick(&tables.scales[i], pixel[i])));
    }
    let colours = decode(sh0)?;
    gaussians.logit_opacities.extend(colours.pixels(count).map(|p| pick(&tables.logits, p[3])));

    // Colours: degree 0, and higher degrees by labels.
    let dc = |pixel: [u8; 4]| -> [f32; 3] {
        std::array::from_fn(|channel| pick(&tables.colours[channel], pixel[channel]))
    };
    match (higher, tables.higher) {
        (Some([centroids, labels]), Some(table)) => {
            let name = centroids.name.clone();
            let palette =
                image::Palette::decode(centroids, table.entries, table.bands, parts.budget())?;
            let labels = Image::decode(labels, count, parts.budget())?;
            gaussians.sh_degree = palette.sh_degree;
            gaussians.sh.reserve_exact(count * 3 * sh::coefficients(palette.sh_degree));
            for (pixel, label) in colours.pixels(count).zip(labels.pixels(count)) {
                let label = u16::from_le_bytes([label[0], label[1]]);
                let Some(bytes) = palette.entry(label) else {
                    let reason = format!("there is no entry {label}, which a label names");
                    return Err(body(&name, reason));
                };
                gaussians.sh.extend(dc(pixel));
                gaussians.sh.extend(bytes.map(|byte| pick(&table.values, byte)));
            }
        }
        // Without shN the scene is of degree 0, of which this is all.
        _ => gaussians.sh.extend(colours.pixels(count).flat_map(dc)),
    }
    Ok(gaussians)
}

/// Notes how the scene was trained.
fn note_model(meta: &Meta, reading: &mut Reading) {
    if meta.antialias == Some(true) {
        reading.set_antialiased(BLUR_PX2, "\"antialias\": true".to_owned());
    }
    let said_by = |model: &str| format!("\"model\": {model:?}");
    match meta.model.as_deref() {
        Some("antialiased") => reading.set_antialiased(BLUR_PX2, said_by("antialiased")),
        Some("2dgs") => reading.set_flat(&said_by("2dgs")),
        None | Some("default") => {}
        Some(other) => {
            reading.warn(format!("{} is unknown and has no effect", said_by(other)));
        }
    }
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: FORMAT, place: place.into(), reason }
}

fn body(place: &str, reason: String) -> IngestError {
    IngestError::Body { format: FORMAT, place: place.into(), reason }
}
