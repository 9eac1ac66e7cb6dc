//! Ordinary meshes: their triangles are covered with flat Gaussians in the colour of their
//! material.
//!
//! Long triangles are halved first (`triangle.rs` covers each). The colour is the product of the
//! material's base colour, its texture, and the vertex colours, without lighting.

use std::collections::BTreeMap;
use std::io::Cursor;

use glam::{DVec2, DVec3, DVec4};
use gltf::Semantic;
use gltf::accessor::{DataType, Dimensions};
use gltf::image::Source;
use gltf::mesh::Mode;
use image::ImageReader;

use super::instances::MeshInstance;
use super::triangle::{LONGEST, Material, Texture, Triangle};
use super::uris::Uris;
use super::{FORMAT, bad};
use crate::ingest::IngestError;
use crate::ingest::scene_files::SceneFiles;
use crate::limits;
use wildcity_scene::Gaussians;

/// Bytes of a Gaussian of a mesh in memory.
const GAUSSIAN_BYTES: u64 = 56;
/// Small triangles, and rounding to whole cells, make up to so many Gaussians of each one that was asked for.
const MOST_PER_ASKED: u64 = 4;

/// Covers all triangles of the scene.
pub(super) fn read(
    json: &[u8],
    placed: &[MeshInstance<'_>],
    buffers: &[&[u8]],
    uris: &mut Uris<'_>,
) -> Result<Gaussians, IngestError> {
    let root = gltf::json::deserialize::from_slice(json).map_err(|e| bad("JSON", e.to_string()))?;
    let document = gltf::Document::from_json(root).map_err(|e| bad("JSON", e.to_string()))?;
    let meshes: Vec<gltf::Mesh<'_>> = document.meshes().collect();
    let mut textures = BTreeMap::new();
    let mut triangles = Vec::new();
    for placed in placed {
        let place = format!("node {}", placed.node);
        let mesh = meshes.get(placed.index).ok_or_else(|| bad(&place, "has no mesh".into()))?;
        for primitive in mesh.primitives() {
            if let Some(image) = image_of(&primitive)
                && !textures.contains_key(&image.index())
            {
                textures.insert(image.index(), decode(&image, buffers, uris)?);
            }
            let found = read_primitive(&primitive, buffers, &textures, &place, uris.parts())?;
            triangles.extend(found.into_iter().map(|triangle| Triangle {
                corners_m: triangle.corners_m.map(|m| placed.scene_from_mesh.transform_point3(m)),
                ..triangle
            }));
        }
    }
    let area_m2: f64 = triangles.iter().map(Triangle::area_m2).sum();
    if !(area_m2 > 0.0 && area_m2.is_finite()) {
        return Err(bad(
            "meshes",
            "the scene has neither splats nor triangles with an area".into(),
        ));
    }
    let share_m2 = area_m2 / f64::from(uris.parts().mesh_gaussians());
    let longest_m = LONGEST * share_m2.sqrt();
    // A triangle without area is invisible, however long it is.
    let seen = triangles.into_iter().filter(|triangle| triangle.area_m2() > 0.0);
    let mut parts_left = limits::MESH_PARTS;
    let halved = seen.flat_map(|triangle| {
        let whole = vec![triangle.clone()];
        let halved = triangle.halved(longest_m);
        // Beyond the limit, a triangle stays whole: its Gaussian reaches beyond its ends, but takes
        // no more memory.
        match parts_left.checked_sub(halved.len()) {
            Some(left) => {
                parts_left = left;
                halved
            }
            None => whole,
        }
    });
    let triangles: Vec<Triangle> = halved.collect();
    let count: u128 = triangles.iter().map(|t| u128::from(t.cuts(share_m2)).pow(2)).sum();
    // The caller may ask for more Gaussians than a file of this size would be allowed.
    let more = uris.parts().mesh_gaussians().saturating_sub(limits::MESH_GAUSSIANS);
    uris.parts().budget().allow(GAUSSIAN_BYTES * MOST_PER_ASKED * u64::from(more));
    uris.parts().budget().unpack(FORMAT, "meshes", u128::from(GAUSSIAN_BYTES) * count)?;
    let mut all = Gaussians::with_capacity(0, count as usize);
    for triangle in &triangles {
        triangle.cover(triangle.cuts(share_m2), &mut all);
    }
    Ok(all)
}

/// The triangles of one primitive, in the axes of its mesh.
fn read_primitive(
    primitive: &gltf::Primitive<'_>,
    buffers: &[&[u8]],
    textures: &BTreeMap<usize, Texture>,
    place: &str,
    parts: &mut dyn SceneFiles,
) -> Result<Vec<Triangle>, IngestError> {
    let place = &format!("{place}, primitive {}", primitive.index());
    if primitive.mode() != Mode::Triangles {
        let reason = format!("has mode {:?}; only lists of triangles are read", primitive.mode());
        return Err(bad(place, reason));
    }
    // Check the accessors before the gltf crate reads them.
    let material = primitive.material();
    let base = material.pbr_metallic_roughness();
    let TextureArea { set, offset, scale } =
        TextureArea::of(base.base_color_texture()).map_err(|reason| bad(place, reason))?;
    const FRACTIONS: &[DataType] = &[DataType::U8, DataType::U16, DataType::F32];
    const INDICES: &[DataType] = &[DataType::U8, DataType::U16, DataType::U32];
    for (accessor, dimensions, types) in [
        (primitive.get(&Semantic::Positions), &[Dimensions::Vec3][..], &[DataType::F32][..]),
        (primitive.get(&Semantic::TexCoords(set)), &[Dimensions::Vec2], FRACTIONS),
        (primitive.get(&Semantic::Colors(0)), &[Dimensions::Vec3, Dimensions::Vec4], FRACTIONS),
        (primitive.indices(), &[Dimensions::Scalar], INDICES),
    ] {
        if let Some(accessor) = accessor {
            check(&accessor, dimensions, types, buffers).map_err(|reason| bad(place, reason))?;
        }
    }
    // Count what will be allocated.
    let reader = primitive.reader(|buffer| buffers.get(buffer.index()).copied());
    let positions = reader.read_positions().ok_or_else(|| bad(place, "has no POSITION".into()))?;
    let uv = reader.read_tex_coords(set).map(|uv| uv.into_f32());
    let colors = reader.read_colors(0).map(|colors| colors.into_rgba_f32());
    let corners = positions.len();
    let count = reader.read_indices().map_or(corners, |indices| indices.into_u32().len()) / 3;
    parts.budget().unpack(
        FORMAT,
        place,
        (count * size_of::<Triangle>() + corners * 3 * size_of::<DVec4>()) as u128,
    )?;

    // Positions, colours, and texture coordinates per corner.
    let positions_m: Vec<DVec3> = positions.map(|m| DVec3::from_array(m.map(f64::from))).collect();
    let uv: Option<Vec<DVec2>> =
        uv.map(|uv| uv.map(|uv| offset + scale * DVec2::from_array(uv.map(f64::from))).collect());
    let factor = DVec4::from_array(base.base_color_factor().map(f64::from));
    let colors: Option<Vec<DVec4>> =
        colors.map(|colors| colors.map(|c| DVec4::from_array(c.map(f64::from))).collect());
    let texture = image_of(primitive).and_then(|image| textures.get(&image.index()).cloned());
    let is_solid = material.alpha_mode() == gltf::material::AlphaMode::Opaque;
    let cutoff = match material.alpha_mode() {
        gltf::material::AlphaMode::Mask => material.alpha_cutoff().unwrap_or(0.5).into(),
        _ => 0.0,
    };
    let material = Material { texture: texture.filter(|_| uv.is_some()), cutoff };
    let corner = |index: usize| -> Option<(DVec3, DVec4, DVec2)> {
        let mut color =
            factor * colors.as_ref().map_or(Some(DVec4::ONE), |c| c.get(index).copied())?;
        if is_solid {
            color.w = 1.0;
        }
        let uv = uv.as_ref().map_or(Some(DVec2::ZERO), |uv| uv.get(index).copied())?;
        Some((*positions_m.get(index)?, color, uv))
    };

    // Triangles: three corners each, by index or in order.
    let indices: Vec<usize> = match reader.read_indices() {
        Some(indices) => indices.into_u32().map(|index| index as usize).collect(),
        None => (0..corners).collect(),
    };
    let (whole, _) = indices.as_chunks::<3>();
    let triangle = |corners: &[usize; 3]| {
        let missing = || bad(place, format!("a corner of {corners:?} does not exist"));
        let [Some(a), Some(b), Some(c)] = corners.map(corner) else { return Err(missing()) };
        Ok(Triangle {
            corners_m: [a.0, b.0, c.0],
            colors: [a.1, b.1, c.1],
            uv: [a.2, b.2, c.2],
            material: material.clone(),
        })
    };
    whole.iter().map(triangle).collect()
}

/// The part of an image that a texture shows: `offset + scale * uv` (KHR_texture_transform).
struct TextureArea {
    /// The set of texture coordinates.
    set: u32,
    offset: DVec2,
    scale: DVec2,
}

impl TextureArea {
    /// The area of a texture; all of the image without a texture or without a transform.
    fn of(info: Option<gltf::texture::Info<'_>>) -> Result<Self, String> {
        let mut area = Self { set: 0, offset: DVec2::ZERO, scale: DVec2::ONE };
        let Some(info) = info else { return Ok(area) };
        area.set = info.tex_coord();
        let Some(transform) = info.texture_transform() else { return Ok(area) };
        // Programs disagree about its direction: the formula of the extension's text turns the other way than the
        // viewer of its authors.
        if transform.rotation() != 0.0 {
            return Err("has a texture that KHR_texture_transform rotates; export rotated texture coordinates".into());
        }
        area.set = transform.tex_coord().unwrap_or(area.set);
        area.offset = DVec2::from_array(transform.offset().map(f64::from));
        area.scale = DVec2::from_array(transform.scale().map(f64::from));
        let numbers = [area.offset, area.scale];
        match numbers.iter().all(|pair| pair.is_finite()) {
            true => Ok(area),
            false => Err("has a texture with a KHR_texture_transform that is not finite".into()),
        }
    }
}

/// The image of a primitive's base colour texture.
fn image_of<'a>(primitive: &gltf::Primitive<'a>) -> Option<gltf::Image<'a>> {
    let texture = primitive.material().pbr_metallic_roughness().base_color_texture();
    texture.map(|texture| texture.texture().source())
}

