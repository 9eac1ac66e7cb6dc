//! Ordinary meshes: their triangles are covered with flat Gaussians in the colour of their
//! material.
//!
//! Long triangles are halved first (`triangle.rs` covers each). The colour is what a camera sees in
//! white light from all sides: the material's base colour, plus the light that it emits
//! (`material.rs`).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt;
use std::sync::Arc;

use glam::{DVec2, DVec3, DVec4};
use gltf::Semantic;
use gltf::accessor::{DataType, Dimensions};
use gltf::mesh::Mode;

use super::instances::MeshInstance;
use super::material::{self, MaterialSource, TextureArea};
use super::triangle::{LONGEST, Material, Triangle};
use super::uris::Uris;
use super::{FORMAT, bad};
use crate::ingest::IngestError;
use crate::ingest::scene_files::SceneFiles;
use crate::limits;
use wildcity_scene::Gaussians;

/// Bytes of a Gaussian of a mesh in memory.
const GAUSSIAN_BYTES: u64 = 56;
/// Largest number of Gaussians per requested one, because of small triangles and rounding to whole
/// cells.
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
        let no_mesh = || bad(&format!("node {}", placed.node), "has no mesh".into());
        let mesh = meshes.get(placed.index).ok_or_else(no_mesh)?;
        for primitive in mesh.primitives() {
            let place =
                Place { node: placed.node, mesh: mesh.index(), primitive: primitive.index() };
            let source =
                MaterialSource::from_gltf(&primitive.material()).map_err(|r| place.bad(r))?;
            // Each image is decoded once, however many primitives use it.
            for image in source.images() {
                if let Entry::Vacant(unread) = textures.entry(image.index()) {
                    unread.insert(material::decode(image, buffers, uris)?);
                }
            }
            let material = Arc::new(source.material(&textures));
            let reader = PrimitiveReader { primitive, buffers, source, material, place };
            let found = reader.read(uris.parts())?;
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
    // The area of one Gaussian, if the requested number covered the scene evenly.
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
    // A triangle is divided into `cuts`² cells with a Gaussian each.
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

/// Where a primitive is, for messages.
#[derive(Clone, Copy)]
struct Place {
    node: usize,
    mesh: usize,
    primitive: usize,
}

impl Place {
    fn bad(self, reason: String) -> IngestError {
        bad(&self.to_string(), reason)
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { node, mesh, primitive } = self;
        write!(f, "node {node}, mesh {mesh}, primitive {primitive}")
    }
}

/// Reads the triangles of one primitive.
struct PrimitiveReader<'a> {
    primitive: gltf::Primitive<'a>,
    buffers: &'a [&'a [u8]],
    source: MaterialSource<'a>,
    material: Arc<Material>,
    place: Place,
}

/// The attributes of a primitive at each corner.
struct Corners {
    positions_m: Vec<DVec3>,
    /// Vertex colours; none if all are white.
    colors: Option<Vec<DVec4>>,
    /// Coordinates in the base colour's texture, and in that of the emitted light; none without a
    /// texture.
    uv: Option<Vec<DVec2>>,
    emissive_uv: Option<Vec<DVec2>>,
}

