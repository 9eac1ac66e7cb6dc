//! Ordinary meshes: their triangles are covered with flat Gaussians in the colour of their material.
//!
//! Long triangles are halved, and every one is cut into k² alike ones, each about as large as its share of
//! the whole surface, which become Gaussians with the moments of a uniform triangle, widened so that
//! neighbours close up. Colour is the material's base colour, texture and vertex colours; there is no light in it.

use std::collections::BTreeMap;
use std::io::Cursor;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3, DVec4};
use gltf::Semantic;
use gltf::accessor::{DataType, Dimensions};
use gltf::image::Source;
use gltf::mesh::Mode;
use image::{ImageReader, RgbaImage};

use super::instances::MeshInstance;
use super::{FORMAT, activation, bad};
use crate::ingest::IngestError;
use crate::ingest::scene_files::SceneFiles;
use crate::limits;
use wildcity_scene::Gaussians;

/// Standard deviations of a Gaussian per standard deviation of its triangle. The triangles of a regular
/// mesh of edge L have 0.20 L, and their centres are 0.58 L apart: 0.6 of that distance leaves no gaps.
const WIDER: f64 = 1.7;
/// Longest edge of what becomes one Gaussian, in edges of a square share: what is longer and narrow would
/// stand out beyond its ends.
const LONGEST: f64 = 4.0;
/// Halvings of one triangle at most, every second of which halves its length: a rail of 4 m becomes
/// pieces of 6 cm.
const HALVINGS: u32 = 12;
/// Thickness per width.
const FLATNESS: f64 = 0.02;
/// Opacity of what is not see-through.
const OPACITY: f64 = 0.97;