fn decode(
    image: &gltf::Image<'_>,
    buffers: &[&[u8]],
    uris: &mut Uris<'_>,
) -> Result<Texture, IngestError> {
    let place = &format!("image {}", image.index());
    let (file, fetched);
    match image.source() {
        Source::View { view, .. } => {
            let end = view.offset().checked_add(view.length());
            let buffer = buffers.get(view.buffer().index()).copied().unwrap_or_default();
            let bytes = end.and_then(|end| buffer.get(view.offset()..end));
            file = bytes.ok_or_else(|| bad(place, "its bufferView does not exist".into()))?;
        }
        Source::Uri { uri, .. } => {
            fetched = uris.fetch(uri, place)?;
            file = &fetched;
        }
    }
    let damaged = |e: &dyn std::fmt::Display| bad(place, format!("is not a PNG or JPEG: {e}"));
    let open = || ImageReader::new(Cursor::new(file)).with_guessed_format();
    let size_px = open().map_err(|e| damaged(&e))?.into_dimensions().map_err(|e| damaged(&e))?;
    let pixels = u128::from(size_px.0) * u128::from(size_px.1);
    // 4 bytes per pixel as decoded, and 4 as RGBA.
    uris.parts().budget().unpack(FORMAT, place, 8 * pixels)?;
    let decoded = open().map_err(|e| damaged(&e))?.decode().map_err(|e| damaged(&e))?;
    Ok(decoded.into_rgba8().into())
}

