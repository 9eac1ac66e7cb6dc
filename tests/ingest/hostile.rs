//! Files that were truncated, changed, or made to do harm.

use wildcity_scene::Gaussians;

use crate::corpus::{COUNT, corpus};
use crate::format_files::{
    Files, glb, gltf, gzip, ksplat, nurec_plain, sog, splat, spz_plain, spz4, streamed, usdz, webp,
    zip,
};
use crate::refusal;
use crate::scene_files::gaussians;

#[test]
fn every_case_is_valid_before_it_is_damaged() {
    for case in corpus() {
        let dir = tempfile::tempdir().unwrap();
        case.write(dir.path());
        let read = case.read_with(dir.path(), 0, &case.files[0].1);
        let count = if case.name == "streamed SOG" { 50 } else { COUNT };
        assert_eq!(read.unwrap().len(), count, "{}", case.name);
    }
}

#[test]
fn files_truncated_anywhere_are_refused() {
    for case in corpus() {
        let dir = tempfile::tempdir().unwrap();
        case.write(dir.path());
        for (part, (name, bytes)) in case.files.iter().enumerate() {
            // Small files are cut at every byte; larger ones at some, at varying offsets within
            // words.
            for end in (0..bytes.len()).step_by((bytes.len() / 40) | 1) {
                // One record less is a smaller scene, because the format has no count.
                let is_whole = case.name == ".splat" && end > 0 && end % 32 == 0;
                // Files of coarse levels are not read.
                let is_whole = is_whole || name.starts_with("coarse/");
                let read = case.read_with(dir.path(), part, &bytes[..end]);
                let place = format!("{}, {name} cut to {end} of {}", case.name, bytes.len());
                match read {
                    Ok(read) => assert!(is_whole, "{place}: read as {} Gaussians", read.len()),
                    Err(error) => assert!(error.to_string().len() > 20, "{place}: {error}"),
                }
            }
            case.read_with(dir.path(), part, bytes).unwrap();
        }
    }
}

