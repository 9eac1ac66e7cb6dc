//! Skies from other programs: networks and images, valid and invalid.

use std::path::Path;

use glam::DVec3;
use image::{ImageFormat, Rgb, RgbImage};
use wildcity_scene::sky::{CubeMap, Network, SkyModel};
use wildcity_twin::ingest::sky::{self, decode};

use crate::scene_files::{Tensor, safetensors};

/// A network of 8 wide layers, 2 octaves and the appearances of 3 images.
fn tensors() -> Vec<Tensor> {
    let inputs = 3 + 12 + 4;
    let tensor = |name: &'static str, shape: &[usize]| {
        let count: usize = shape.iter().product();
        let values = (0..count).map(|i| 0.25 * ((i * 7 % 11) as f64 - 5.0) / 5.0).collect();
        (name, shape.to_vec(), values)
    };
    vec![
        tensor("sky_head.layers.0.weight", &[8, inputs]),
        tensor("sky_head.layers.0.bias", &[8]),
        tensor("sky_head.layers.1.weight", &[8, 8 + inputs]),
        tensor("sky_head.layers.1.bias", &[8]),
        tensor("sky_head.layers.2.weight", &[3, 8]),
        tensor("sky_head.layers.2.bias", &[3]),
        tensor("appearance_embedding.weight", &[3, 4]),
        tensor("background.means", &[5, 3]),
    ]
}

fn read(bytes: &[u8], image: Option<u32>) -> Result<sky::SkyFile, String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("sky");
    std::fs::write(&path, bytes).unwrap();
    sky::read(&path, image).map_err(|error| error.to_string())
}

fn network(model: &SkyModel) -> &Network {
    match model {
        SkyModel::Network(network, _) => network,
        SkyModel::Cube(_) => panic!("it is no network"),
    }
}

fn map(model: &SkyModel) -> &CubeMap {
    match model {
        SkyModel::Cube(map) => map,
        SkyModel::Network(..) => panic!("it is no image"),
    }
}

#[test]
fn sizes_follow_from_the_shapes() {
    let file = read(&safetensors(&tensors(), &[]), None).unwrap();
    let mean = network(&file.model);
    assert_eq!((mean.octaves(), mean.identity(), mean.skip()), (2, true, true));
    let rows = &tensors()[6].2;
    for k in 0..4 {
        let wanted = (rows[k] + rows[4 + k] + rows[8 + k]) / 3.0;
        assert!((f64::from(mean.appearance()[k]) - wanted).abs() < 1e-7);
    }
    let second = read(&safetensors(&tensors(), &[]), Some(1)).unwrap();
    assert_eq!(network(&second.model).appearance()[2], rows[6] as f32);
    // Only the sky's tensors are stored, and they decode to the same sky.
    assert!(file.bytes.len() < safetensors(&tensors(), &[]).len());
    assert_eq!(network(&decode(&file.bytes, Some(1)).unwrap()), network(&second.model));
    assert_eq!(read(&file.bytes, None).unwrap().bytes, file.bytes);
}

#[test]
fn invalid_networks_are_refused_by_name() {
    type Slip = fn(&mut Vec<Tensor>);
    let slips: [(Slip, &str); 8] = [
        (|t| drop(t.remove(3)), "tensor sky_head.layers.1.bias: is missing"),
        (|t| t[0].2[9] = f64::NAN, "sky_head.layers.0.weight holds NaN at 9"),
        (|t| t[4].2[0] = 1e7, "weights are finite and within 1e6"),
        (|t| t[6].1 = vec![4, 3], "tensor sky_head.layers.0.weight has shape [8, 19]; its inputs"),
        (|t| t[5].1 = vec![1, 3], "tensor sky_head.layers.2.bias: has shape [1, 3], not 1 dim"),
        (
            |t| (t[4].1, t[4].2) = (vec![4, 8], vec![0.0; 32]),
            "tensor sky_head.layers.2.weight has shape [4, 8]; it must be [3, 8]",
        ),
        (
            |t| (t[2].1, t[2].2) = (vec![8, 9], vec![0.0; 72]),
            "tensor sky_head.layers.1.weight has shape [8, 9]; it must be [8, 27]",
        ),
        (
            |t| (t[3].1, t[3].2) = (vec![7], vec![0.0; 7]),
            "tensor sky_head.layers.1.bias has shape [8]; it holds 7 values",
        ),
    ];
    for (slip, wanted) in slips {
        let mut wrong = tensors();
        slip(&mut wrong);
        let said = read(&safetensors(&wrong, &[]), None).unwrap_err();
        assert!(said.contains(wanted), "{said:?}, not {wanted:?}");
    }
    let said = read(&safetensors(&tensors(), &[]), Some(3)).unwrap_err();
    assert!(said.contains("appearances of 3 images, from 0; there is no image 3"), "{said}");
    for bytes in [&b""[..], b"not a sky", &[0xFF; 100], b"\x10\0\0\0\0\0\0\0{\"a\":1}         "] {
        assert!(read(bytes, None).unwrap_err().contains("sky header"));
    }
}

