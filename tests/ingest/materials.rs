//! The colours of materials: base colour, emitted light, and textures with and without coordinates.

use wildcity_scene::{Gaussians, sh};

use crate::format_files::glb;
use crate::{read, refusal};

/// A PNG of 2 x 1 pixels.
fn png(left: [u8; 4], right: [u8; 4]) -> Vec<u8> {
    let image = image::RgbaImage::from_raw(2, 1, [left, right].concat()).unwrap();
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, image::ImageFormat::Png).unwrap();
    png.into_inner()
}

/// A triangle with a material. TEXCOORD_0 lies in the left half of images, TEXCOORD_1 in the right
/// one. Image 0 is sRGB (188, 0, 64) and (0, 255, 0), half transparent; image 1 is (0, 188, 64) and
/// (255, 0, 128).
fn model(attributes: &str, material: &str, more: &str) -> Vec<u8> {
    let positions: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let uv: [[[f32; 2]; 3]; 2] =
        [[[0.1, 0.2], [0.4, 0.2], [0.1, 0.8]], [[0.6, 0.2], [0.9, 0.2], [0.6, 0.8]]];
    let floats = positions.as_flattened().iter().chain(uv.as_flattened().as_flattened());
    let mut buffer: Vec<u8> = floats.flat_map(|value| value.to_le_bytes()).collect();
    let base = png([188, 0, 64, 128], [0, 255, 0, 128]);
    let emissive = png([0, 188, 64, 0], [255, 0, 128, 0]);
    let mut views = vec![(0, 36), (36, 24), (60, 24)];
    for image in [&base, &emissive] {
        views.push((buffer.len(), image.len()));
        buffer.extend(image);
    }
    let views: Vec<String> = views
        .iter()
        .map(|(at, length)| format!(r#"{{"buffer":0,"byteOffset":{at},"byteLength":{length}}}"#))
        .collect();
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0{attributes}}},"material":0}}]}}],
        "materials":[{{{material}}}],"textures":[{{"source":0}},{{"source":1}}],
        "images":[{{"bufferView":3,"mimeType":"image/png"}},{{"bufferView":4,"mimeType":"image/png"}}],
        "accessors":[
        {{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
        {{"bufferView":1,"componentType":5126,"count":3,"type":"VEC2"}},
        {{"bufferView":2,"componentType":5126,"count":3,"type":"VEC2"}}],
        "bufferViews":[{}],"buffers":[{{"byteLength":{}}}]{more}}}"#,
        views.join(","),
        buffer.len()
    );
    glb((json, buffer))
}

const BOTH: &str = r#","TEXCOORD_0":1,"TEXCOORD_1":2"#;

/// The one colour of all Gaussians, and their one opacity.
fn looks(g: &Gaussians) -> ([f64; 3], f64) {
    let colour = |i: usize| [0, 1, 2].map(|c| 0.5 + sh::C0 * f64::from(g.sh_at(i)[c]));
    let opacity = |i: usize| 1.0 / (1.0 + (-f64::from(g.logit_opacities[i])).exp());
    let first = (colour(0), opacity(0));
    let is_near = |a: f64, b: f64| (a - b).abs() < 1e-6;
    let alike = (0..g.len()).all(|i| {
        let colours = colour(i).into_iter().zip(first.0);
        colours.into_iter().all(|(a, b)| is_near(a, b)) && is_near(opacity(i), first.1)
    });
    assert!(alike && g.len() > 100_000);
    first
}

fn is_white(file: &[u8]) {
    let (colour, _) = looks(&read(file).unwrap());
    assert!(colour.iter().all(|value| (value - 1.0).abs() < 1e-6), "{colour:?}");
}

