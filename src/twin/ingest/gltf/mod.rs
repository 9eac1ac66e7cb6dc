//! glTF and GLB with KHR_gaussian_splatting.
//!
//! Source: the extension's text in KhronosGroup/glTF. Every primitive that has the extension is
//! read, with the transforms of its nodes: POSITION, ROTATION (x, y, z, w), SCALE, OPACITY (0 to 1)
//! and SH_DEGREE_l_COEF_n, or COLOR_0 where there are none. SCALE is a standard deviation; in
//! earlier drafts it was its logarithm, which is detected by negative values: no standard deviation
//! is negative. Other kernels, colour spaces and projections than those that are drawn are named in
//! a warning. Splats that KHR_gaussian_splatting_compression_spz_2 compresses are read as SPZ.
//!
//! The triangles of a scene without splats are covered with flat Gaussians (`mesh.rs`).

mod accessor;
mod document;
mod instances;
#[cfg(feature = "mesh")]
mod material;
#[cfg(feature = "mesh")]
mod mesh;
#[cfg(not(feature = "mesh"))]
#[path = "no_mesh.rs"]
mod mesh;
mod skipped;
mod splat_settings;
#[cfg(feature = "mesh")]
mod triangle;
mod uris;

use std::collections::BTreeMap;

use serde_json::Value;

use wildcity_scene::srgb::stored_from_linear;
use wildcity_scene::{Gaussians, sh};

use super::notes::Reading;
use super::scene_files::SceneFiles;
use super::validate::Field;
use super::{Axes, FileAxes, IngestError, activation, check_count, spz};
use accessor::Column;
use document::{Document, Primitive};
use uris::Uris;

const FORMAT: &str = "glTF";
const EXTENSION: &str = "KHR_gaussian_splatting";
/// The extension whose buffer view is an SPZ of version 2.
const SPZ: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Extensions that a document may require. Compressed buffer views are refused by their own names.
const READ_EXTENSIONS: [&str; 8] = [
    EXTENSION,
    SPZ,
    "EXT_meshopt_compression",
    "KHR_draco_mesh_compression",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
];

/// Whether JSON is glTF, in which an asset is required.
pub(super) fn is_likely(json: &[u8]) -> bool {
    #[derive(serde::Deserialize)]
    struct Kind {
        asset: Option<Asset>,
        meshes: Option<serde::de::IgnoredAny>,
    }
    #[derive(serde::Deserialize)]
    struct Asset {
        version: Option<serde::de::IgnoredAny>,
    }
    let kind = serde_json::from_slice::<Kind>(json);
    // SOG has an asset, too, but neither meshes nor a version of the asset.
    kind.is_ok_and(|kind| kind.meshes.is_some() || kind.asset.is_some_and(|a| a.version.is_some()))
}

/// Reads a binary glTF file, which is in memory.
pub(super) fn read_glb(
    file: &[u8],
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    const JSON: u32 = u32::from_le_bytes(*b"JSON");
    const BIN: u32 = u32::from_le_bytes(*b"BIN\0");
    let words: Vec<u32> =
        file.as_chunks().0.iter().take(3).map(|&word| u32::from_le_bytes(word)).collect();
    let &[_, version, length] = &words[..] else {
        return Err(bad("the first 12 bytes", "there are fewer".into()));
    };
    if version != 2 {
        return Err(bad("bytes 4 to 7", format!("version {version}; 2 is read")));
    }
    // A copy that ended early, or bytes appended to it, would be read as another scene.
    if length as usize != file.len() {
        return Err(IngestError::Size {
            format: FORMAT,
            promised: length.into(),
            held: file.len() as u128,
            content: "all".into(),
        });
    }
    let mut json = None;
    let mut buffer = None;
    let mut rest = &file[12..];
    while let Some((head, after)) = rest.split_first_chunk::<8>() {
        let [length, kind] = [0, 4]
            .map(|at| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]));
        let Some((chunk, after)) = after.split_at_checked(length as usize) else {
            return Err(IngestError::Size {
                format: FORMAT,
                promised: length.into(),
                held: after.len() as u128,
                content: "a chunk".into(),
            });
        };
        match kind {
            // The specification allows one of each. Of more, the first counts.
            JSON => json = json.or(Some(chunk)),
            BIN => buffer = buffer.or(Some(chunk)),
            _ => (),
        }
        rest = after;
    }
    if !rest.is_empty() {
        let reason = format!("{} bytes after the last one, too few for another", rest.len());
        return Err(bad("chunks", reason));
    }
    let json = json.ok_or_else(|| bad("chunks", "there is no chunk JSON".into()))?;
    read(json, buffer, parts, reading)
}

