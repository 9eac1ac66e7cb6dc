use crate::scene_files::{
    Column, Random, gaussians, gsplat_tensors, inria_columns, ply, safetensors,
};
use crate::{read, refusal};

#[test]
fn a_ply_of_any_order_degree_and_type_comes_back() {
    let mut random = Random(7);
    for sh_degree in 0..=3 {
        for normals in [false, true] {
            let written = gaussians(300, sh_degree, 50.0, 1);
            let mut columns = inria_columns(sh_degree, normals);
            assert_eq!(read(&ply(&written, &columns)).unwrap(), written, "INRIA's order");
            random.shuffle(&mut columns);
            for column in &mut columns {
                column.is_double = random.unit() < 0.3;
            }
            assert_eq!(read(&ply(&written, &columns)).unwrap(), written, "{columns:?}");
        }
    }
}

#[test]
fn double_centres_keep_their_digits() {
    let mut written = gaussians(10, 0, 1.0, 2);
    for mean in &mut written.means_m {
        mean[1] += 4.5e6 + 1e-7;
    }
    let mut columns = inria_columns(0, false);
    for column in columns.iter_mut().filter(|c| ["x", "y", "z"].contains(&c.name.as_str())) {
        column.is_double = true;
    }
    assert_eq!(read(&ply(&written, &columns)).unwrap(), written);
    let tensors = safetensors(&gsplat_tensors(&written), &["means"]);
    assert_eq!(read(&tensors).unwrap(), written);
}

#[test]
fn integer_columns_and_other_elements_are_skipped() {
    let written = gaussians(5, 1, 1.0, 3);
    let plain = ply(&written, &inria_columns(1, false));
    let header_end = plain.windows(11).position(|w| w == b"end_header\n").unwrap();
    let header = String::from_utf8(plain[..header_end].to_vec()).unwrap();
    // An element before, a column of one byte first, an element after; line ends of Windows.
    let header = header
        .replace("element vertex", "element camera 2\nproperty short id\nelement vertex")
        .replace("property float x", "property uchar label\nproperty float x")
        + "element extra 3\nproperty int a\nproperty uint8 b\nend_header\n";
    let mut file = header.replace('\n', "\r\n").into_bytes();
    file.extend([9; 4]);
    for row in plain[header_end + 11..].chunks_exact(4 * (14 + 9)) {
        file.push(200);
        file.extend(row);
    }
    file.extend([9; 15]);
    assert_eq!(read(&file).unwrap(), written);
}

#[test]
fn safetensors_come_back_with_colours_in_one_tensor_or_two() {
    for sh_degree in 0..=3 {
        let written = gaussians(300, sh_degree, 50.0, 4);
        let mut tensors = gsplat_tensors(&written);
        assert_eq!(read(&safetensors(&tensors, &[])).unwrap(), written);

        tensors.retain(|(name, ..)| !name.starts_with("sh"));
        let shape = vec![300, written.sh.len() / 900, 3];
        let colours = written.sh.iter().map(|&c| c.into()).collect();
        tensors.push(("coeffs", shape, colours));
        tensors.insert(0, ("step", vec![1], vec![30_000.0]));
        assert_eq!(read(&safetensors(&tensors, &["step"])).unwrap(), written);
    }
}

#[test]
fn a_scene_without_gaussians_is_empty() {
    let none = gaussians(0, 2, 1.0, 0);
    assert_eq!(read(&ply(&none, &inria_columns(2, false))).unwrap(), none);
    assert_eq!(read(&safetensors(&gsplat_tensors(&none), &[])).unwrap(), none);
}

#[test]
fn progress_ends_at_the_file_size() {
    let scene = gaussians(40_000, 0, 1.0, 5);
    let files = [ply(&scene, &inria_columns(0, false)), safetensors(&gsplat_tensors(&scene), &[])];
    let dir = tempfile::tempdir().unwrap();
    for bytes in files {
        let path = dir.path().join("scene");
        std::fs::write(&path, &bytes).unwrap();
        let mut reports = Vec::new();
        wildcity_twin::ingest::read(&path, &mut |done, total| reports.push((done, total))).unwrap();
        assert!(reports.len() > 2 && reports.is_sorted(), "{reports:?}");
        let size = bytes.len() as u64;
        assert_eq!(reports.last(), Some(&(size, size)));
    }
}

#[test]
fn the_hash_is_that_of_the_bytes_that_were_read() {
    let scene = gaussians(20_000, 1, 1.0, 6);
    let mut tensors = gsplat_tensors(&scene);
    // Tensors in another order than they are needed, with unknown ones in the middle and at the
    // end.
    tensors.reverse();
    tensors.insert(2, ("step", vec![1], vec![30_000.0]));
    tensors.push(("seed", vec![3], vec![1.0; 3]));
    let dir = tempfile::tempdir().unwrap();
    for bytes in [ply(&scene, &inria_columns(1, true)), safetensors(&tensors, &["step"])] {
        let path = dir.path().join("scene");
        std::fs::write(&path, &bytes).unwrap();
        let mut last = (0, 0);
        let read =
            wildcity_twin::ingest::read_hashed(&path, &mut |done, total| last = (done, total));
        assert_eq!(read.unwrap(), (scene.clone(), blake3::hash(&bytes).to_hex().to_string()));
        assert_eq!(last, (bytes.len() as u64, bytes.len() as u64));
    }
}

#[test]
fn progress_is_reported_regularly_in_any_order_of_elements() {
    let scene = gaussians(1, 0, 1.0, 5);
    let plain = ply(&scene, &inria_columns(0, false));
    let header_end = plain.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(plain[..header_end].to_vec()).unwrap();
    let header =
        header.replace("element vertex", "element id 100000\nproperty uchar a\nelement vertex");
    let file = [header.as_bytes(), &[7; 100_000], &plain[header_end..]].concat();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene");
    std::fs::write(&path, &file).unwrap();
    let mut reports = 0;
    assert_eq!(wildcity_twin::ingest::read(&path, &mut |_, _| reports += 1).unwrap(), scene);
    assert!((6..12).contains(&reports), "{reports}");
}

#[test]
fn the_format_does_not_depend_on_the_name_of_a_file() {
    // `read` uses a file without extension: the format is detected from the content.
    let text = refusal(b"x y z 1.0 2.0 3.0\n");
    assert!(
        text.contains("starts with \"x y z 1.0\"")
            && text.contains("none of the formats that can be read: PLY"),
        "{text}"
    );
    assert!(refusal(b"").contains("starts with \"\""));
    let text = refusal(b"ply\nformat binary 1.0\nelement vertex 0\nend_header\n");
    assert_eq!(
        text,
        "PLY header, line 2: \"format binary 1.0\" must be format binary_little_endian 1.0, binary_big_endian 1.0 or \
         ascii 1.0"
    );
    let column = Column { name: "x".into(), is_double: false };
    let text = refusal(&ply(&gaussians(1, 0, 1.0, 0), &[column]));
    assert!(text.contains("there is no property"), "{text}");
}
