//! Scenes in the formats of other tools: small writers of every external format except PLY and
//! safetensors.

#![allow(dead_code, reason = "every test binary uses another part of it")]

#[path = "gltf.rs"]
mod gltf_files;

use std::io::Write;

use wildcity_scene::{Gaussians, sh};

use gltf_files::unit;

use crate::scene_files::gaussians;
pub(crate) use gltf_files::{glb, gltf, opacity};

fn byte(value: f64) -> u8 {
    (value * 255.0).round().clamp(0.0, 255.0) as u8
}

fn rgba8(g: &Gaussians, i: usize) -> [u8; 4] {
    let dc = |channel: usize| byte(0.5 + sh::C0 * f64::from(g.sh_at(i)[channel]));
    [dc(0), dc(1), dc(2), byte(opacity(g.logit_opacities[i]))]
}

/// A `.splat` file, the format of antimatter15.
pub(crate) fn splat(g: &Gaussians) -> Vec<u8> {
    let mut file = Vec::new();
    for i in 0..g.len() {
        let scales = g.ln_scales[i].map(f32::exp);
        for value in g.means_m[i].map(|m| m as f32).into_iter().chain(scales) {
            file.extend(value.to_le_bytes());
        }
        file.extend(rgba8(g, i));
        file.extend(unit(g.quats_wxyz[i]).map(|q| (q * 128.0 + 128.0).clamp(0.0, 255.0) as u8));
    }
    file
}

/// The attributes of SPZ, in their order.
fn spz_attributes(g: &Gaussians, version: u32) -> Vec<Vec<u8>> {
    let all = 0..g.len();
    let fixed = |m: f64| ((m * 4096.0).round() as i32).to_le_bytes();
    let positions = g.means_m.as_flattened().iter().flat_map(|&m| fixed(m).into_iter().take(3));
    let wide = |c: f32| byte(f64::from(c) * 0.15 + 0.5);
    let colours = all.clone().flat_map(|i| g.sh_at(i)[..3].to_vec()).map(wide);
    let scales = g.ln_scales.as_flattened().iter();
    let scales = scales.map(|ln| ((ln + 10.0) * 16.0).round().clamp(0.0, 255.0) as u8);
    let rotations = g.quats_wxyz.iter().flat_map(|&q| {
        let [w, x, y, z] = unit(q);
        if version == 2 {
            return [x, y, z].map(|q| (q * w.signum() * 127.5 + 127.5).round() as u8).to_vec();
        }
        let q = [x, y, z, w];
        let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs())).unwrap();
        let mut word = largest as u32;
        for i in (0..4).filter(|&i| i != largest) {
            let negative = q[i] * q[largest].signum() < 0.0;
            let magnitude = (q[i].abs() * 2f64.sqrt() * 511.0).round() as u32;
            word = word << 10 | u32::from(negative) << 9 | magnitude;
        }
        word.to_le_bytes().to_vec()
    });
    let higher = all.flat_map(|i| g.sh_at(i)[3..].to_vec());
    let higher = higher.map(|c| (c * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8);
    let opacities = g.logit_opacities.iter().map(|&logit| byte(opacity(logit)));
    vec![
        positions.collect(),
        opacities.collect(),
        colours.collect(),
        scales.collect(),
        rotations.collect(),
        higher.collect(),
    ]
}

fn spz_header(g: &Gaussians, version: u32, streams: u8) -> Vec<u8> {
    let count = (g.len() as u32).to_le_bytes();
    [&b"NGSP"[..], &version.to_le_bytes(), &count, &[g.sh_degree, 12, 0, streams]].concat()
}

/// An SPZ file (Niantic) of version 2 or 3, without gzip.
pub(crate) fn spz_plain(g: &Gaussians, version: u32) -> Vec<u8> {
    [spz_header(g, version, 0), spz_attributes(g, version).concat()].concat()
}

pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// An SPZ file (Niantic) of version 4, with an unknown extension.
pub(crate) fn spz4(g: &Gaussians) -> Vec<u8> {
    let streams = spz_attributes(g, 4).into_iter().filter(|stream| !stream.is_empty());
    let streams: Vec<_> = streams.collect();
    let packed: Vec<_> = streams.iter().map(|s| zstd::encode_all(&s[..], 1).unwrap()).collect();
    let extension = [7, 0, 0, 0x12, 4, 0, 0, 0, 1, 2, 3, 4];
    let mut file = spz_header(g, 4, streams.len() as u8);
    file.extend((32 + extension.len() as u32).to_le_bytes());
    file.extend([0; 12]);
    file.extend(extension);
    for (packed, plain) in packed.iter().zip(&streams) {
        file.extend((packed.len() as u64).to_le_bytes());
        file.extend((plain.len() as u64).to_le_bytes());
    }
    file.extend(packed.concat());
    file
}

fn half(value: f64) -> [u8; 2] {
    half::f16::from_f64(value).to_le_bytes()
}

/// A `.ksplat` file (mkkellogg) of a compression level: full buckets of 4 Gaussians and one partly
/// filled bucket, with space for one more Gaussian than it has.
pub(crate) fn ksplat(g: &Gaussians, level: u16) -> Vec<u8> {
    const BUCKET: usize = 4;
    let (full, rest) = (g.len() / BUCKET, g.len() % BUCKET);
    let buckets = full + usize::from(rest > 0);
    let mut header = vec![0; 4096];
    header[1] = 1;
    let put = |bytes: &mut Vec<u8>, at: usize, value: u32| {
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    };
    for (at, value) in [(4, 1), (8, 1), (12, g.len() + 1), (16, g.len()), (20, level.into())] {
        put(&mut header, at, value as u32);
    }
    put(&mut header, 36, (-2.0f32).to_bits());
    put(&mut header, 40, 2.0f32.to_bits());
    let mut section = vec![0; 1024];
    let block_m = 256.0f32;
    let values = [
        (0, g.len() as u32),
        (4, g.len() as u32 + 1),
        (8, BUCKET as u32),
        (12, buckets as u32),
        (16, block_m.to_bits()),
        (20, 12),
        (24, 32767),
        (32, full as u32),
        (36, u32::from(rest > 0)),
        (40, g.sh_degree.into()),
    ];
    values.into_iter().for_each(|(at, value)| put(&mut section, at, value));
    let mut body = Vec::new();
    if rest > 0 {
        body.extend((rest as u32).to_le_bytes());
    }
    // Centres that differ: 1 m apart along x.
    for bucket in 0..buckets {
        body.extend([bucket as f32, -1.0, 0.5].map(f32::to_le_bytes).concat());
    }
    let mut record_bytes = 0;
    for i in 0..g.len() {
        let start = body.len();
        let centre_m = [(i / BUCKET) as f64, -1.0, 0.5];
        let scales = g.ln_scales[i].map(|ln| f64::from(ln).exp());
        if level == 0 {
            let mean = g.means_m[i];
            for value in mean.into_iter().chain(scales).chain(unit(g.quats_wxyz[i])) {
                body.extend((value as f32).to_le_bytes());
            }
        } else {
            for (mean, centre) in g.means_m[i].iter().zip(centre_m) {
                let steps = (mean - centre) / (f64::from(block_m) / 2.0);
                body.extend(((steps * 32767.0).round() as i32 + 32767).to_le_bytes()[..2].to_vec());
            }
            body.extend(scales.into_iter().chain(unit(g.quats_wxyz[i])).flat_map(half));
        }
        body.extend(rgba8(g, i));
        for degree in 1..=usize::from(g.sh_degree) {
            for (channel, k) in (0..3).flat_map(|c| (0..2 * degree + 1).map(move |k| (c, k))) {
                let value = f64::from(g.sh_at(i)[3 * (degree * degree + k) + channel]);
                match level {
                    0 => body.extend((value as f32).to_le_bytes()),
                    1 => body.extend(half(value)),
                    _ => body.push(byte((value + 2.0) / 4.0)),
                }
            }
        }
        record_bytes = body.len() - start;
    }
    body.extend(vec![0xee; record_bytes]);
    [header, section, body].concat()
}

