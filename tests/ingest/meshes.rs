//! Ordinary meshes become flat Gaussians.

use glam::DVec3;
use wildcity_scene::{Gaussians, sh};
use wildcity_twin::ingest;

use crate::format_files::glb;
use crate::{data, read, refusal};

/// A square of 2 m at z = 1 with red and green at the left corners and blue at the right ones, of
/// two triangles with indices; `primitive` and `more` are JSON within the primitive and the
/// document.
pub(crate) fn square(primitive: &str, more: &str) -> Vec<u8> {
    let positions: [[f32; 3]; 4] =
        [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]];
    let colors: [[f32; 3]; 4] =
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]];
    let floats = positions.as_flattened().iter().chain(colors.as_flattened());
    let mut buffer: Vec<u8> = floats.flat_map(|value| value.to_le_bytes()).collect();
    buffer.extend([0, 1, 2, 0, 2, 3_u8]);
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0,"scale":[1,1,2]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"COLOR_0":1}},"indices":2{primitive}}}]}}],
        "accessors":[
        {{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[-1,-1,1],"max":[1,1,1]}},
        {{"bufferView":1,"componentType":5126,"count":4,"type":"VEC3"}},
        {{"bufferView":2,"componentType":5121,"count":6,"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":48}},
        {{"buffer":0,"byteOffset":96,"byteLength":6}}],
        "buffers":[{{"byteLength":102}}]{more}}}"#
    );
    glb((json, buffer))
}

fn colour(g: &Gaussians, index: usize) -> [f64; 3] {
    [0, 1, 2].map(|c| 0.5 + sh::C0 * f64::from(g.sh_at(index)[c]))
}

#[test]
fn a_square_is_covered_evenly_where_its_node_puts_it() {
    let g = read(&square("", "")).unwrap();
    assert!((200_000..202_000).contains(&g.len()), "{}", g.len());
    let mut centre_m = DVec3::ZERO;
    for (index, mean_m) in g.means_m.iter().enumerate() {
        assert_eq!(mean_m[2], 2.0);
        centre_m += DVec3::from_array(*mean_m) / g.len() as f64;
        // Blue rises to the right, and light rises faster than linear when it is displayed.
        let [red, green, blue] = colour(&g, index);
        let linear = 0.5 * (mean_m[0] + 1.0);
        assert!((blue.powf(2.2) - linear).abs() < 0.02, "{blue} at {mean_m:?}");
        assert!(if mean_m[0] > mean_m[1] { green < 1e-3 } else { red <= green.max(red) });
        // Flat, facing along z: a third of the way between neighbours 6.3 mm apart, and thin.
        let scales_m = g.ln_scales[index].map(|ln| f64::from(ln).exp());
        assert!(scales_m[..2].iter().all(|s| (1e-3..5e-3).contains(s)), "{scales_m:?}");
        assert!(scales_m[2] < 1e-4);
    }
    assert!(centre_m.distance(DVec3::new(0.0, 0.0, 2.0)) < 1e-6, "{centre_m}");
}

#[test]
fn vehicles_have_their_size_and_their_colours() {
    let Some(path) = data::real("vehicles/CesiumMilkTruck.glb") else { return };
    let truck = ingest::read(&path, &mut |_, _| {}).unwrap();
    let bound = |axis: usize| {
        let along = || truck.means_m.iter().map(|m| m[axis]);
        along().fold(f64::NEG_INFINITY, f64::max) - along().fold(f64::INFINITY, f64::min)
    };
    // In glTF, y is up. The data's README says 4.9 x 3.0 x 2.8 m.
    let size_m = [bound(2), bound(0), bound(1)];
    assert!((190_000..300_000).contains(&truck.len()), "{}", truck.len());
    let mut sides_m = size_m;
    sides_m.sort_by(f64::total_cmp);
    for (found_m, wanted_m) in sides_m.into_iter().zip([2.8, 3.0, 4.9]) {
        assert!((found_m - wanted_m).abs() < 0.25, "{size_m:?}");
    }
    let share = |is: &dyn Fn([f64; 3]) -> bool| {
        (0..truck.len()).filter(|&i| is(colour(&truck, i))).count() as f64 / truck.len() as f64
    };
    let white = share(&|rgb| rgb.iter().all(|&c| c > 0.9));
    let tyres = share(&|rgb| rgb.iter().all(|&c| c < 0.3));
    let logo = share(&|[red, _, blue]| blue > red + 0.3);
    assert!(white > 0.25 && tyres > 0.05 && logo > 0.01, "{white} {tyres} {logo}");
}

