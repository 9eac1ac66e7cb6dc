//! Every kind of damage, with the error that it must give.

use wildcity_scene::Gaussians;

use crate::scene_files::{
    Tensor, gaussians, gsplat_tensors, inria_columns, ply, ply_header, safetensors,
};
use crate::{read, refusal};

type Spoil = fn(&mut Gaussians);

/// A change to Gaussian 17 of 20 of degree 2, and the errors of PLY and safetensors for it.
const SPOILS: [(Spoil, &str, &str); 12] = [
    (|g| g.means_m[17][1] = f64::NAN, "y is NaN", "means[1] is NaN"),
    (|g| g.means_m[17][2] = f64::INFINITY, "z is inf", "means[2] is inf"),
    (|g| g.means_m[17][0] = -1.5e8, "x is -150000000", "means[0] is -150000000"),
    (|g| g.quats_wxyz[17][3] = f32::NAN, "rot_3 is NaN", "quats[3] is NaN"),
    (|g| g.quats_wxyz[17] = [0.0; 4], "length of rot is 0", "length of quats is 0"),
    (|g| g.quats_wxyz[17][0] = 1e9, "length of rot is 1000000000", "length of quats is 1000000000"),
    (|g| g.ln_scales[17][1] = 104.2, "scale_1 is 104.2", "scales[1] is 104.2"),
    (|g| g.ln_scales[17][0] = f32::NAN, "scale_0 is NaN", "scales[0] is NaN"),
    (|g| g.logit_opacities[17] = 2e4, "opacity is 20000", "opacities is 20000"),
    (|g| g.sh[17 * 27 + 2] = 1e6, "f_dc_2 is 1000000", "sh0[0][2] is 1000000"),
    // Coefficient 3, green: the 8 of red come first in a PLY.
    (|g| g.sh[17 * 27 + 3 * 3 + 1] = f32::NAN, "f_rest_10 is NaN", "shN[2][1] is NaN"),
    (|g| g.sh[17 * 27 + 26] = -1e30, "f_rest_23 is -1", "shN[7][2] is -1"),
];

#[test]
fn a_bad_gaussian_is_named_with_field_and_value() {
    for (spoil, ply_says, safetensors_say) in SPOILS {
        let mut scene = gaussians(20, 2, 10.0, 1);
        spoil(&mut scene);
        let text = refusal(&ply(&scene, &inria_columns(2, true)));
        assert!(text.starts_with(&format!("Gaussian 17: {ply_says}")), "{text}");
        let text = refusal(&safetensors(&gsplat_tensors(&scene), &[]));
        assert!(text.starts_with(&format!("Gaussian 17: {safetensors_say}")), "{text}");
    }
    let mut scene = gaussians(20, 2, 10.0, 1);
    scene.ln_scales[17][1] = 104.2;
    assert_eq!(
        refusal(&ply(&scene, &inria_columns(2, false))),
        "Gaussian 17: scale_1 is 104.2; a scale is the natural logarithm of metres, from -30 to 10"
    );
}

#[test]
fn the_first_of_many_bad_ones_is_named() {
    let mut scene = gaussians(50_000, 0, 10.0, 1);
    for index in [49_999, 31_234, 40_000] {
        scene.logit_opacities[index] = f32::NAN;
    }
    let text = refusal(&ply(&scene, &inria_columns(0, false)));
    assert!(text.starts_with("Gaussian 31234: opacity is NaN"), "{text}");
}

#[test]
fn a_missing_column_is_named_though_the_size_is_wrong_too() {
    let mut columns = inria_columns(1, false);
    let whole = ply(&gaussians(20, 1, 1.0, 1), &columns);
    let body = &whole[ply_header(20, &columns).len()..];
    columns.retain(|column| column.name != "rot_3");
    let text = refusal(&[ply_header(20, &columns).as_bytes(), body].concat());
    assert_eq!(text, "PLY header, element vertex: there is no property rot_3");
}

