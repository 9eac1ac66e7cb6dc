//! Scenes written by small writers of every format are read back, within the precision of the
//! format.

use std::collections::BTreeSet;

use safetensors::Dtype;
use safetensors::tensor::TensorView;
use wildcity_scene::Gaussians;
use wildcity_twin::ingest::{self, ListedFiles, ReadLimits, SogFiles, StopFlag};

use crate::format_files::{
    Files, glb, gltf, gzip, ksplat, nurec_plain, opacity, sog, splat, spz_plain, spz4, streamed,
    usdz, zip,
};
use crate::scene_files::gaussians;
use crate::{read, refusal};

/// Tolerances.
#[derive(Clone, Copy)]
struct Within {
    mean_m: f64,
    quat: f64,
    ln_scale: f64,
    opacity: f64,
    dc: f64,
    sh: f64,
}

const EXACT: Within =
    Within { mean_m: 1e-6, quat: 1e-6, ln_scale: 1e-5, opacity: 1e-6, dc: 1e-6, sh: 1e-6 };

fn assert_alike(read: &Gaussians, written: &Gaussians, within: Within, name: &str) {
    assert_eq!((read.len(), read.sh_degree), (written.len(), written.sh_degree), "{name}");
    let near = |a: &[f32], b: &[f32], by: f64, field: &str| {
        for (a, b) in a.iter().zip(b) {
            assert!(f64::from((a - b).abs()) <= by, "{name}: {field} is {a}, not {b}");
        }
    };
    for i in 0..read.len() {
        for axis in 0..3 {
            let a = read.means_m[i][axis];
            let b = written.means_m[i][axis];
            assert!((a - b).abs() <= within.mean_m, "{name}: position is {a}, not {b}");
        }
        let unit = |q: [f32; 4]| {
            let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
            q.map(|q| q / length)
        };
        let p = unit(read.quats_wxyz[i]);
        let q = unit(written.quats_wxyz[i]);
        let same_side = p.iter().zip(q).map(|(p, q)| p * q).sum::<f32>() > 0.0;
        near(&p, &q.map(|q| if same_side { q } else { -q }), within.quat, "rotation");
        near(&read.ln_scales[i], &written.ln_scales[i], within.ln_scale, "ln scale");
        let opacities = [read, written].map(|g| opacity(g.logit_opacities[i]) as f32);
        near(&opacities[..1], &opacities[1..], within.opacity, "opacity");
        near(&read.sh_at(i)[..3], &written.sh_at(i)[..3], within.dc, "colour");
        near(&read.sh_at(i)[3..], &written.sh_at(i)[3..], within.sh, "colour coefficient");
    }
}

fn written(files: &Files) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    dir
}

/// Reads a scene of several files. Also returns its hash.
fn read_files(files: &Files) -> Result<(Gaussians, String), ingest::IngestError> {
    ingest::read_hashed(&written(files).path().join(&files[0].0), &mut |_, _| {})
}

/// The files that a description of a SOG names, and those that these name.
fn named_files(files: &Files, description: &str) -> BTreeSet<String> {
    let (_, json) = files.iter().find(|(name, _)| name == description).unwrap();
    let SogFiles { descriptions, images } = SogFiles::from_json(json, description).unwrap();
    let beside = description.rfind('/').map_or("", |slash| &description[..=slash]);
    let path = |name: &String| format!("{beside}{name}");
    let others = descriptions.iter().flat_map(|name| named_files(files, &path(name)));
    let own = descriptions.iter().chain(&images).map(path);
    own.chain(others).collect()
}

#[test]
fn splat_comes_back() {
    let g = gaussians(50, 0, 20.0, 1);
    // A step of colour is 1/255 of 1/0.282; rotations are truncated.
    let within = Within { quat: 0.02, opacity: 0.002, dc: 0.007, ..EXACT };
    assert_alike(&read(&splat(&g)).unwrap(), &g, within, ".splat");
}