/// Checks what the gltf crate's readers assume of an accessor.
fn check(
    accessor: &gltf::Accessor<'_>,
    dimensions: &[Dimensions],
    types: &[DataType],
    buffers: &[&[u8]],
) -> Result<(), String> {
    let index = accessor.index();
    let kind = (accessor.dimensions(), accessor.data_type());
    if !(dimensions.contains(&kind.0) && types.contains(&kind.1)) {
        return Err(format!("accessor {index} is {kind:?}; {dimensions:?} of {types:?} are read"));
    }
    if accessor.sparse().is_some() {
        return Err(format!("accessor {index} is sparse; export it dense"));
    }
    let view = accessor.view().ok_or(format!("accessor {index} has no bufferView"))?;
    let count = accessor.count() as u128;
    let size = accessor.size() as u128;
    let stride = view.stride().map_or(size, |stride| stride as u128);
    if stride < size {
        return Err(format!("byteStride {stride}; {size} to 252 are possible"));
    }
    let end = accessor.offset() as u128 + stride * count.saturating_sub(1) + size;
    let view_end = view.offset() as u128 + view.length() as u128;
    let held = buffers.get(view.buffer().index()).map_or(0, |buffer| buffer.len() as u128);
    if count == 0 || end > view.length() as u128 || view_end > held {
        return Err(format!(
            "{count} rows of accessor {index} do not fit its bufferView, {} bytes from {} of {held}",
            view.length(),
            view.offset()
        ));
    }
    Ok(())
}