#[test]
fn pipes_and_directories_are_refused_at_once() {
    let folder = "a folder; give a file in it, of a scene in a folder its meta.json";
    for (path, found) in [("/dev/zero", "not a regular file but a pipe"), ("/", folder)] {
        let scene = wildcity_twin::ingest::read(path.as_ref(), &mut |_, _| {}).unwrap_err();
        let cameras = wildcity_twin::ingest::cameras::read(path.as_ref()).unwrap_err();
        for text in [scene.to_string(), cameras.to_string()] {
            assert!(text.starts_with(found), "{text}");
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let pipe = dir.path().join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let text = wildcity_twin::ingest::read(&pipe, &mut |_, _| {}).unwrap_err().to_string();
    assert!(text.starts_with("not a regular file but a pipe"), "{text}");
}

#[test]
fn a_file_is_read_up_to_its_limit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("settings");
    std::fs::write(&path, b"12345").unwrap();
    assert_eq!(wildcity_twin::ingest::read_whole(&path, 5).unwrap(), b"12345");
    let text = wildcity_twin::ingest::read_whole(&path, 4).unwrap_err().to_string();
    assert_eq!(text, "larger than 4 bytes");
}

#[test]
fn camera_lists_say_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cameras.json");
    let good = r#"{"name": "a", "width": 8, "height": 8, "fx": 5, "fy": 5, "cx": 4, "cy": 4,
        "position": [0, 0, 0], "R_world_to_cam": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"#;
    let refusal = |text: String| {
        std::fs::write(&path, text).unwrap();
        // As the command line prints it, with every source.
        let error = wildcity_twin::ingest::cameras::read(&path).unwrap_err();
        let sources = std::iter::successors(std::error::Error::source(&error), |e| e.source());
        sources.fold(error.to_string(), |text, source| format!("{text}: {source}"))
    };
    let flat = refusal(good.replace("\"width\": 8", "\"width\": 0"));
    assert_eq!(flat, "camera \"a\": width is 0; a side is from 1 to 16384 pixels");
    let far = refusal(good.replace("\"fx\": 5", "\"fx\": 1e300"));
    assert!(far.starts_with("camera \"a\": fx is 1e300; a focal length"), "{far}");
    let mirror = refusal(good.replace("[0, 0, 1]]", "[0, 0, -1]]"));
    assert_eq!(mirror, "camera \"a\": R_world_to_cam is a mirror; flip one of its axes");
    let hidden = refusal(good.replace("\"a\"", "\".a\""));
    assert!(hidden.ends_with("not starting with ."), "{hidden}");
    for field in ["shutter", "exposure", "overlay"] {
        let of_rigs = refusal(good.replacen('{', &format!("{{\"{field}\": {{}}, "), 1));
        assert!(of_rigs.starts_with("camera \"a\": a camera in a list has no "), "{of_rigs}");
        assert!(of_rigs.contains(&format!("leave {field} out")), "{of_rigs}");
    }
    for field in ["k1", "camera_model", "is_fisheye"] {
        let other = refusal(good.replacen('{', &format!("{{\"{field}\": 1, "), 1));
        let wanted = format!("camera \"a\": {field} is not a field of a camera list");
        assert!(other.starts_with(&wanted), "{other}");
    }
    assert_eq!(refusal("[]".into()), "the camera list is empty");
}

#[test]
fn a_ply_of_another_size_is_refused_with_the_numbers() {
    let whole = ply(&gaussians(20, 0, 1.0, 1), &inria_columns(0, false));
    let text = refusal(&whole[..whole.len() - 9]);
    assert_eq!(
        text,
        "PLY body: the header promises 1120 bytes (20 vertex of 56 bytes), the file holds 1111; \
         it is truncated: write or copy it again"
    );
    let text = refusal(&[&whole[..], b"xx"].concat());
    assert!(text.contains("holds 1122; it is oversized"), "{text}");
}

#[test]
fn a_count_that_no_file_holds_is_refused_before_memory_is_allocated() {
    let columns = inria_columns(3, false);
    for count in ["1152921504606846976", "18446744073709551615"] {
        let header = ply_header(1, &columns).replace("vertex 1", &format!("vertex {count}"));
        let text = refusal(header.as_bytes());
        assert!(text.contains(&format!("{count} vertex of 236 bytes")), "{text}");
    }
    let header = ply_header(1, &columns).replace("vertex 1", "vertex 18446744073709551616");
    assert!(refusal(header.as_bytes()).starts_with("PLY header, line 4: the count of vertex"));
    let header = ply_header(1, &columns).replace("vertex 1", "vertex -1");
    assert!(refusal(header.as_bytes()).starts_with("PLY header, line 4: the count of vertex"));
}

#[test]
fn an_error_in_a_ply_header_names_the_line() {
    let good = ply_header(0, &inria_columns(1, false));
    let changed = |from: &str, to: &str| refusal(good.replacen(from, to, 1).as_bytes());
    let cases = [
        (
            changed("binary_little_endian", "binary_middle_endian"),
            "line 2: \"format binary_middle_endian 1.0\" must",
        ),
        (changed("float y", "list uchar int y"), "there is no property y"),
        (
            refusal(
                good.replace("vertex 0", "vertex 1")
                    .replace("float y", "list uchar int y")
                    .as_bytes(),
            ),
            "line 6: \"property list uchar int y\": Gaussians",
        ),
        (changed("float y", "half y"), "line 6: \"half\" is not a type"),
        (changed("float y", "float x"), "line 6: property x occurs twice"),
        (changed("float y", "float y y"), "line 6: \"property float y y\" is unknown in a header"),
        (changed("element vertex 0\n", ""), "line 4: there is no element before the property"),
        (changed("element vertex", "element point"), "end: there is no element vertex"),
        (changed("format binary_little_endian 1.0\n", ""), "end: there is no line format"),
        (changed("property float rot_2\n", ""), "element vertex: there is no property rot_2"),
        (changed("property float f_rest_8\n", ""), "8 properties f_rest_*; 0, 9, 24 or 45"),
        (changed("f_rest_8", "f_rest_9"), "there is no property f_rest_8"),
        (changed("end_header\n", ""), "ends before end_header"),
        (changed("made by", &"x".repeat(70_000)), "line 3: the file or the limit of 65536 bytes"),
    ];
    for (text, wanted) in cases {
        assert!(text.starts_with("PLY header, ") && text.contains(wanted), "{text}\n{wanted}");
    }
}