/// A file without a magic number begins with numbers, which may have the bytes that other formats
/// begin with.
#[test]
fn a_splat_may_begin_as_other_formats_do() {
    let within = Within { quat: 0.02, opacity: 0.002, dc: 0.007, ..EXACT };
    // Of JSON, with and without white space; of gzip; of safetensors, in the third number.
    let starts = [*b"{a", *b"{\"", *b"{}", *b"{\n", *b" {", *b"\t{", *b"{{", [0x1f, 0x8b]];
    let any = (0..=u8::MAX).map(|byte| [byte, 0x80]);
    for start in starts.into_iter().chain(any) {
        for axis in [0, 2] {
            let mut g = gaussians(50, 0, 20.0, 1);
            let bits = (g.means_m[0][axis] as f32).to_bits() & 0xFFFF_0000;
            let bits = bits | u32::from(u16::from_le_bytes(start));
            g.means_m[0][axis] = f32::from_bits(bits).into();
            let file = splat(&g);
            assert_eq!(file[4 * axis..][..2], start);
            let read = read(&file).unwrap_or_else(|error| panic!("{start:?}, {axis}: {error}"));
            assert_alike(&read, &g, within, ".splat");
        }
    }
}

/// What is read of a file's start does not depend on white space, nor on how long a header is.
#[test]
fn json_is_found_by_what_it_is() {
    for text in ["{}", " \n{ }", "{\"asset\": {\"version\": \"1.0\"}}", "{", "{\"\u{e9}\": 1}"] {
        let refused = refusal(text.as_bytes()).to_string();
        assert!(refused.starts_with("SOG") || refused.starts_with("glTF"), "{text:?}: {refused}");
    }
    for text in ["{\u{1}\"a\": 1}", "{a: 1}", "{[1]}"] {
        let refused = refusal(text.as_bytes()).to_string();
        assert!(refused.contains("none of the formats"), "{text:?}: {refused}");
    }
}

#[test]
fn spz_comes_back() {
    for sh_degree in 0..=3 {
        let g = gaussians(50, sh_degree, 20.0, 2);
        let within = Within {
            mean_m: 0.5 / 4096.0,
            quat: 0.003,
            ln_scale: 0.51 / 16.0,
            opacity: 0.002,
            dc: 0.0131,
            sh: 0.0079,
        };
        // w follows from x, y, z and length 1: where it is nearly 0, it is off by √(2 √3
        // 0.5/127.5).
        let two = Within { quat: 0.118, ..within };
        for (name, file, within) in [
            ("2", gzip(&spz_plain(&g, 2)), two),
            ("plain 2", spz_plain(&g, 2), two),
            ("3", gzip(&spz_plain(&g, 3)), within),
            ("plain 3", spz_plain(&g, 3), within),
            ("4", spz4(&g), within),
        ] {
            assert_alike(&read(&file).unwrap(), &g, within, &format!("SPZ {name}, {sh_degree}"));
        }
    }
}

#[test]
fn ksplat_comes_back() {
    for sh_degree in 0..=2 {
        // 50 is not a multiple of the bucket size 4.
        let g = gaussians(50, sh_degree, 20.0, 3);
        let zero = Within { opacity: 0.002, dc: 0.007, ..EXACT };
        let one =
            Within { mean_m: 0.51 * 128.0 / 32767.0, quat: 5e-4, ln_scale: 6e-4, sh: 5e-4, ..zero };
        let two = Within { sh: 0.51 * 4.0 / 255.0, ..one };
        for (level, within) in [(0, zero), (1, one), (2, two)] {
            let name = format!(".ksplat {level}, {sh_degree}");
            assert_alike(&read(&ksplat(&g, level)).unwrap(), &g, within, &name);
        }
    }
}