#[test]
fn emitted_light_adds_to_the_base_colour() {
    let base = r#""pbrMetallicRoughness":{"baseColorFactor":[0.2,0.4,0.05,1]}"#;
    let strength = |strength: &str| {
        format!(
            r#","extensions":{{"KHR_materials_emissive_strength":{{"emissiveStrength":{strength}}}}}"#
        )
    };
    // Linear light and its sRGB: 0.05 is 0.247801, 0.2 is 0.484529, 0.3 is 0.583831, 0.4 is
    // 0.665185, 0.8 is 0.906332. sRGB 188 is linear 0.502886, 64 is 0.051269, 128 is 0.215861.
    let cases: [(String, [f64; 3]); 9] = [
        (base.to_owned(), [0.484529, 0.665185, 0.247801]),
        (format!(r#"{base},"emissiveFactor":[0.1,0.4,0]"#), [0.583831, 0.906332, 0.247801]),
        // Twice the light; what is above 1 is 1.
        (
            format!(r#"{base},"emissiveFactor":[0.1,0.9,0]{}"#, strength("2")),
            [0.665185, 1.0, 0.247801],
        ),
        (
            format!(r#"{base},"emissiveFactor":[0.1,0.4,0]{}"#, strength("0")),
            [0.484529, 0.665185, 0.247801],
        ),
        // The texture's left half, (0, 188, 64): 0.4 + 0.5 * 0.502886 = 0.651443, 0.05 + 0.051269 =
        // 0.101269.
        (
            format!(r#"{base},"emissiveFactor":[1,0.5,1],"emissiveTexture":{{"index":1}}"#),
            [0.484529, 0.827472, 0.351320],
        ),
        // Its right half, (255, 0, 128): 0.2 + 0.25 = 0.45, 0.05 + 0.215861 = 0.265861.
        (
            format!(
                r#"{base},"emissiveFactor":[0.25,0.5,1],"emissiveTexture":{{"index":1,"texCoord":1}}"#
            ),
            [0.701411, 0.665185, 0.552470],
        ),
        // A texture without a factor emits nothing, since the factor is then 0.
        (
            format!(r#"{base},"emissiveTexture":{{"index":1,"texCoord":7}}"#),
            [0.484529, 0.665185, 0.247801],
        ),
        // Black with light, as lamps are.
        (
            r#""pbrMetallicRoughness":{"baseColorFactor":[0,0,0,1]},"emissiveFactor":[1,0.2,0]"#
                .to_owned(),
            [1.0, 0.484529, 0.0],
        ),
        // Without lighting, the base colour is all of the light.
        (
            format!(
                r#"{base},"emissiveFactor":[1,1,1],"extensions":{{"KHR_materials_unlit":{{}}}}"#
            ),
            [0.484529, 0.665185, 0.247801],
        ),
    ];
    for (material, wanted) in cases {
        let (colour, opacity) = looks(&read(&model(BOTH, &material, "")).unwrap());
        for (found, wanted) in colour.into_iter().zip(wanted) {
            assert!((found - wanted).abs() < 2e-6, "{material}: {colour:?}, not {wanted:?}");
        }
        // 0.97, however much light there is.
        assert!((opacity - 0.97).abs() < 1e-6, "{material}: {opacity}");
    }
}

#[test]
fn each_texture_has_its_own_coordinates_and_alpha_is_that_of_the_base() {
    // Base: the right half of image 0, green and half transparent. Emitted: the left half of image
    // 1.
    let textures = r#""pbrMetallicRoughness":{"baseColorTexture":{"index":0,"texCoord":1}},
        "emissiveFactor":[0.5,0.5,1],"emissiveTexture":{"index":1}"#;
    for (alpha_mode, wanted) in [("OPAQUE", 0.97), ("BLEND", 0.97 * 128.0 / 255.0)] {
        let material = format!(r#"{textures},"alphaMode":"{alpha_mode}""#);
        let ([red, green, blue], opacity) = looks(&read(&model(BOTH, &material, "")).unwrap());
        assert!(red < 1e-6 && (green - 1.0).abs() < 1e-6, "{red}, {green}");
        assert!((blue - 64.0 / 255.0).abs() < 2e-6, "{blue}");
        assert!((opacity - wanted).abs() < 1e-6, "{alpha_mode}: {opacity}");
    }
    let cut = format!(r#"{textures},"alphaMode":"MASK","alphaCutoff":0.6"#);
    assert_eq!(read(&model(BOTH, &cut, "")).unwrap().len(), 0);
}

#[test]
fn extensions_that_are_read_may_be_required() {
    let required = r#","extensionsUsed":["KHR_materials_unlit","KHR_materials_emissive_strength"],
        "extensionsRequired":["KHR_materials_unlit","KHR_materials_emissive_strength"]"#;
    let material = r#""extensions":{"KHR_materials_unlit":{}}"#;
    is_white(&model("", material, required));
}

#[test]
fn a_texture_without_coordinates_is_refused() {
    let base = |info: &str| {
        format!(r#""pbrMetallicRoughness":{{"baseColorTexture":{{"index":0{info}}}}}"#)
    };
    let emissive = r#""emissiveFactor":[1,1,1],"emissiveTexture":{"index":1,"texCoord":1}"#;
    let transform = r#","extensions":{"KHR_texture_transform":{"texCoord":3}}"#;
    for (attributes, material, attribute, texture) in [
        ("", base(""), "TEXCOORD_0", "baseColorTexture"),
        (r#","TEXCOORD_0":1"#, base(r#","texCoord":1"#), "TEXCOORD_1", "baseColorTexture"),
        (BOTH, base(transform), "TEXCOORD_3", "baseColorTexture"),
        (r#","TEXCOORD_0":1"#, emissive.to_owned(), "TEXCOORD_1", "emissiveTexture"),
    ] {
        let said = refusal(&model(attributes, &material, ""));
        let wanted = format!(
            "node 0, mesh 0, primitive 0: has no attribute {attribute}, which the {texture} of its material names"
        );
        assert!(said.contains(&wanted) && said.contains("export the mesh with"), "{said}");
    }
    // A texture that is not read needs none.
    let normal = r#""normalTexture":{"index":1}"#;
    is_white(&model("", normal, ""));
}

#[test]
fn light_that_is_no_light_is_refused() {
    for (factor, strength) in [("[-0.5,0,0]", "1"), ("[1,1,1]", "-2")] {
        let material = format!(
            r#""emissiveFactor":{factor},"extensions":{{"KHR_materials_emissive_strength":{{"emissiveStrength":{strength}}}}}"#
        );
        let said = refusal(&model("", &material, ""));
        assert!(said.contains("emissive") && said.starts_with("glTF"), "{said}");
    }
}