#[test]
fn a_flipped_bit_is_refused_or_changes_numbers_only() {
    for case in corpus() {
        let dir = tempfile::tempdir().unwrap();
        case.write(dir.path());
        for (part, (name, bytes)) in case.files.iter().enumerate() {
            let mut bytes = bytes.clone();
            for bit in (0..8 * bytes.len()).step_by((bytes.len() / 12) | 1) {
                bytes[bit / 8] ^= 1 << (bit % 8);
                if let Ok(g) = case.read_with(dir.path(), part, &bytes) {
                    let place = format!("{}, bit {bit} of {name}", case.name);
                    assert!(g.len() <= 64, "{place}: {} Gaussians", g.len());
                    assert_columns(&g, &place);
                }
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
        }
    }
}

/// Checks that all columns are equally long, and every number is valid.
fn assert_columns(g: &Gaussians, place: &str) {
    let n = g.len();
    let colours = n * 3 * wildcity_scene::sh::coefficients(g.sh_degree);
    let lengths = [g.quats_wxyz.len(), g.ln_scales.len(), g.logit_opacities.len()];
    assert_eq!((lengths, g.sh.len()), ([n; 3], colours), "{place}");
    let name = &|field| format!("{field:?}");
    assert!(wildcity_twin::ingest::validate::check(g, name).is_ok(), "{place}");
}

#[test]
fn counts_that_no_file_holds_are_refused_before_memory_is_allocated() {
    let g = gaussians(COUNT, 0, 20.0, 1);
    let changed = |mut file: Vec<u8>, at: usize, bytes: &[u8]| {
        file[at..at + bytes.len()].copy_from_slice(bytes);
        file
    };
    let huge = u32::MAX.to_le_bytes();
    let cases = [
        (changed(spz_plain(&g, 3), 8, &huge), "SPZ body: the header promises 85899345916 bytes"),
        (gzip(&changed(spz_plain(&g, 3), 8, &huge)), "SPZ, the gzip stream: "),
        (changed(spz4(&g), 8, &huge), "SPZ header, stream of positions: 54 bytes; 4294967295"),
        // Four streams of version 4, and a length of 2^60 for one.
        (changed(spz4(&g), 15, &[4]), "SPZ header, byte 15: 4 streams; SH degree 0 has 5"),
        (
            changed(spz4(&g), 44, &(1u64 << 60).to_le_bytes()),
            "SPZ body: the header promises 1152921",
        ),
        (
            changed(spz4(&g), 16, &huge),
            "SPZ header, bytes 16 to 19: the table cannot be at 4294967295",
        ),
        (changed(ksplat(&g, 0), 4, &huge), ".ksplat body: the header promises 4398046514176 bytes"),
        (
            changed(ksplat(&g, 0), 4096, &huge),
            ".ksplat header, section 0: 4294967295 Gaussians, but",
        ),
        (changed(ksplat(&g, 0), 4096 + 4, &huge), ".ksplat body: the header promises 188978"),
        (changed(ksplat(&g, 1), 4096 + 12, &huge), ".ksplat body: the header promises 515396"),
        (changed(ksplat(&g, 1), 4096 + 8, &[0; 4]), ".ksplat header, section 0: its Gaussian 2 is"),
        // Buckets of 4 bytes, also without any Gaussian.
        (
            changed(changed(ksplat(&g, 1), 4096 + 20, &[4, 0]), 4096, &[0; 4]),
            ".ksplat header, section 0: buckets of 4 bytes; a centre takes 12",
        ),
    ];
    for (file, wanted) in cases {
        let text = refusal(&file);
        assert!(text.starts_with(wanted), "{text}\n{wanted}");
    }
    let (json, buffer) = gltf(&g, "", "");
    let count = 1u64 << 60;
    let json = |from: &str, to: &str| glb((json.replacen(from, to, 1), buffer.clone()));
    for (file, wanted) in [
        (
            json(r#""count":6"#, &format!(r#""count":{count}"#)),
            "1152921504606846976 rows of 12 bytes",
        ),
        (
            json(r#""byteOffset":0"#, r#""byteOffset":18446744073709551615"#),
            "18446744073709551615 of buffer",
        ),
        (
            json(r#""byteLength":72"#, r#""byteLength":18446744073709551615"#),
            "18446744073709551615 bytes from 0",
        ),
        (
            json(r#""bufferView":0"#, r#""bufferView":99"#),
            "accessor 0 has no bufferView that exists",
        ),
        (
            json(r#""buffer":0"#, r#""buffer":0,"byteStride":4"#),
            "byteStride 4; 12 to 252 are possible",
        ),
        (json(r#""VEC3""#, r#""SCALAR""#), "accessor 0 is \"SCALAR\", not VEC3"),
        (
            json(r#"KHR_gaussian_splatting:SCALE"#, r#"SCALE"#),
            "has no attribute KHR_gaussian_splatting:SCALE",
        ),
        (
            json(r#""kernel":"ellipse""#, r#""extensions":{"KHR_x_compression_spz_2":{}}"#),
            "is compressed by KHR_x_compression_spz_2",
        ),
    ] {
        let text = refusal(&file);
        assert!(text.starts_with("glTF header, node 0, primitive 0"), "{text}");
        assert!(text.contains(wanted), "{text}\n{wanted}");
    }
}

/// The error of a scene of several files, one of which was changed.
fn part_refusal(files: &Files, part: &str, change: &dyn Fn(&mut Vec<u8>)) -> String {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let mut bytes = bytes.clone();
        if name == part {
            change(&mut bytes);
        }
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    let read = wildcity_twin::ingest::read(&dir.path().join(&files[0].0), &mut |_, _| {});
    read.unwrap_err().to_string()
}

fn text_change(from: &str, to: &str) -> impl Fn(&mut Vec<u8>) {
    move |bytes| {
        let text = String::from_utf8(std::mem::take(bytes)).unwrap();
        let changed = text.replacen(from, to, 1);
        assert_ne!(text, changed, "there is no {from}");
        *bytes = changed.into_bytes();
    }
}

#[test]
fn a_sog_that_contradicts_itself_is_named_by_file() {
    let files = sog(&gaussians(COUNT, 1, 20.0, 1), 2);
    let meta = |from: &str, to: &str| part_refusal(&files, "meta.json", &text_change(from, to));
    let many = format!(r#""count":{}"#, 1u64 << 60);
    for (text, wanted) in [
        (meta(r#""version":2"#, r#""version":3"#), "SOG header, meta.json: version 3; 2, and 1"),
        (meta(r#""count":6"#, &many), "1152921504606846976 Gaussians; at most 4294967295 fit"),
        (
            meta(r#""count":6"#, r#""count":9"#),
            "SOG body, means_l.webp: 4x2 pixels for 9 Gaussians",
        ),
        (
            meta(r#""bands":1"#, r#""bands":2"#),
            "SOG body, centroids.webp: is 192 pixels wide for 2 b",
        ),
        (meta(r#""bands":1"#, r#""bands":9"#), "SOG header, meta.json: shN has 9 bands; 1 to 3"),
        (
            meta(r#""count":6,"bands""#, r#""count":3,"bands""#),
            "SOG body, centroids.webp: there is no entry 3,",
        ),
        (
            meta(r#""count":6,"bands""#, r#""count":99,"bands""#),
            "SOG body, centroids.webp: has room for 64 entries",
        ),
        (
            meta(r#""codebook":["#, r#""codebook":[1.0,"#),
            "SOG header, meta.json: scales has a codebook of 257",
        ),
        (meta("quats.webp", "../quats.webp"), "part \"../quats.webp\": is not a plain path below"),
        (meta("quats.webp", "/etc/passwd"), "part \"/etc/passwd\": is not a plain path below"),
        (meta("quats.webp", "none.webp"), "part \"none.webp\": cannot read: No such file"),
        (
            meta(r#""means":"#, r#""moons":"#),
            "SOG header, meta.json: has neither means nor lodLevels",
        ),
        (meta(r#""maxs":["#, r#""maxs":[1e999,"#), "SOG header, meta.json: number out of range"),
        (meta(r#""maxs":["#, r#""maxs":[1e300,"#), "SOG header, meta.json: trailing characters"),
    ] {
        assert!(text.starts_with(wanted), "{text}\n{wanted}");
    }
    let image = |name: &str, pixels: &[[u8; 4]]| {
        part_refusal(&files, name, &|bytes| *bytes = webp(pixels, 4))
    };
    let text = image("quats.webp", &[[0, 0, 0, 251]; 6]);
    assert!(text.starts_with("SOG body, quats.webp: Gaussian 0: alpha is 251"), "{text}");
    let text = part_refusal(&files, "quats.webp", &|bytes| *bytes = b"no image".to_vec());
    assert!(text.starts_with("SOG body, quats.webp: is a damaged WebP image: "), "{text}");

    let files = streamed();
    let meta = |from: &str, to: &str| part_refusal(&files, "lod-meta.json", &text_change(from, to));
    for (text, wanted) in [
        (
            meta(r#""file":1,"offset":0"#, r#""file":9,"offset":0"#),
            "SOG header, lod-meta.json: file 9; there are 2",
        ),
        (
            meta(r#""file":1,"offset":0"#, r#""file":1,"offset":1"#),
            "SOG header, lod-meta.json: two leaves share",
        ),
        (meta(r#""offset":20"#, r#""offset":26"#), "SOG header, lod-meta.json: Gaussians to 46 of"),
        (
            meta(r#""offset":20"#, r#""offset":18446744073709551615"#),
            "SOG header, lod-meta.json: Gaussians to",
        ),
        (
            meta("coarse/meta.json", "0/meta.json"),
            "SOG header, lod-meta.json: file \"0/meta.json\" is named twice",
        ),
        (
            meta("sky/meta.json", "sky/../sky/meta.json"),
            "part \"sky/../sky/meta.json\": is not a plain",
        ),
    ] {
        assert!(text.starts_with(wanted), "{text}\n{wanted}");
    }
}

#[test]
fn errors_of_archives_and_payloads_say_what_is_missing() {
    let g = gaussians(COUNT, 0, 20.0, 1);
    let file = |name: &str, bytes: &[u8]| vec![(name.to_owned(), bytes.to_vec())];
    let text = refusal(&zip(&file("readme.txt", b"hello"), false));
    assert!(
        text.starts_with("zip body, directory: it holds no meta.json or lod-meta.json"),
        "{text}"
    );
    let text = refusal(&zip(&file("archive/data.pkl", b"hello"), false));
    assert!(text.contains("wildcity.convert CKPT.pt OUT.safetensors"), "{text}");
    assert!(text.contains("python -m wildcity.convert"), "{text}");
    let text = refusal(&zip(&sog(&g, 2)[..3], false));
    assert_eq!(text, "zip body, scales.webp: is not in the archive");
    let mut zip = zip(&sog(&g, 2), false);
    let at = zip.windows(4).position(|w| w == b"RIFF").unwrap() + 20;
    zip[at] ^= 1;
    assert!(
        refusal(&zip).contains("means_l.webp: it is damaged: Invalid checksum"),
        "{}",
        refusal(&zip)
    );

    let plain = nurec_plain(&g, false);
    let with = |from: &[u8], to: &[u8]| {
        let at = plain.windows(from.len()).position(|w| w == from).unwrap();
        refusal(&usdz([&plain[..at], to, &plain[at + from.len()..]].concat()))
    };
    for (text, wanted) in [
        (
            with(b"sigmoid", b"sigmois"),
            "config.layers.street.density_activation: is \"sigmois\"; \"sigm",
        ),
        (with(b"state_dict", b"state_dick"), "nre_data.state_dict: is missing"),
        (
            with(b"street.rotations.shape", b"street.rotations.shade"),
            "rotations.shape: is not two numbers",
        ),
        (
            with(&[0xce, 0, 0, 0, 6], &[0xce, 0xff, 0xff, 0xff, 6]),
            "positions: 36 bytes, which is not the size of 128849",
        ),
        (with(&[0xde, 0, 1], &[0xde, 0, 9]), "MessagePack: byte "),
        (with(&[0xde, 0, 1], &[0xc1, 0, 1]), "MessagePack: byte 0: 0xc1 begins no value"),
    ] {
        assert!(text.starts_with("NuRec body, ") && text.contains(wanted), "{text}\n{wanted}");
    }
    let text = refusal(&usdz([0x91; 5000].to_vec()));
    assert!(text.contains("more than 32 values in each other"), "{text}");
    let many = [&[0xdd, 0xff, 0xff, 0xff, 0xff][..], &vec![0xc0; 3 << 20]].concat();
    assert!(refusal(&usdz(many)).contains("more than 1048576 values"));
}

#[test]
fn a_splat_file_is_detected_by_its_first_record() {
    let g = gaussians(4, 0, 20.0, 1);
    let file = splat(&g);
    let text = refusal(&file[..100]);
    assert_eq!(
        text,
        ".splat body: the header promises 128 bytes (4 records of 32 bytes), the file holds 100; it \
         is truncated: write or copy it again"
    );
    let mut negative = file.clone();
    negative[32 + 12..32 + 16].copy_from_slice(&(-1.0f32).to_le_bytes());
    assert!(
        refusal(&negative).starts_with("Gaussian 1: ln of scale[0] is NaN"),
        "{}",
        refusal(&negative)
    );
    for text in
        ["0.1234 0.5678 0.9012 0.3456 0.7890 0.1234", "id;x;y;z;opacity;1;2;3;4;5;6;7;8;9;10"]
    {
        assert!(
            refusal(text.as_bytes()).contains("which is none of the formats that can be read"),
            "{text}"
        );
    }
}

/// A NuRec payload of empty layers, each of six arrays with their shapes.
fn empty_layers(count: usize) -> Vec<u8> {
    let text = |text: &str| [&[0xd9, text.len() as u8], text.as_bytes()].concat();
    let long = |kind: u8, length: usize| [&[kind][..], &(length as u32).to_be_bytes()].concat();
    let fields = [
        ("positions", 3),
        ("rotations", 4),
        ("scales", 3),
        ("densities", 1),
        ("features_albedo", 3),
        ("features_specular", 0),
    ];
    let mut state = long(0xdf, count * 2 * fields.len());
    for layer in 0..count {
        for (field, columns) in fields {
            let key = format!(".gaussians_nodes.{layer}.{field}");
            state.extend([text(&key), vec![0xc4, 0]].concat());
            state.extend([text(&format!("{key}.shape")), vec![0x92, 0, columns]].concat());
        }
    }
    let state = [&[0x81][..], &text("state_dict"), &state].concat();
    usdz([&[0x81][..], &text("nre_data"), &state].concat())
}

/// The time to read layers is linear in their number, which has a limit.
#[test]
fn many_empty_layers_take_no_time() {
    assert_eq!(crate::read(&empty_layers(1_024)).unwrap().len(), 0);
    let file = empty_layers(29_000);
    let begun = std::time::Instant::now();
    let text = refusal(&file);
    let took = begun.elapsed();
    assert!(text.ends_with("29000 layers; at most 1024 are read"), "{text}");
    assert!(took.as_secs_f64() < 1.0, "{took:?}");
}

/// Bytes after the content are damage, or hide something.
#[test]
fn bytes_after_the_end_and_wrong_counts_are_refused() {
    let g = gaussians(COUNT, 0, 20.0, 1);
    let with = |mut file: Vec<u8>, more: &[u8]| {
        file.extend(more);
        file
    };
    let payload = with(gzip(&nurec_plain(&g, false)), b"more");
    let usdz = zip(&[("scene.nurec".to_owned(), payload)], false);
    let mut counted = ksplat(&g, 0);
    counted[16] += 1;
    // Four bytes within the length that the header says.
    let mut padded = with(glb(gltf(&g, "", "")), &[0; 4]);
    let length = padded.len() as u32;
    padded[8..12].copy_from_slice(&length.to_le_bytes());
    for (file, wanted) in [
        (with(gzip(&spz_plain(&g, 3)), b"more"), "SPZ body, the end: more than the gzip stream"),
        (
            with(gzip(&spz_plain(&g, 3)), &gzip(b"x")),
            "SPZ body, the end: more than the gzip stream",
        ),
        (usdz, "NuRec body, the gzip stream: is followed by 4 bytes"),
        (with(zip(&sog(&g, 2), false), &[0]), "zip body, the end of the directory: is not at"),
        (counted, ".ksplat header, bytes 16 to 19: 7 Gaussians; the sections have 6"),
        (with(splat(&g), &[0; 32]), ".splat body, record 6: is all zeros"),
        (padded, "glTF header, chunks: 4 bytes after the last one"),
    ] {
        let text = refusal(&file);
        assert!(text.starts_with(wanted), "{text}\n{wanted}");
    }
}
