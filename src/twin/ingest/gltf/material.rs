//! The properties of a material that are used, and the images of its textures.
//!
//! Source: glTF 2.0, sections 3.9.2 (metallic-roughness material) and 3.9.3 (additional textures),
//! and the texts of KHR_materials_emissive_strength, KHR_materials_unlit and KHR_texture_transform.
//! In linear light:
//!
//! ```text
//! base  = baseColorFactor * baseColorTexture * COLOR_0
//! light = emissiveFactor * emissiveTexture * emissiveStrength     (0 with KHR_materials_unlit)
//! rgb   = min(base.rgb + light, 1), encoded with the transfer function of sRGB
//! alpha = base.a                                                  (1 with alphaMode OPAQUE)
//! ```
//!
//! The base colour is a surface's in white light of strength 1 from all sides; emitted light is
//! added to reflected light. Textures are decoded from sRGB, and an absent texture is 1. `alpha`
//! covers the objects behind the surface, so that emitted light is as opaque as the surface. An
//! emissive texture without a factor emits nothing, and is not read.

use std::collections::BTreeMap;
use std::io::Cursor;

use glam::{DVec2, DVec3, DVec4};
use gltf::image::Source;
use gltf::material::AlphaMode;
use image::ImageReader;

use super::triangle::{Emission, Material, Texture};
use super::uris::Uris;
use super::{FORMAT, bad};
use crate::ingest::IngestError;

/// The properties of a material that are used.
pub(super) struct MaterialSource<'a> {
    base_factor: DVec4,
    base: Option<(gltf::Image<'a>, TextureArea)>,
    /// The factor times the strength.
    emissive_factor: DVec3,
    emissive: Option<(gltf::Image<'a>, TextureArea)>,
    /// Opacity below which a point is invisible.
    cutoff: f64,
    /// Whether alpha is ignored.
    is_solid: bool,
}

/// The part of an image that a texture shows: `offset + scale * uv` (KHR_texture_transform).
pub(super) struct TextureArea {
    /// Which texture of the material it is.
    pub(super) texture: &'static str,
    /// The set of texture coordinates.
    pub(super) set: u32,
    offset: DVec2,
    scale: DVec2,
}

impl<'a> MaterialSource<'a> {
    /// Reads the properties of a material that are used.
    ///
    /// # Errors
    /// Says what cannot be read.
    pub(super) fn from_gltf(material: &gltf::Material<'a>) -> Result<Self, String> {
        let textured = |name, info: Option<gltf::texture::Info<'a>>| {
            let Some(info) = info else { return Ok(None) };
            let area = TextureArea::new(name, &info)?;
            Ok::<_, String>(Some((info.texture().source(), area)))
        };
        let base = material.pbr_metallic_roughness();
        let emissive_factor = emissive_factor(material)?;
        let emissive_info = match emissive_factor {
            DVec3::ZERO => None,
            _ => material.emissive_texture(),
        };
        Ok(Self {
            base_factor: DVec4::from_array(base.base_color_factor().map(f64::from)),
            base: textured("baseColorTexture", base.base_color_texture())?,
            emissive_factor,
            emissive: textured("emissiveTexture", emissive_info)?,
            cutoff: match material.alpha_mode() {
                AlphaMode::Mask => material.alpha_cutoff().unwrap_or(0.5).into(),
                // No opacity is below 0, so that no point is cut away.
                AlphaMode::Opaque | AlphaMode::Blend => 0.0,
            },
            is_solid: material.alpha_mode() == AlphaMode::Opaque,
        })
    }

    /// The images of its textures.
    pub(super) fn images(&self) -> impl Iterator<Item = &gltf::Image<'a>> {
        [&self.base, &self.emissive].into_iter().flatten().map(|(image, _)| image)
    }

    /// The areas of its textures.
    pub(super) fn areas(&self) -> impl Iterator<Item = &TextureArea> {
        [self.base_area(), self.emissive_area()].into_iter().flatten()
    }

    pub(super) fn base_area(&self) -> Option<&TextureArea> {
        self.base.as_ref().map(|(_, area)| area)
    }

    pub(super) fn emissive_area(&self) -> Option<&TextureArea> {
        self.emissive.as_ref().map(|(_, area)| area)
    }

    /// The base colour at a corner of a vertex colour, before the texture's.
    pub(super) fn base_color(&self, vertex_color: DVec4) -> DVec4 {
        self.base_factor * vertex_color
    }

    /// The material of triangles, with textures by the index of their image.
    pub(super) fn material(&self, textures: &BTreeMap<usize, Texture>) -> Material {
        let texture = |source: &Option<(gltf::Image<'_>, TextureArea)>| {
            source.as_ref().and_then(|(image, _)| textures.get(&image.index()).cloned())
        };
        let emission = Emission { factor: self.emissive_factor, texture: texture(&self.emissive) };
        let emits = self.emissive_factor != DVec3::ZERO;
        Material {
            texture: texture(&self.base),
            emission: emits.then_some(emission),
            cutoff: self.cutoff,
            is_solid: self.is_solid,
        }
    }
}

/// The factor of the emitted light, times its strength. A material without lighting emits none: its
/// light is its base colour.
fn emissive_factor(material: &gltf::Material<'_>) -> Result<DVec3, String> {
    if material.unlit() {
        return Ok(DVec3::ZERO);
    }
    let strength = f64::from(material.emissive_strength().unwrap_or(1.0));
    let factor = DVec3::from_array(material.emissive_factor().map(f64::from));
    let accepted = |number: f64| number.is_finite() && number >= 0.0;
    if accepted(strength) && factor.to_array().into_iter().all(accepted) {
        Ok(strength * factor)
    } else {
        Err(format!(
            "has a material with emissiveFactor {:?} and emissiveStrength {strength}; both are finite and at least 0",
            factor.to_array()
        ))
    }
}

impl TextureArea {
    /// The area of a texture; all of the image without a transform.
    fn new(texture: &'static str, info: &gltf::texture::Info<'_>) -> Result<Self, String> {
        let set = info.tex_coord();
        let mut area = Self { texture, set, offset: DVec2::ZERO, scale: DVec2::ONE };
        let Some(transform) = info.texture_transform() else { return Ok(area) };
        // Programs disagree about its direction: the formula of the extension's text turns the
        // other way than the viewer of its authors.
        if transform.rotation() != 0.0 {
            return Err("has a texture that KHR_texture_transform rotates; export rotated texture coordinates".into());
        }
        area.set = transform.tex_coord().unwrap_or(area.set);
        area.offset = DVec2::from_array(transform.offset().map(f64::from));
        area.scale = DVec2::from_array(transform.scale().map(f64::from));
        let numbers = [area.offset, area.scale];
        if numbers.iter().all(|pair| pair.is_finite()) {
            Ok(area)
        } else {
            Err("has a texture with a KHR_texture_transform that is not finite".into())
        }
    }

    /// Where texture coordinates lie in the image.
    pub(super) fn place(&self, uv: DVec2) -> DVec2 {
        self.offset + self.scale * uv
    }
}

/// Decodes the file of an image, from a buffer or from its URI.
pub(super) fn decode(
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