/// Reads a document, with the buffer within a GLB file.
pub(super) fn read(
    json: &[u8],
    own_buffer: Option<&[u8]>,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let document: Document =
        serde_json::from_slice(json).map_err(|e| bad("JSON", e.to_string()))?;
    let required = document.extensions_required.iter().map(String::as_str);
    let skipped: Vec<&str> = required.filter(|name| !READ_EXTENSIONS.contains(name)).collect();
    if !skipped.is_empty() {
        reading.warn_skipped("required extensions", &skipped);
    }
    // Buffers: from URIs, or within the GLB file.
    let mut uris = Uris::new(parts);
    let mut fetched = Vec::new();
    for (index, buffer) in document.buffers.iter().enumerate() {
        fetched.push(match &buffer.uri {
            Some(uri) => Some(uris.fetch(uri, &format!("buffer {index}"))?),
            None => None,
        });
    }
    let mut buffers: Vec<&[u8]> = Vec::new();
    for (index, (bytes, buffer)) in fetched.iter().zip(&document.buffers).enumerate() {
        // Only the first buffer may be the chunk within a GLB file.
        let bytes = bytes
            .as_ref()
            .map(|bytes| &bytes[..])
            .or(own_buffer.filter(|_| index == 0))
            .unwrap_or_default();
        // A buffer may be longer than it declares, as GLB pads chunks to four bytes.
        let Some(bytes) = bytes.get(..buffer.byte_length as usize) else {
            return Err(IngestError::Size {
                format: FORMAT,
                promised: buffer.byte_length.into(),
                held: bytes.len() as u128,
                content: format!("buffer {index}"),
            });
        };
        buffers.push(bytes);
    }

    // Splats of all mesh instances, or else the triangles.
    let mut all = Gaussians::default();
    let mut found = false;
    let placed = instances::mesh_instances(&document)?;
    skipped::check(&document, &placed, reading);
    for placed in &placed {
        for (index, primitive) in placed.mesh.primitives.iter().enumerate() {
            if !primitive.extensions.contains_key(EXTENSION) {
                continue;
            }
            found = true;
            let place = format!("node {}, primitive {index}", placed.node);
            splat_settings::check(primitive, reading);
            let mut part =
                read_primitive(&document, &buffers, primitive, &place, uris.parts(), reading)?;
            placed.apply(&mut part)?;
            all.append(&part);
            check_count(all.len() as u64)?;
        }
    }
    // A scene with both is drawn by its splats alone.
    if !found {
        all = mesh::read(json, &placed, &buffers, &mut uris)?;
    }
    reading.accept(all, &Field::plain_name)
}