impl PrimitiveReader<'_> {
    /// The triangles, in the axes of the mesh.
    fn read(&self, parts: &mut dyn SceneFiles) -> Result<Vec<Triangle>, IngestError> {
        let mode = self.primitive.mode();
        if mode != Mode::Triangles {
            let reason = format!("has mode {mode:?}; only lists of triangles are read");
            return Err(self.place.bad(reason));
        }
        self.check_accessors().map_err(|reason| self.place.bad(reason))?;

        // Count what will be allocated.
        let reader = self.primitive.reader(|buffer| self.buffers.get(buffer.index()).copied());
        let no_positions = || self.place.bad("has no POSITION".into());
        let corners = reader.read_positions().ok_or_else(no_positions)?.len();
        let count = reader.read_indices().map_or(corners, |indices| indices.into_u32().len()) / 3;
        let emissive_bytes = self.source.emissive_area().map_or(0, |_| size_of::<[DVec2; 3]>());
        let bytes = count * (size_of::<Triangle>() + emissive_bytes)
            + corners * (3 * size_of::<DVec4>() + emissive_bytes);
        parts.budget().unpack(FORMAT, &self.place.to_string(), bytes as u128)?;

        // Three corners each, by index or in order.
        let corners = self.corners().ok_or_else(no_positions)?;
        let indices: Vec<usize> = match reader.read_indices() {
            Some(indices) => indices.into_u32().map(|index| index as usize).collect(),
            None => (0..corners.positions_m.len()).collect(),
        };
        let triangle = |indices: &[usize; 3]| {
            let missing = || self.place.bad(format!("a corner of {indices:?} does not exist"));
            self.triangle(&corners, indices).ok_or_else(missing)
        };
        indices.as_chunks::<3>().0.iter().map(triangle).collect()
    }

    /// Checks the accessors before the gltf crate reads them, and that there are those that the
    /// material names.
    fn check_accessors(&self) -> Result<(), String> {
        const FRACTIONS: &[DataType] = &[DataType::U8, DataType::U16, DataType::F32];
        const INDICES: &[DataType] = &[DataType::U8, DataType::U16, DataType::U32];
        let check = |accessor: Option<gltf::Accessor<'_>>, dimensions: &[_], types: &[_]| {
            accessor.map_or(Ok(()), |a| check(&a, dimensions, types, self.buffers))
        };
        let get = |semantic| self.primitive.get(&semantic);
        check(get(Semantic::Positions), &[Dimensions::Vec3], &[DataType::F32])?;
        check(get(Semantic::Colors(0)), &[Dimensions::Vec3, Dimensions::Vec4], FRACTIONS)?;
        check(self.primitive.indices(), &[Dimensions::Scalar], INDICES)?;
        for area in self.source.areas() {
            let coordinates = get(Semantic::TexCoords(area.set));
            if coordinates.is_none() {
                // glTF 2.0, textureInfo.texCoord: a primitive must have them for the material to be
                // applicable.
                return Err(format!(
                    "has no attribute TEXCOORD_{}, which the {} of its material names; export the mesh with texture \
                     coordinates, or the material without this texture",
                    area.set, area.texture
                ));
            }
            check(coordinates, &[Dimensions::Vec2], FRACTIONS)?;
        }
        Ok(())
    }

    /// The attributes of the primitive at its corners; none without positions.
    fn corners(&self) -> Option<Corners> {
        let reader = self.primitive.reader(|buffer| self.buffers.get(buffer.index()).copied());
        let uv = |area: Option<&TextureArea>| {
            let area = area?;
            let uv = reader.read_tex_coords(area.set)?.into_f32();
            Some(uv.map(|uv| area.place(DVec2::from_array(uv.map(f64::from)))).collect())
        };
        let colors = reader.read_colors(0).map(|colors| colors.into_rgba_f32());
        let positions_m = reader.read_positions()?.map(|m| DVec3::from_array(m.map(f64::from)));
        Some(Corners {
            positions_m: positions_m.collect(),
            colors: colors
                .map(|colors| colors.map(|c| DVec4::from_array(c.map(f64::from))).collect()),
            uv: uv(self.source.base_area()),
            emissive_uv: uv(self.source.emissive_area()),
        })
    }

    /// The triangle of three corners; none if one of them does not exist.
    fn triangle(&self, corners: &Corners, indices: &[usize; 3]) -> Option<Triangle> {
        let Corners { positions_m, colors, uv, emissive_uv } = corners;
        let colors = match colors {
            Some(colors) => at(colors, indices)?,
            None => [DVec4::ONE; 3],
        };
        let emissive_uv = emissive_uv.as_ref().map(|uv| at(uv, indices).ok_or(())).transpose();
        Some(Triangle {
            corners_m: at(positions_m, indices)?,
            colors: colors.map(|color| self.source.base_color(color)),
            uv: uv.as_ref().map_or(Some([DVec2::ZERO; 3]), |uv| at(uv, indices))?,
            // Boxed, because few triangles emit light: the others take less memory so.
            emissive_uv: emissive_uv.ok()?.map(Box::new),
            material: Arc::clone(&self.material),
        })
    }
}

/// The values of three corners; none if one of them does not exist.
fn at<T: Copy>(values: &[T], indices: &[usize; 3]) -> Option<[T; 3]> {
    let [a, b, c] = indices.map(|index| values.get(index).copied());
    Some([a?, b?, c?])
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
    // The last row need not be padded to the stride.
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