#[test]
fn gltf_comes_back_in_one_file_and_in_two() {
    for sh_degree in 0..=3 {
        let g = gaussians(50, sh_degree, 20.0, 4);
        assert_alike(&read(&glb(gltf(&g, "", ""))).unwrap(), &g, EXACT, "GLB");
        let (json, buffer) = gltf(&g, "", r#""uri":"data/splats.bin","#);
        let files = vec![
            ("scene.gltf".to_owned(), json.into_bytes()),
            ("data/splats.bin".to_owned(), buffer),
        ];
        let (two, hash) = read_files(&files).unwrap();
        assert_alike(&two, &g, EXACT, "glTF");
        let lines: String = files.iter().map(|f| format!("{}\n", blake3::hash(&f.1))).collect();
        assert_eq!(hash, blake3::hash(lines.as_bytes()).to_string());
    }
}

#[test]
fn nodes_rotate_scale_and_move_splats() {
    let g = gaussians(50, 1, 20.0, 5);
    // A quarter turn around z: x to y, y to -x; twice as large; 10 m up.
    let node = r#","translation":[0,0,10],"rotation":[0,0,0.7071067811865476,0.7071067811865476],
        "scale":[2,2,2]"#;
    let read = read(&glb(gltf(&g, node, ""))).unwrap();
    let mut wanted = g.clone();
    let axes = "0 -1 0 1 0 0 0 0 1".parse::<ingest::Axes>().unwrap().scaled(2.0).unwrap();
    axes.apply(&mut wanted);
    wanted.means_m.iter_mut().for_each(|m| m[2] += 10.0);
    let within = Within { mean_m: 1e-5, ..EXACT };
    assert_alike(&read, &wanted, within, "node");

    let text = refusal(&glb(gltf(&g, r#","scale":[1,2,1]"#, "")));
    assert!(text.starts_with("glTF header, node 0: its matrix is not a rotation"), "{text}");
    let text = refusal(&glb(gltf(&g, r#","children":[0]"#, "")));
    assert_eq!(text, "glTF header, node 0: is reached twice; in a tree, each node has one parent");
}

#[test]
fn sog_comes_back_as_folder_and_archive() {
    for (version, sh_degree) in [1, 2].into_iter().flat_map(|v| (0..=3).map(move |d| (v, d))) {
        let g = gaussians(50, sh_degree, 20.0, 6);
        let within = Within {
            // 16 bits over a range of twice ln(21) = 6.1, times 21, the derivative of the inverse.
            mean_m: 0.51 * 6.1 / 65535.0 * 21.0,
            quat: 0.01,
            ln_scale: 0.51 * 7.1 / 255.0,
            opacity: if version == 1 { 0.51 * 10.0 / 255.0 / 4.0 } else { 0.002 },
            dc: 0.0041,
            sh: 0.0041,
        };
        let name = format!("SOG {version}, {sh_degree}");
        let files = sog(&g, version);
        let (folder, hash) = read_files(&files).unwrap();
        assert_alike(&folder, &g, within, &name);
        let lines: String = files.iter().map(|f| format!("{}\n", blake3::hash(&f.1))).collect();
        assert_eq!(hash, blake3::hash(lines.as_bytes()).to_string());
        for is_packed in [false, true] {
            let inside = |(n, bytes): &(String, Vec<u8>)| (format!("scene/{n}"), bytes.clone());
            let files: Files = files.iter().map(inside).collect();
            assert_eq!(read(&zip(&files, is_packed)).unwrap(), folder, "{name}");
        }
    }
}

#[test]
fn streamed_sog_gives_its_finest_level_and_its_environment() {
    let files = streamed();
    let (all, _) = read_files(&files).unwrap();
    assert_eq!((all.len(), all.sh_degree), (50, 2));
    let sog_in = |folder: &str| {
        let part = files.iter().filter_map(|(name, bytes)| {
            Some((name.strip_prefix(folder)?.to_owned(), bytes.clone()))
        });
        read_files(&part.collect()).unwrap().0
    };
    let fine = sog_in("0/");
    let sky = sog_in("sky/");
    assert_eq!(all.means_m[..40], fine.means_m[..40]);
    assert_eq!(all.sh[..40 * 27], fine.sh[..40 * 27]);
    assert_eq!(all.means_m[40..], sky.means_m[..]);
    // The environment has no higher degrees, so they are zero.
    assert!((40..50).all(|i| all.sh_at(i)[..3] == *sky.sh_at(i - 40)));
    assert!((40..50).all(|i| all.sh_at(i)[3..].iter().all(|&c| c == 0.0)));
    assert_eq!(read(&zip(&files, true)).unwrap(), all);
}

/// Reads a level of a scene of several files.
fn read_level(files: &Files, level: u32) -> Result<Gaussians, ingest::IngestError> {
    let dir = written(files);
    let limits = ReadLimits { level: Some(level), ..ReadLimits::for_own_file() };
    let first = dir.path().join(&files[0].0);
    ingest::read_limited(&first, &limits, &mut |_, _| {}).map(|read| read.gaussians)
}

#[test]
fn a_level_of_a_streamed_sog_is_read() {
    let files = streamed();
    assert_eq!(read_level(&files, 0).unwrap(), read_files(&files).unwrap().0);
    // Two leaves of 5, in the order of the file, and the environment.
    let coarse = read_level(&files, 1).unwrap();
    let file: Files = files
        .iter()
        .filter_map(|(name, bytes)| Some((name.strip_prefix("coarse/")?.to_owned(), bytes.clone())))
        .collect();
    assert_eq!(coarse.len(), 20);
    assert_eq!(coarse.means_m[..10], read_files(&file).unwrap().0.means_m[..]);
    let told = read_level(&files, 2).unwrap_err().to_string();
    assert_eq!(told, "there is no level 2; the levels are 0, 1, 0 being the finest");

    // A leaf that ends at level 0 gives that one.
    let mut uneven = files;
    let text = String::from_utf8(uneven[0].1.clone()).unwrap();
    let cut = text.replacen(r#""1":{"file":0,"offset":5,"count":5},"#, "", 1);
    assert_ne!(cut, text);
    uneven[0].1 = cut.into_bytes();
    assert_eq!(read_level(&uneven, 1).unwrap().len(), 5 + 20 + 10);

    // Other scenes have no levels.
    let told = read_level(&sog(&gaussians(10, 0, 20.0, 7), 2), 0).unwrap_err().to_string();
    assert!(told.contains("only a streamed SOG (lod-meta.json) has levels"), "{told}");
}

/// Programs that pack a SOG pack what [`SogFiles`] names.
#[test]
fn the_files_of_a_sog_are_those_that_are_read() {
    let all = gaussians(50, 3, 20.0, 6);
    for files in [sog(&all, 1), sog(&all, 2), streamed()] {
        let dir = written(&files);
        let path = dir.path().join(&files[0].0);
        let limits = ReadLimits::for_own_file();
        let read = ingest::read_limited(&path, &limits, &mut |_, _| {}).unwrap().parts;
        let named = named_files(&files, &files[0].0);
        assert!(read.len() >= 5 && read.is_subset(&named), "{read:?}, {named:?}");
        // Coarse blocks are named and not read.
        assert!(named.difference(&read).all(|name| name.starts_with("coarse/")), "{named:?}");
    }
}

#[test]
fn nurec_comes_back_without_tracked_objects() {
    for sh_degree in 0..=3 {
        let g = gaussians(50, sh_degree, 20.0, 8);
        let within =
            Within { mean_m: 0.01, quat: 5e-4, opacity: 6e-4, dc: 5e-4, sh: 5e-4, ..EXACT };
        for with_cars in [false, true] {
            let file = usdz(nurec_plain(&g, with_cars));
            assert_alike(&read(&file).unwrap(), &g, within, "NuRec");
        }
    }
}

#[test]
fn tracked_objects_of_nurec_are_split_by_track() {
    let g = gaussians(50, 1, 20.0, 8);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.usdz");
    std::fs::write(&path, usdz(nurec_plain(&g, true))).unwrap();
    let (objects, hash) = ingest::read_tracked(&path, &mut |_, _| {}).unwrap();
    assert_eq!(hash.len(), 64);
    let names: Vec<&str> = objects.iter().map(|object| object.track.as_str()).collect();
    assert_eq!(names, ["car 7", "car 9"]);
    let within = Within { mean_m: 0.01, quat: 5e-4, opacity: 6e-4, dc: 5e-4, sh: 5e-4, ..EXACT };
    for (first, object) in objects.iter().enumerate() {
        let own = g.select((first..50).step_by(2));
        assert_alike(&object.gaussians, &own, within, "NuRec");
    }
    std::fs::write(&path, usdz(nurec_plain(&g, false))).unwrap();
    let error = ingest::read_tracked(&path, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("there are none"), "{error}");
}

#[test]
fn rigid_nodes_are_split_by_point_ids() {
    let g = gaussians(30, 2, 20.0, 9);
    let ids: Vec<u8> = (0..30_i64).flat_map(|i| (i % 3 * 10).to_le_bytes()).collect();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rigid.safetensors");
    let write = |ids: Option<&[u8]>| {
        let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let means: Vec<u8> =
            g.means_m.as_flattened().iter().flat_map(|m| (*m as f32).to_le_bytes()).collect();
        let sh = |from: usize, to: usize| -> Vec<u8> {
            (0..30).flat_map(|i| float_bytes(&g.sh_at(i)[from..to])).collect()
        };
        let tensors: Vec<(&str, Vec<usize>, Vec<u8>)> = vec![
            ("means", vec![30, 3], means),
            ("quats", vec![30, 4], floats(g.quats_wxyz.as_flattened())),
            ("scales", vec![30, 3], floats(g.ln_scales.as_flattened())),
            ("opacities", vec![30], floats(&g.logit_opacities)),
            ("sh0", vec![30, 1, 3], sh(0, 3)),
            ("shN", vec![30, 8, 3], sh(3, 27)),
        ];
        let mut views: Vec<(&str, TensorView<'_>)> = tensors
            .iter()
            .map(|(name, shape, data)| {
                (*name, TensorView::new(Dtype::F32, shape.clone(), data).unwrap())
            })
            .collect();
        if let Some(ids) = ids {
            let shape = vec![ids.len() / 8, 1];
            views.push(("point_ids", TensorView::new(Dtype::I64, shape, ids).unwrap()));
        }
        std::fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
    };
    write(Some(&ids));
    let (objects, _) = ingest::read_tracked(&path, &mut |_, _| {}).unwrap();
    let names: Vec<&str> = objects.iter().map(|object| object.track.as_str()).collect();
    assert_eq!(names, ["0", "10", "20"]);
    assert_eq!(objects[1].gaussians.logit_opacities, g.select((1..30).step_by(3)).logit_opacities);
    assert_eq!(objects[2].gaussians.sh, g.select((2..30).step_by(3)).sh);
    // As a scene, the file is read without the numbers, and says so.
    let scene = ingest::read_limited(&path, &ReadLimits::for_own_file(), &mut |_, _| {}).unwrap();
    assert_eq!(scene.gaussians.len(), 30);
    assert!(scene.notes.warnings[0].contains("actor import --tracked"), "{:?}", scene.notes);
    write(None);
    let error = ingest::read_tracked(&path, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("point_ids"), "{error}");
    write(Some(&ids[..80]));
    let error = ingest::read_tracked(&path, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("10 numbers for 30"), "{error}");
}

fn float_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn progress_of_every_format_ends_at_all_bytes() {
    for case in crate::corpus::corpus() {
        let dir = tempfile::tempdir().unwrap();
        case.write(dir.path());
        let mut reports = Vec::new();
        let first = dir.path().join(&case.files[0].0);
        ingest::read(&first, &mut |done, total| reports.push((done, total))).unwrap();
        assert!(reports.is_sorted(), "{}: {reports:?}", case.name);
        // Files of coarse levels are not read.
        let read = case.files.iter().filter(|(name, _)| !name.starts_with("coarse/"));
        let bytes = read.map(|(name, _)| dir.path().join(name).metadata().unwrap().len()).sum();
        assert_eq!(reports.last(), Some(&(bytes, bytes)), "{}", case.name);
    }
}

/// Each naming counts for nothing: neither the time to read a file nor the memory for it.
#[test]
fn a_file_that_a_scene_names_often_is_read_once() {
    let g = gaussians(20, 0, 20.0, 1);
    let (json, buffer) = gltf(&g, "", r#""uri":"scene.bin","#);
    let named = format!(r#"{{"uri":"scene.bin","byteLength":{}}}"#, buffer.len());
    let often = format!(r#""buffers":[{}{}"#, format!("{named},").repeat(39), r#"{"uri""#);
    let json = json.replacen(r#""buffers":[{"uri""#, &often, 1);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.gltf");
    std::fs::write(&path, &json).unwrap();
    std::fs::write(dir.path().join("scene.bin"), &buffer).unwrap();
    let mut read_bytes = 0;
    let read = ingest::read(&path, &mut |done, _| read_bytes = done).unwrap();
    assert_eq!(read.len(), 20);
    assert_eq!(read_bytes, (json.len() + buffer.len()) as u64);
}

/// A file from an untrusted source names nothing that is not listed.
#[test]
fn a_listed_scene_reads_listed_files_only() {
    let g = gaussians(20, 0, 20.0, 1);
    let (json, buffer) = gltf(&g, "", r#""uri":"scene.bin","#);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.gltf");
    let elsewhere = dir.path().join("elsewhere");
    std::fs::write(&path, &json).unwrap();
    std::fs::write(dir.path().join("scene.bin"), &buffer).unwrap();
    std::fs::write(&elsewhere, &buffer).unwrap();
    let read = |listed: &ListedFiles| {
        let limits = ReadLimits { listed: Some(listed), ..ReadLimits::for_own_file() };
        ingest::read_limited(&path, &limits, &mut |_, _| {})
    };
    let error = read(&ListedFiles::new()).unwrap_err().to_string();
    assert!(
        error.starts_with("part \"scene.bin\": is not the name of exactly one file"),
        "{error}"
    );
    let read = read(&ListedFiles::from([("scene.bin".to_owned(), elsewhere)])).unwrap();
    assert_eq!((read.gaussians.len(), read.parts.len()), (20, 1));
    assert_eq!(read.hash, ingest::read_hashed(&path, &mut |_, _| {}).unwrap().1);
}

/// Unpacked bytes count against the memory of the reader, and reading stops when the flag is set.
#[test]
fn a_reader_has_a_budget_and_can_be_stopped() {
    let g = gaussians(2_000, 3, 20.0, 1);
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in [
        ("gzip.spz", gzip(&spz_plain(&g, 3))),
        ("zstd.spz", spz4(&g)),
        ("scene.glb", glb(gltf(&g, "", ""))),
        ("scene.sog", zip(&sog(&g, 2), false)),
        ("scene.usdz", usdz(nurec_plain(&g, false))),
    ] {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let read = |limits: ReadLimits<'_>| ingest::read_limited(&path, &limits, &mut |_, _| {});
        assert_eq!(read(ReadLimits::for_own_file()).unwrap().gaussians.len(), 2_000);
        let error = read(ReadLimits { memory_bytes: 10_000, ..ReadLimits::for_own_file() });
        let error = error.unwrap_err().to_string();
        assert!(error.contains("10000 may be used"), "{name}: {error}");
        let stop = StopFlag::default();
        stop.stop();
        let error =
            read(ReadLimits { stop, ..ReadLimits::for_own_file() }).unwrap_err().to_string();
        assert!(error.contains("reading was stopped"), "{name}: {error}");
    }
}