/// A lossless WebP image of four bytes per pixel, with this width and the smallest sufficient
/// height.
pub(crate) fn webp(pixels: &[[u8; 4]], width_px: usize) -> Vec<u8> {
    let height_px = pixels.len().div_ceil(width_px).max(1);
    let mut bytes = pixels.as_flattened().to_vec();
    bytes.resize(4 * width_px * height_px, 0);
    let mut file = Vec::new();
    let encoder = image_webp::WebPEncoder::new(&mut file);
    let color = image_webp::ColorType::Rgba8;
    encoder.encode(&bytes, width_px as u32, height_px as u32, color).unwrap();
    file
}

/// The files of a folder; the first one refers to the others.
pub(crate) type Files = Vec<(String, Vec<u8>)>;

/// PlayCanvas' SOG: the colours of higher degrees of every Gaussian are a separate entry, so that
/// there are at most 65,536 Gaussians. Version 1 has ranges, version 2 codebooks of evenly spaced
/// values.
pub(crate) fn sog(g: &Gaussians, version: u32) -> Files {
    let logarithm = |m: f64| m.signum() * m.abs().ln_1p();
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (least, most) = values.fold((0.0, 0.0), |(a, b): (f64, f64), x| (a.min(x), b.max(x)));
        [least - 1e-6, most + 1e-6]
    };
    let place = |[least, most]: [f64; 2], x: f64| byte((x - least) / (most - least));
    let means: [_; 3] =
        std::array::from_fn(|axis| range(&mut g.means_m.iter().map(|m| logarithm(m[axis]))));
    let scales = range(&mut g.ln_scales.as_flattened().iter().map(|&ln| ln.into()));
    let colours = range(&mut (0..g.len()).flat_map(|i| g.sh_at(i)[..3].to_vec()).map(f64::from));
    let logits = range(&mut g.logit_opacities.iter().map(|&logit| logit.into()));
    let higher = range(&mut g.sh.iter().map(|&c| c.into()));

    let position = |i: usize, axis: usize| {
        let [least, most] = means[axis];
        ((logarithm(g.means_m[i][axis]) - least) / (most - least) * 65535.0).round() as u16
    };
    let pixels = |of: &dyn Fn(usize) -> [u8; 4]| -> Vec<u8> {
        let pixels: Vec<_> = (0..g.len()).map(of).collect();
        webp(&pixels, 4)
    };
    let bytes = |of: usize| {
        move |i: usize| {
            let at = |axis: usize| position(i, axis).to_le_bytes()[of];
            [at(0), at(1), at(2), 255]
        }
    };
    let quat = |i: usize| {
        let q = unit(g.quats_wxyz[i]);
        let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs())).unwrap();
        let others = (0..4).filter(|&k| k != largest);
        let others: Vec<u8> =
            others.map(|k| byte(q[k] * q[largest].signum() / 2f64.sqrt() + 0.5)).collect();
        [others[0], others[1], others[2], 252 + largest as u8]
    };
    let scale = |i: usize| {
        let [x, y, z] = g.ln_scales[i].map(|ln| place(scales, ln.into()));
        [x, y, z, 255]
    };
    let colour = |i: usize| {
        let dc = |channel: usize| place(colours, g.sh_at(i)[channel].into());
        let logit = g.logit_opacities[i];
        let alpha = if version == 1 { place(logits, logit.into()) } else { byte(opacity(logit)) };
        [dc(0), dc(1), dc(2), alpha]
    };
    let label = |i: usize| {
        let [low, high] = (i as u16).to_le_bytes();
        [low, high, 0, 255]
    };
    let entries = sh::coefficients(g.sh_degree) - 1;
    let centroids: Vec<[u8; 4]> =
        g.sh.chunks_exact(3 * (entries + 1))
            .flat_map(|colour| colour[3..].as_chunks::<3>().0)
            .map(|rgb| {
                let [r, g, b] = rgb.map(|c| place(higher, c.into()));
                [r, g, b, 255]
            })
            .collect();

    let spread = |[least, most]: [f64; 2]| {
        let values = (0..256).map(|k| least + (most - least) * f64::from(k) / 255.0);
        let values: Vec<f64> = values.collect();
        format!(r#""codebook":{values:?}"#)
    };
    let ends = |ranges: &[[f64; 2]]| {
        let side = |end: usize| ranges.iter().map(|range| range[end]).collect::<Vec<_>>();
        format!(r#""mins":{:?},"maxs":{:?}"#, side(0), side(1))
    };
    let (head, scale_values, colour_values, higher_values) = if version == 1 {
        let [least, most] = higher;
        (
            String::new(),
            ends(&[scales; 3]),
            ends(&[colours, colours, colours, logits]),
            format!(r#""mins":{least},"maxs":{most}"#),
        )
    } else {
        let bands = format!(r#""count":{},"bands":{},{}"#, g.len(), g.sh_degree, spread(higher));
        (format!(r#""version":2,"count":{},"#, g.len()), spread(scales), spread(colours), bands)
    };
    let higher_json = match entries {
        0 => String::new(),
        _ => format!(r#","shN":{{{higher_values},"files":["centroids.webp","labels.webp"]}}"#),
    };
    let meta = format!(
        r#"{{{head}"means":{{"shape":[{},3],{},"files":["means_l.webp","means_u.webp"]}},
        "scales":{{{scale_values},"files":["scales.webp"]}},"quats":{{"files":["quats.webp"]}},
        "sh0":{{{colour_values},"files":["sh0.webp"]}}{higher_json}}}"#,
        g.len(),
        ends(&means)
    );
    let mut files = vec![
        ("meta.json".to_owned(), meta.into_bytes()),
        ("means_l.webp".to_owned(), pixels(&bytes(0))),
        ("means_u.webp".to_owned(), pixels(&bytes(1))),
        ("scales.webp".to_owned(), pixels(&scale)),
        ("quats.webp".to_owned(), pixels(&quat)),
        ("sh0.webp".to_owned(), pixels(&colour)),
    ];
    if entries > 0 {
        files.push(("centroids.webp".to_owned(), webp(&centroids, 64 * entries)));
        files.push(("labels.webp".to_owned(), pixels(&label)));
    }
    files
}

/// A zip archive of files, packed or not.
pub(crate) fn zip(files: &[(String, Vec<u8>)], is_packed: bool) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let method =
        if is_packed { zip::CompressionMethod::Deflated } else { zip::CompressionMethod::Stored };
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in files {
        zip.start_file(name.as_str(), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// The MessagePack within a NuRec payload; `with_cars` adds a layer of tracked cars.
pub(crate) fn nurec_plain(g: &Gaussians, with_cars: bool) -> Vec<u8> {
    let text = |s: &str| [&[0xd9, s.len() as u8], s.as_bytes()].concat();
    let bytes = |b: Vec<u8>| [&[0xc6][..], &(b.len() as u32).to_be_bytes(), &b].concat();
    let count = |n: usize| [&[0xce][..], &(n as u32).to_be_bytes()].concat();
    let map = |entries: Vec<(&str, Vec<u8>)>| {
        let mut out = [&[0xde][..], &(entries.len() as u16).to_be_bytes()].concat();
        entries.into_iter().for_each(|(key, value)| out.extend([text(key), value].concat()));
        out
    };
    let halves = |values: &mut dyn Iterator<Item = f64>| values.flat_map(half).collect::<Vec<u8>>();
    let layer = |name: &str| {
        let higher = 3 * (sh::coefficients(g.sh_degree) - 1);
        let colour = |from: usize, to: usize| {
            let values = (0..g.len()).flat_map(move |i| g.sh_at(i)[from..to].to_vec());
            halves(&mut values.map(f64::from))
        };
        // Scales as f32, the rest as f16.
        let scales = g.ln_scales.as_flattened().iter().flat_map(|ln| ln.to_le_bytes()).collect();
        let arrays = [
            ("positions", 3, halves(&mut g.means_m.as_flattened().iter().copied())),
            ("rotations", 4, halves(&mut g.quats_wxyz.as_flattened().iter().map(|&q| q.into()))),
            ("scales", 3, scales),
            ("densities", 1, halves(&mut g.logit_opacities.iter().map(|&l| l.into()))),
            ("features_albedo", 3, colour(0, 3)),
            ("features_specular", higher, colour(3, 3 + higher)),
        ];
        let degree = bytes(i64::from(g.sh_degree).to_le_bytes().to_vec());
        let mut entries = vec![(format!(".gaussians_nodes.{name}.n_active_features"), degree)];
        for (field, columns, values) in arrays {
            let key = format!(".gaussians_nodes.{name}.{field}");
            let shape = [vec![0x92], count(g.len()), count(columns)].concat();
            entries.push((format!("{key}.shape"), shape));
            entries.push((key, bytes(values)));
        }
        entries
    };
    let tracks = map(vec![
        ("street", vec![0x90]),
        ("cars", [vec![0x92], text("car 7"), text("car 9")].concat()),
    ]);
    let mut state = layer("street");
    if with_cars {
        state.extend(layer("cars"));
        // Every other Gaussian is of the second track.
        let ids = (0..g.len()).flat_map(|i| (i as i32 % 2).to_le_bytes()).collect();
        state.push((".gaussians_nodes.cars.gaussian_cuboid_ids".to_owned(), bytes(ids)));
    }
    state.push(("._extra_state".to_owned(), map(vec![("obj_track_ids", tracks)])));
    let state = state.iter().map(|(key, value)| (key.as_str(), value.clone())).collect();
    let settings = map(vec![("density_activation", text("sigmoid")), ("precision", vec![16])]);
    let clip = [&[0xcb][..], &0.2f64.to_be_bytes()].concat();
    let renderer = map(vec![("near_clip_distance", clip)]);
    let config = map(vec![("layers", map(vec![("street", settings)])), ("renderer", renderer)]);
    let data =
        map(vec![("version", text("0.2.576")), ("config", config), ("state_dict", map(state))]);
    map(vec![("nre_data", data)])
}

/// A USDZ file with a payload.
pub(crate) fn usdz(payload: Vec<u8>) -> Vec<u8> {
    let layer = b"#usda 1.0\n".to_vec();
    let files = [("default.usda".to_owned(), layer), ("scene.nurec".to_owned(), gzip(&payload))];
    zip(&files, false)
}

/// Two blocks with two levels: 50 Gaussians, of which the finest level has 20 + 20; and an
/// environment.
pub(crate) fn streamed() -> Files {
    let place = |file: usize, offset: usize, count: usize| {
        format!(r#"{{"file":{file},"offset":{offset},"count":{count}}}"#)
    };
    let leaf = |fine: String, coarse: String| format!(r#"{{"lods":{{"1":{coarse},"0":{fine}}}}}"#);
    let tree = format!(
        r#"{{"children":[{},{}]}}"#,
        leaf(place(1, 20, 20), place(0, 5, 5)),
        leaf(place(1, 0, 20), place(0, 0, 5))
    );
    let json = format!(
        r#"{{"lodLevels":2,"filenames":["coarse/meta.json","0/meta.json"],
        "environment":"sky/meta.json","tree":{tree}}}"#
    );
    let mut files = vec![("lod-meta.json".to_owned(), json.into_bytes())];
    for (folder, count, sh_degree) in [("0", 45, 2), ("sky", 10, 0), ("coarse", 10, 2)] {
        let part = sog(&gaussians(count, sh_degree, 20.0, 7), 2).into_iter();
        files.extend(part.map(|(name, bytes)| (format!("{folder}/{name}"), bytes)));
    }
    files
}