/// Reads one primitive, in the axes of its mesh.
fn read_primitive(
    document: &Document,
    buffers: &[&[u8]],
    primitive: &Primitive,
    place: &str,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    match primitive.compressed_by() {
        Some((SPZ, settings)) => {
            let view = settings.get("bufferView").and_then(Value::as_u64);
            let bytes = view
                .and_then(|view| document.view_bytes(buffers, view as usize))
                .ok_or_else(|| bad(place, format!("{SPZ} has no bufferView that exists")))?;
            let mut part =
                spz::read_gzip_within(bytes, bytes.len() as u64, parts.budget(), reading)?;
            turn_compressed(&mut part, reading);
            return Ok(part);
        }
        Some((extension, _)) => {
            return Err(bad(place, format!("is compressed by {extension}; export it without")));
        }
        None => {}
    }
    let column = |name: &str, width: usize| {
        let index = *primitive
            .attributes
            .get(name)
            .ok_or_else(|| bad(place, format!("has no attribute {name}")))?;
        Column::find(document, buffers, index, width)
            .map_err(|reason| bad(&format!("{place}, {name}"), reason))
    };
    let own = |name: &str, width: usize| column(&format!("{EXTENSION}:{name}"), width);
    let positions = column("POSITION", 3)?;
    let rotations = own("ROTATION", 4)?;
    let scales = own("SCALE", 3)?;
    let opacities = own("OPACITY", 1)?;
    let sh_degree = degree(&primitive.attributes);
    if sh_degree.is_none() {
        reading.warn(format!(
            "{place} has no {EXTENSION}:SH_DEGREE_0_COEF_0: COLOR_0 is drawn, which is linear light"
        ));
    }
    let mut colours = Vec::new();
    // Degree l has 2 l + 1 coefficients, named by degree and index in the order in memory.
    for (degree, n) in (0..=sh_degree.unwrap_or(0)).flat_map(|l| (0..=2 * l).map(move |n| (l, n))) {
        match sh_degree {
            Some(_) => colours.push(own(&format!("SH_DEGREE_{degree}_COEF_{n}"), 3)?),
            None => colours.push(column("COLOR_0", 3).or_else(|_| column("COLOR_0", 4))?),
        }
    }
    let count = positions.count;
    for column in [&rotations, &scales, &opacities].into_iter().chain(&colours) {
        if column.count != count {
            let reason = format!("an attribute has {} rows for {count} positions", column.count);
            return Err(bad(place, reason));
        }
    }
    // Nodes may instance one mesh many times, so that counts as unpacking, too.
    let sh_degree_held = sh_degree.unwrap_or(0);
    // 56 = 24 for the position in 64 bits, 16 rotation, 12 scales and 4 opacity; each coefficient
    // has 12.
    let row_bytes = 56 + 12 * sh::coefficients(sh_degree_held) as u128;
    parts.budget().unpack(FORMAT, place, row_bytes * count as u128)?;
    let mut g = Gaussians::with_capacity(sh_degree_held, check_count(count as u64)?);
    g.means_m.extend((0..count).map(|i| positions.row::<3>(i)));
    g.quats_wxyz.extend((0..count).map(|i| {
        let [x, y, z, w] = rotations.row::<4>(i).map(|q| q as f32);
        [w, x, y, z]
    }));
    let is_negative = |i: &usize| scales.row::<3>(*i).iter().any(|&s| s < 0.0);
    // Nearly all logarithms are negative, and no standard deviation is, except for damaged ones.
    // One in ten, so that a few damaged scales do not turn a whole scene into logarithms.
    let are_logarithms = (0..count).filter(is_negative).count() * 10 > count;
    g.ln_scales.extend((0..count).map(|i| {
        scales.row::<3>(i).map(|s| if are_logarithms { s as f32 } else { activation::ln_scale(s) })
    }));
    g.logit_opacities.extend((0..count).map(|i| activation::logit(opacities.row::<1>(i)[0])));
    for i in 0..count {
        for colour in &colours {
            let rgb = colour.row::<3>(i);
            g.sh.extend(rgb.map(|c| {
                // Base colours are linear light, and coefficients are of the stored (sRGB) colour.
                if sh_degree.is_some() { c as f32 } else { activation::dc(stored_from_linear(c)) }
            }));
        }
    }
    Ok(g)
}

/// Turns splats of an SPZ from the axes that it records to those of glTF. If it records none, they
/// are in those of glTF: writers compress the attributes as they are, although SPZ of its own is
/// right, up, back.
fn turn_compressed(part: &mut Gaussians, reading: &mut Reading) {
    // x left, y up, z to the front of what faces the viewer.
    let Some(own) = Axes::from_letters("LUF") else { return };
    match reading.take_axes() {
        Some(FileAxes { axes, said_by, is_assumed: false }) => {
            axes.to(&own).apply(part);
            reading.warn(format!("{said_by}: turned to the axes of glTF, x left, y up, z to the front"));
        }
        Some(FileAxes { is_assumed: true, .. }) | None => reading.warn(format!(
            "{SPZ}: the SPZ records no axes, so that those of the glTF are assumed and not SPZ's right, up, back; if it is \
             drawn back to front, give the axes with a half turn about y"
        )),
    }
}

/// The highest SH degree with an attribute.
fn degree(attributes: &BTreeMap<String, usize>) -> Option<u8> {
    let has = |l: &u8| {
        let prefix = format!("{EXTENSION}:SH_DEGREE_{l}_");
        attributes.keys().any(|name| name.starts_with(&prefix))
    };
    (0..=sh::MAX_DEGREE).rev().find(has)
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: FORMAT, place: place.into(), reason }
}