/// Covers all triangles of the scene.
pub(super) fn read(
    json: &[u8],
    placed: &[MeshInstance<'_>],
    buffers: &[&[u8]],
    parts: &mut dyn SceneFiles,
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
                textures.insert(image.index(), decode(&image, buffers, parts)?);
            }
            let found = read_primitive(&primitive, buffers, &textures, &place, parts)?;
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
    let share_m2 = area_m2 / f64::from(limits::MESH_GAUSSIANS);
    let longest_m = LONGEST * share_m2.sqrt();
    // What has no area is not seen, however long it is.
    let seen = triangles.into_iter().filter(|triangle| triangle.area_m2() > 0.0);
    let mut parts_left = limits::MESH_PARTS;
    let halved = seen.flat_map(|triangle| {
        let whole = vec![triangle.clone()];
        let halved = triangle.halved(longest_m);
        // What is left whole stands out beyond its ends, and takes no memory.
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
    parts.budget().unpack(FORMAT, "meshes", 56 * count)?;
    let mut all = Gaussians::with_capacity(0, count as usize);
    for triangle in &triangles {
        triangle.cover(triangle.cuts(share_m2), &mut all);
    }
    Ok(all)
}

/// A triangle of the scene.
#[derive(Clone)]
struct Triangle {
    corners_m: [DVec3; 3],
    /// Linear red, green, blue, and opacity at the corners, before the texture's.
    colors: [DVec4; 3],
    uv: [DVec2; 3],
    material: Material,
}

/// What the corners do not say.
#[derive(Clone)]
struct Material {
    texture: Option<Texture>,
    /// Opacity below which nothing is there.
    cutoff: f64,
}

type Texture = std::sync::Arc<RgbaImage>;

impl Triangle {
    fn area_m2(&self) -> f64 {
        let [a, b, c] = self.corners_m;
        let area_m2 = 0.5 * (b - a).cross(c - a).length();
        if area_m2.is_finite() { area_m2 } else { 0.0 }
    }

    /// SceneFiles that are cut across the longest edge until it is short, or lies well within the triangle's
    /// own width.
    fn halved(self, longest_m: f64) -> Vec<Self> {
        let (mut whole, mut parts) = (vec![(self, 0)], Vec::new());
        while let Some((triangle, halvings)) = whole.pop() {
            let edge_m = |k: usize| triangle.corners_m[k].distance(triangle.corners_m[(k + 1) % 3]);
            let k = (0..3).max_by(|&a, &b| edge_m(a).total_cmp(&edge_m(b))).unwrap_or(0);
            let width_m = 2.0 * triangle.area_m2() / edge_m(k);
            // Not for NaN either.
            let is_long = edge_m(k) > longest_m && edge_m(k) > LONGEST * width_m;
            if !is_long || halvings == HALVINGS {
                parts.push(triangle);
                continue;
            }
            for replaced in [k, (k + 1) % 3] {
                let mut half = triangle.clone();
                let other = if replaced == k { (k + 1) % 3 } else { k };
                half.corners_m[replaced] =
                    0.5 * (triangle.corners_m[replaced] + triangle.corners_m[other]);
                half.colors[replaced] = 0.5 * (triangle.colors[replaced] + triangle.colors[other]);
                half.uv[replaced] = 0.5 * (triangle.uv[replaced] + triangle.uv[other]);
                whole.push((half, halvings + 1));
            }
        }
        parts
    }

    /// How many parts each edge is cut into; none for what has no area.
    fn cuts(&self, share_m2: f64) -> u32 {
        // At most all of the surface: the root of MESH_GAUSSIANS.
        (self.area_m2() / share_m2).sqrt().ceil() as u32
    }

    fn cover(&self, cuts: u32, all: &mut Gaussians) {
        let Some((quat_wxyz, scales_m)) = self.shape(cuts) else { return };
        let ln_scales = scales_m.map(activation::ln_scale);
        for i in 0..cuts {
            for j in 0..cuts - i {
                let centre = |third: f64| [f64::from(i) + third, f64::from(j) + third];
                let upright = Some(centre(1.0 / 3.0));
                let turned = (j + 1 < cuts - i).then(|| centre(2.0 / 3.0));
                for [u, v] in upright.into_iter().chain(turned) {
                    let [u, v] = [u, v].map(|share| share / f64::from(cuts));
                    let (rgb, opacity) = self.color([1.0 - u - v, u, v]);
                    if opacity <= 0.0 {
                        continue;
                    }
                    let [a, b, c] = self.corners_m;
                    all.means_m.push((a + u * (b - a) + v * (c - a)).to_array());
                    all.quats_wxyz.push(quat_wxyz);
                    all.ln_scales.push(ln_scales);
                    all.logit_opacities.push(activation::logit(OPACITY * opacity));
                    all.sh.extend(rgb.map(activation::dc));
                }
            }
        }
    }

    /// Rotation (w, x, y, z) and standard deviations, in metres, of each part. A uniform triangle has the
    /// covariance Σ (corner - centre)(corner - centre)ᵀ / 12, whichever way it is turned.
    fn shape(&self, cuts: u32) -> Option<([f32; 4], [f64; 3])> {
        let [a, b, c] = self.corners_m;
        let normal = (b - a).cross(c - a).try_normalize()?;
        let across = (b - a).try_normalize()?;
        let up = normal.cross(across);
        let centre_m = (a + b + c) / 3.0;
        let mut covariance = DMat2::ZERO;
        for corner_m in self.corners_m {
            let d = DVec2::new(across.dot(corner_m - centre_m), up.dot(corner_m - centre_m));
            covariance += DMat2::from_cols(d * d.x, d * d.y);
        }
        covariance *= (WIDER / f64::from(cuts)).powi(2) / 12.0;
        // The angle of a symmetric matrix's larger axis, and its two variances.
        let [xx, xy, yy] = [covariance.x_axis.x, covariance.x_axis.y, covariance.y_axis.y];
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let spread = (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
        let middle = 0.5 * (xx + yy);
        let [long_m, short_m] = [middle + spread, (middle - spread).max(0.0)].map(f64::sqrt);
        let long = angle.cos() * across + angle.sin() * up;
        let axes = DMat3::from_cols(long, normal.cross(long), normal);
        let DQuat { x, y, z, w } = DQuat::from_mat3(&axes).normalize();
        Some(([w, x, y, z].map(|q| q as f32), [long_m, short_m, FLATNESS * long_m]))
    }

    /// Display colour and opacity, 0 to 1, at a point by its shares of the corners.
    fn color(&self, shares: [f64; 3]) -> ([f64; 3], f64) {
        let at = |values: [DVec4; 3]| (0..3).map(|k| shares[k] * values[k]).sum::<DVec4>();
        let mut color = at(self.colors);
        if let Some(image) = &self.material.texture {
            let uv = (0..3).map(|k| shares[k] * self.uv[k]).sum::<DVec2>();
            let place = |share: f64, size: u32| {
                // Repeated, as textures are unless they say otherwise.
                ((share.rem_euclid(1.0) * f64::from(size)) as u32).min(size - 1)
            };
            let texel = image.get_pixel(place(uv.x, image.width()), place(uv.y, image.height()));
            let [red, green, blue, alpha] = texel.0.map(|value| f64::from(value) / 255.0);
            let [red, green, blue] = [red, green, blue].map(linear_from_display);
            color *= DVec4::new(red, green, blue, alpha);
        }
        let opacity = if color.w >= self.material.cutoff { color.w.clamp(0.0, 1.0) } else { 0.0 };
        ([color.x, color.y, color.z].map(display_from_linear), opacity)
    }
}

/// The triangles of one primitive, in the mesh's own frame.
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
    let material = primitive.material();
    let base = material.pbr_metallic_roughness();
    let set = base.base_color_texture().map_or(0, |texture| texture.tex_coord());
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

    let positions_m: Vec<DVec3> = positions.map(|m| DVec3::from_array(m.map(f64::from))).collect();
    let uv: Option<Vec<DVec2>> =
        uv.map(|uv| uv.map(|uv| DVec2::from_array(uv.map(f64::from))).collect());
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
    let indices: Vec<usize> = match reader.read_indices() {
        Some(indices) => indices.into_u32().map(|index| index as usize).collect(),
        None => (0..corners).collect(),
    };
    let (whole, _) = indices.as_chunks::<3>();
    let triangle = |corners: &[usize; 3]| {
        let missing = || bad(place, format!("a corner of {corners:?} is not there"));
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

/// The image of the base colour.
fn image_of<'a>(primitive: &gltf::Primitive<'a>) -> Option<gltf::Image<'a>> {
    let texture = primitive.material().pbr_metallic_roughness().base_color_texture();
    texture.map(|texture| texture.texture().source())
}

fn decode(
    image: &gltf::Image<'_>,
    buffers: &[&[u8]],
    parts: &mut dyn SceneFiles,
) -> Result<Texture, IngestError> {
    let place = &format!("image {}", image.index());
    let (file, fetched);
    match image.source() {
        Source::View { view, .. } => {
            let end = view.offset().checked_add(view.length());
            let buffer = buffers.get(view.buffer().index()).copied().unwrap_or_default();
            let bytes = end.and_then(|end| buffer.get(view.offset()..end));
            file = bytes.ok_or_else(|| bad(place, "its bufferView is not there".into()))?;
        }
        Source::Uri { uri, .. } => {
            fetched = super::fetch(uri, place, parts)?;
            file = &fetched;
        }
    }
    let damaged = |e: &dyn std::fmt::Display| bad(place, format!("is no PNG or JPEG: {e}"));
    let open = || ImageReader::new(Cursor::new(file)).with_guessed_format();
    let size_px = open().map_err(|e| damaged(&e))?.into_dimensions().map_err(|e| damaged(&e))?;
    let pixels = u128::from(size_px.0) * u128::from(size_px.1);
    // Decoded, and then as RGBA.
    parts.budget().unpack(FORMAT, place, 8 * pixels)?;
    let decoded = open().map_err(|e| damaged(&e))?.decode().map_err(|e| damaged(&e))?;
    Ok(decoded.into_rgba8().into())
}

/// What the crate's readers take for granted.
fn check(
    accessor: &gltf::Accessor<'_>,
    dimensions: &[Dimensions],
    types: &[DataType],
    buffers: &[&[u8]],
) -> Result<(), String> {
    let (index, kind) = (accessor.index(), (accessor.dimensions(), accessor.data_type()));
    if !(dimensions.contains(&kind.0) && types.contains(&kind.1)) {
        return Err(format!("accessor {index} is {kind:?}; {dimensions:?} of {types:?} are read"));
    }
    if accessor.sparse().is_some() {
        return Err(format!("accessor {index} is sparse; export it dense"));
    }
    let view = accessor.view().ok_or(format!("accessor {index} has no bufferView"))?;
    let (count, size) = (accessor.count() as u128, accessor.size() as u128);
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

/// IEC 61966-2-1.
fn linear_from_display(value: f64) -> f64 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// IEC 61966-2-1.
fn display_from_linear(value: f64) -> f64 {
    let value = value.clamp(0.0, 1.0);
    if value <= 0.003_130_8 { 12.92 * value } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle(corners_m: [[f64; 3]; 3]) -> Triangle {
        Triangle {
            corners_m: corners_m.map(DVec3::from_array),
            colors: [DVec4::new(1.0, 0.0, 0.0, 1.0), DVec4::Y, DVec4::Z].map(|c| c.with_w(1.0)),
            uv: [DVec2::ZERO; 3],
            material: Material { texture: None, cutoff: 0.0 },
        }
    }

    /// The parts together have the triangle's own mean, and its covariance: that of their centres and
    /// their own, which is widened.
    #[test]
    fn the_parts_have_the_moments_of_the_whole() {
        let whole = triangle([[1.0, 2.0, 3.0], [4.0, 2.5, 2.0], [0.0, 5.0, 7.0]]);
        let [a, b, c] = whole.corners_m;
        let centre_m = (a + b + c) / 3.0;
        let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        let exact = whole.corners_m.map(|m| outer(m - centre_m)).into_iter().sum::<DMat3>() / 12.0;
        for cuts in [1, 2, 7] {
            let mut parts = Gaussians::with_capacity(0, 0);
            whole.cover(cuts, &mut parts);
            assert_eq!(parts.len(), (cuts * cuts) as usize);
            let share = 1.0 / parts.len() as f64;
            let mean_m: DVec3 =
                parts.means_m.iter().map(|&mean_m| share * DVec3::from_array(mean_m)).sum();
            assert!((mean_m - centre_m).length() < 1e-12, "{mean_m}");
            let mut covariance = DMat3::ZERO;
            for i in 0..parts.len() {
                let [w, x, y, z] = parts.quats_wxyz[i].map(f64::from);
                let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
                // Flat parts: the third axis is what was added.
                let [long, short, _] = parts.ln_scales[i].map(|ln| f64::from(ln).exp() / WIDER);
                let half = axes * DMat3::from_diagonal(DVec3::new(long, short, 0.0));
                let d = DVec3::from_array(parts.means_m[i]) - centre_m;
                covariance += (outer(d) + half * half.transpose()) * share;
            }
            let off = (covariance - exact).to_cols_array().map(f64::abs);
            assert!(off.iter().all(|&off| off < 1e-6), "{cuts}: {off:?}");
        }
    }

    #[test]
    fn a_rail_is_halved_until_its_parts_are_short() {
        let rail = triangle([[0.0; 3], [5.0, 0.0, 0.0], [5.0, 0.01, 0.0]]);
        let area_m2 = rail.area_m2();
        let parts = rail.halved(0.1);
        // Of its two long edges one is halved first, and then both halves' edges in turn.
        assert!((100..=1 << HALVINGS).contains(&parts.len()), "{}", parts.len());
        let sum_m2: f64 = parts.iter().map(Triangle::area_m2).sum();
        assert!((sum_m2 / area_m2 - 1.0).abs() < 1e-12);
        let longest_m = parts.iter().flat_map(|part| {
            let [a, b, c] = part.corners_m;
            [a.distance(b), b.distance(c), c.distance(a)]
        });
        let longest_m = longest_m.fold(0.0, f64::max);
        assert!(longest_m <= 0.1, "{longest_m}");
        // However long, and however thin; and what is not thin stays whole.
        let line = triangle([[0.0; 3], [1e9, 0.0, 0.0], [2e9, 0.0, 0.0]]);
        assert_eq!(line.halved(1e-3).len(), 1 << HALVINGS);
        assert_eq!(triangle([[0.0; 3], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]]).halved(0.1).len(), 1);
    }

    #[test]
    fn colour_runs_between_the_corners_and_what_is_cut_off_is_not_there() {
        let mut whole = triangle([[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let ([red, green, blue], opacity) = whole.color([0.5, 0.5, 0.0]);
        assert_eq!((red, blue, opacity), (green, 0.0, 1.0));
        assert!((red - 0.7354).abs() < 1e-4, "half the light, displayed: {red}");
        whole.material = Material { texture: None, cutoff: 2.0 };
        let mut parts = Gaussians::with_capacity(0, 0);
        whole.cover(3, &mut parts);
        assert_eq!(parts.len(), 0);
        // Nothing is made of a line.
        let line = triangle([[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!(line.cuts(1e-3), 0);
        line.cover(1, &mut parts);
        assert_eq!(parts.len(), 0);
    }
}