#[test]
fn tensors_with_shapes_that_do_not_match_are_named() {
    let scene = gaussians(20, 1, 1.0, 1);
    let changed = |change: &dyn Fn(&mut Vec<Tensor>), doubles: &[&str]| {
        let mut tensors = gsplat_tensors(&scene);
        change(&mut tensors);
        refusal(&safetensors(&tensors, doubles))
    };
    let tensor = |name: &'static str, shape: Vec<usize>| {
        move |tensors: &mut Vec<Tensor>| {
            tensors.retain(|t| t.0 != name);
            let count = shape.iter().product();
            tensors.push((name, shape.clone(), vec![0.5; count]));
        }
    };
    let cases = [
        (changed(&|t| t.retain(|t| t.0 != "quats"), &[]), "tensor quats: is missing"),
        (changed(&|t| t.retain(|t| t.0 != "sh0"), &[]), "tensor sh0: is missing"),
        (
            changed(&tensor("quats", vec![20, 3]), &[]),
            "tensor quats: has shape [20, 3], not [20, 4]",
        ),
        (changed(&tensor("scales", vec![19, 3]), &[]), "scales: has shape [19, 3], not [20, 3]"),
        (changed(&tensor("opacities", vec![20, 1]), &[]), "opacities: has shape [20, 1], not [20]"),
        (changed(&tensor("sh0", vec![20, 2, 3]), &[]), "sh0: has shape [20, 2, 3], not [20, 1, 3]"),
        (
            changed(&tensor("shN", vec![20, 5, 3]), &[]),
            "tensor shN: has 5 coefficients, not 0, 3, 8, 15",
        ),
        (changed(&tensor("shN", vec![20, 9]), &[]), "shN: has shape [20, 9], not [20, any, 3]"),
        (changed(&tensor("means", vec![]), &[]), "tensor means: has shape [], not [any, 3]"),
        (changed(&|_| (), &["scales"]), "tensor scales: is F64; F32 is read"),
    ];
    for (text, wanted) in cases {
        assert!(
            text.starts_with("safetensors header, ") && text.contains(wanted),
            "{text}\n{wanted}"
        );
    }
}

#[test]
fn damaged_safetensors_are_refused_with_the_numbers() {
    let whole = safetensors(&gsplat_tensors(&gaussians(20, 0, 1.0, 1)), &[]);
    let text = refusal(&whole[..whole.len() - 9]);
    assert!(text.contains("promises 1120 bytes (5 tensors), the file holds 1111"), "{text}");
    let text = refusal(&[&whole[..], b"xx"].concat());
    assert!(text.contains("holds 1122; it is oversized"), "{text}");

    let mut huge = whole.clone();
    huge[..8].copy_from_slice(&(1u64 << 60).to_le_bytes());
    assert!(refusal(&huge).contains("length: 1152921504606846976 bytes; at most 1048576"));
    huge[..8].copy_from_slice(&100_000u64.to_le_bytes());
    assert!(refusal(&huge).contains("length: 100000 bytes do not fit a file of"));

    let text = String::from_utf8_lossy(&whole).into_owned();
    let overlapping = text.replacen("[0,80]", "[0,84]", 1);
    assert_ne!(text, overlapping);
    assert!(refusal(overlapping.as_bytes()).starts_with("safetensors header, JSON: "));
    let shape = r#"{"means":{"dtype":"F32","shape":[4611686018427387904,3],"data_offsets":[0,0]}}"#;
    let file = [&(shape.len() as u64).to_le_bytes(), shape.as_bytes()].concat();
    assert!(refusal(&file).starts_with("safetensors header, JSON: "));
}

#[test]
fn a_missing_file_is_an_error() {
    let path = std::path::Path::new("/nonexistent/scene.ply");
    let text = wildcity_twin::ingest::read(path, &mut |_, _| {}).unwrap_err().to_string();
    assert!(text.starts_with("cannot read: "), "{text}");
    assert!(read(&[0; 4]).is_err());
}