/// A colour for every direction: x, y and z as red, green and blue.
fn truth(away: DVec3) -> [u8; 3] {
    (away.normalize() * 127.0 + 128.0).to_array().map(|c| c.round() as u8)
}

fn face(face: usize, side: u32) -> RgbImage {
    let at = |k: u32| (f64::from(k) + 0.5) / f64::from(side);
    RgbImage::from_fn(side, side, |x, y| Rgb(truth(CubeMap::direction(face, [at(x), at(y)]))))
}

fn png(image: &RgbImage) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// The largest error of a map, in steps of 8 bits.
fn off(map: &CubeMap) -> f64 {
    let mut worst: f64 = 0.0;
    for face in 0..6 {
        for k in 0..400 {
            let at = |k: usize| (k as f64 + 0.37) / 20.0;
            let away = CubeMap::direction(face, [at(k % 20), at(k / 20)]);
            let wanted = DVec3::from_array(truth(away).map(f64::from));
            worst = worst.max((255.0 * map.rgb(away) - wanted).abs().max_element());
        }
    }
    worst
}

#[test]
fn images_of_every_layout_are_the_same_sky() {
    let side = 32;
    // Columns and rows of faces, and the position of each.
    let cross = [[2, 1], [0, 1], [1, 0], [1, 2], [1, 1], [3, 1]];
    let row = [0, 1, 2, 3, 4, 5].map(|k| [k, 0]);
    let column = [0, 1, 2, 3, 4, 5].map(|k| [0, k]);
    for (size, places) in [([4, 3], cross), ([6, 1], row), ([1, 6], column)] {
        let mut whole = RgbImage::new(size[0] * side, size[1] * side);
        for (k, [x, y]) in places.into_iter().enumerate() {
            image::imageops::replace(
                &mut whole,
                &face(k, side),
                i64::from(x * side),
                i64::from(y * side),
            );
        }
        let file = read(&png(&whole), None).unwrap();
        assert!(off(map(&file.model)) < 3.0, "{size:?}: {}", off(map(&file.model)));
        // What is stored decodes to the same sky.
        assert_eq!(map(&decode(&file.bytes, None).unwrap()), map(&file.model));
    }
    // In an upright cross, -z is below the bottom face, and upside down.
    let mut upright = RgbImage::new(3 * side, 4 * side);
    for (k, [x, y]) in [[2, 1], [0, 1], [1, 0], [1, 2], [1, 1], [1, 3]].into_iter().enumerate() {
        let face = if k == 5 { image::imageops::rotate180(&face(k, side)) } else { face(k, side) };
        image::imageops::replace(&mut upright, &face, x * i64::from(side), y * i64::from(side));
    }
    assert!(off(map(&read(&png(&upright), None).unwrap().model)) < 3.0);
    // A panorama: from the left, -z, -x, +z, +x and -z again.
    let panorama = RgbImage::from_fn(256, 128, |x, y| {
        let azimuth = (f64::from(x) + 0.5) / 256.0 * std::f64::consts::TAU - std::f64::consts::PI;
        let (rise, run) = (std::f64::consts::PI * (0.5 - (f64::from(y) + 0.5) / 128.0)).sin_cos();
        Rgb(truth(DVec3::new(run * azimuth.sin(), rise, run * azimuth.cos())))
    });
    assert!(off(map(&read(&png(&panorama), None).unwrap().model)) < 3.0);
}

#[test]
fn six_images_of_a_folder() {
    let dir = tempfile::tempdir().unwrap();
    let names = ["px", "nx", "py", "ny", "pz", "nz"];
    let write = |k: usize, side: u32| {
        let path = dir.path().join(format!("{}.png", names[k]));
        std::fs::write(path, png(&face(k, side))).unwrap();
    };
    (0..5).for_each(|k| write(k, 32));
    let said = |dir: &Path| sky::read(dir, None).unwrap_err().to_string();
    assert!(said(dir.path()).contains("there is no nz.png or nz.jpg"), "{}", said(dir.path()));
    write(5, 31);
    assert!(
        said(dir.path()).contains("nz: is 31 x 31 pixels, not 32 x 32"),
        "{}",
        said(dir.path())
    );
    write(5, 32);
    assert!(off(map(&sky::read(dir.path(), None).unwrap().model)) < 3.0);
}

#[test]
fn invalid_images_are_refused() {
    let said = read(&png(&RgbImage::new(50, 40)), None).unwrap_err();
    assert!(said.contains("50 x 40 pixels are not a panorama"), "{said}");
    let side = CubeMap::MAX_SIDE_PX as u32 + 1;
    let said = read(&png(&RgbImage::new(side, 6 * side)), None).unwrap_err();
    assert!(said.contains("1537 pixels wide; 1 to 1536"), "{said}");
    let said = read(&png(&RgbImage::new(4828, 2414)), None).unwrap_err();
    assert!(said.contains("1537 pixels wide"), "{said}");
    let mut cut = png(&RgbImage::new(16, 8));
    cut.truncate(40);
    assert!(read(&cut, None).unwrap_err().contains("sky header, image"));
    let said = read(&png(&RgbImage::new(16, 8)), Some(0)).unwrap_err();
    assert!(said.contains("appearances of 0 images"), "{said}");
}