/// A triangle in the colours of a 2 x 1 image, red and green, with texture coordinates that all lie
/// in its red half.
fn textured(info: &str) -> Vec<u8> {
    let positions: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let uv: [[f32; 2]; 3] = [[0.1, 0.2], [0.4, 0.2], [0.1, 0.8]];
    let floats = positions.as_flattened().iter().chain(uv.as_flattened());
    let mut buffer: Vec<u8> = floats.flat_map(|value| value.to_le_bytes()).collect();
    let image = image::RgbImage::from_raw(2, 1, vec![255, 0, 0, 0, 255, 0]).unwrap();
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, image::ImageFormat::Png).unwrap();
    let png = png.into_inner();
    buffer.extend(&png);
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}},"material":0}}]}}],
        "materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0{info}}}}}}}],
        "textures":[{{"source":0}}],"images":[{{"bufferView":2,"mimeType":"image/png"}}],
        "accessors":[
        {{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
        {{"bufferView":1,"componentType":5126,"count":3,"type":"VEC2"}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":24}},
        {{"buffer":0,"byteOffset":60,"byteLength":{}}}],
        "buffers":[{{"byteLength":{}}}]}}"#,
        png.len(),
        buffer.len()
    );
    glb((json, buffer))
}

#[test]
fn a_texture_may_show_a_part_of_its_image() {
    let green = |info: &str| {
        let g = read(&textured(info)).unwrap();
        let [red, green, _] = colour(&g, g.len() / 2);
        assert!((red - green).abs() > 0.9, "{info}: {red}, {green}");
        green > red
    };
    let transform =
        |fields: &str| format!(r#","extensions":{{"KHR_texture_transform":{{{fields}}}}}"#);
    assert!(!green(""));
    assert!(!green(&transform(r#""texCoord":0"#)));
    assert!(green(&transform(r#""offset":[0.5,0]"#)));
    assert!(green(&transform(r#""offset":[1,0],"scale":[-1,1]"#)));
    let rotated = refusal(&textured(&transform(r#""rotation":1.5"#)));
    assert!(rotated.contains("KHR_texture_transform rotates"), "{rotated}");
}

#[test]
fn errors_of_meshes_name_the_cause() {
    let replaced = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let mut file = square("", "");
        let at = file.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
        file[at..at + to.len()].copy_from_slice(to.as_bytes());
        refusal(&file)
    };
    for (said, wanted) in [
        (refusal(&square(r#","mode":5"#, "")), "only lists of triangles are read"),
        (replaced(r#""count":6"#, r#""count":7"#), "7 rows of accessor 2 do not fit"),
        (replaced(r#""byteLength":6}"#, r#""byteLength":9}"#), "do not fit its bufferView"),
        (
            replaced(r#""componentType":5121"#, r#""componentType":5126"#),
            "of [U8, U16, U32] are read",
        ),
        (replaced(r#""indices":2"#, r#""indices":9"#), "JSON"),
        (refusal(&square("", r#","extensionsRequired":["KHR_draco_mesh_compression"]"#)), "JSON"),
    ] {
        assert!(said.contains(wanted) && said.starts_with("glTF"), "{said}");
    }
    // An index beyond the corners, and corners without positions.
    let with = |from_end: usize, bytes: &[u8]| {
        let mut file = square("", "");
        let at = file.len() - from_end;
        file[at..at + bytes.len()].copy_from_slice(bytes);
        refusal(&file)
    };
    // Two bytes pad 102 to 104.
    assert!(with(3, &[4]).contains("a corner of [0, 2, 4] does not exist"));
    let nowhere = with(104, &f32::NAN.to_le_bytes().repeat(12));
    assert!(nowhere.contains("neither splats nor triangles with an area"), "{nowhere}");
}

/// Many slivers without area, and as long as possible, beside a square. None of them becomes a
/// Gaussian.
#[test]
fn slivers_take_no_memory() {
    let mut sliver = square("", "");
    let json_end = sliver.windows(4).position(|part| part == b"BIN\0").unwrap() - 4;
    let mut json = String::from_utf8(sliver[20..json_end].to_vec()).unwrap();
    let count = 100_000;
    let mut buffer = sliver.split_off(json_end + 8);
    buffer.truncate(102);
    buffer.extend([0, 1, 1].repeat(count));
    json = json.replace(r#""count":6"#, &format!(r#""count":{}"#, 6 + 3 * count));
    json = json.replace(r#""byteLength":6}"#, &format!(r#""byteLength":{}}}"#, 6 + 3 * count));
    json = json.replace(r#""byteLength":102"#, &format!(r#""byteLength":{}"#, 102 + 3 * count));
    let g = read(&glb((json, buffer))).unwrap();
    assert!((200_000..202_000).contains(&g.len()), "{}", g.len());
    assert!(peak_bytes() < 1 << 30, "{} B", peak_bytes());
}

/// The peak memory of this process.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    1024 * line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
}

#[test]
fn damaged_meshes_never_panic() {
    let whole = square("", "");
    for end in (0..whole.len()).step_by(7) {
        refusal(&whole[..end]);
    }
    // Every digit of the part of the document that has numbers.
    let first = whole.windows(9).position(|part| part == b"accessors").unwrap();
    for at in (first..whole.len() - 104).filter(|&at| whole[at].is_ascii_digit()) {
        for digit in [b'0', b'9'] {
            let mut damaged = whole.clone();
            damaged[at] = digit;
            if let Ok(g) = read(&damaged) {
                assert!(g.len() < 410_000, "{}", g.len());
            }
        }
    }
}
