//! Points of captures, and the PLY file that training writes.

use std::fs;
use std::path::Path;

use wildcity_twin::ingest::capture::{CapturePoint, read_points};
use wildcity_twin::ingest::{self, write_ply};

use crate::scene_files::gaussians;

const POINTS: [CapturePoint; 2] = [
    CapturePoint { at: [1.5, -2.0, 0.25], rgb8: [10, 200, 255] },
    CapturePoint { at: [-1e3, 0.0, 7.0], rgb8: [0, 1, 2] },
];

fn colmap_binary(points: &[CapturePoint]) -> Vec<u8> {
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for (id, point) in (7_u64..).zip(points) {
        bytes.extend(id.to_le_bytes());
        bytes.extend(point.at.iter().flat_map(|value| value.to_le_bytes()));
        bytes.extend(point.rgb8);
        bytes.extend(0.5_f64.to_le_bytes());
        // Two images have seen it.
        bytes.extend(2_u64.to_le_bytes());
        bytes.extend([1, 5, 2, 6].iter().flat_map(|value: &i32| value.to_le_bytes()));
    }
    bytes
}

fn colmap_text(points: &[CapturePoint]) -> String {
    let line = |point: &CapturePoint| {
        let [x, y, z] = point.at;
        let [r, g, b] = point.rgb8;
        format!("3 {x} {y} {z} {r} {g} {b} 0.5 1 5 2 6\n")
    };
    format!("# a comment\n\n{}", points.iter().map(line).collect::<String>())
}

fn ply(points: &[CapturePoint]) -> String {
    let count = points.len();
    let line = |point: &CapturePoint| {
        let [x, y, z] = point.at;
        let [r, g, b] = point.rgb8;
        format!("{x} {y} {z} {r} {g} {b}\n")
    };
    format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty double x\nproperty double y\n\
         property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
         end_header\n{}",
        points.iter().map(line).collect::<String>()
    )
}

#[test]
fn points_are_read_from_every_format() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(read_points(dir.path()).unwrap(), None);
    let sparse = dir.path().join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    fs::write(sparse.join("points3D.txt"), colmap_text(&POINTS)).unwrap();
    assert_eq!(read_points(dir.path()).unwrap().unwrap(), POINTS);
    // The binary file comes first, as in COLMAP.
    fs::write(sparse.join("points3D.bin"), colmap_binary(&POINTS[..1])).unwrap();
    assert_eq!(read_points(dir.path()).unwrap().unwrap(), POINTS[..1]);
    let file = dir.path().join("points.ply");
    fs::write(&file, ply(&POINTS)).unwrap();
    assert_eq!(read_points(&file).unwrap().unwrap(), POINTS);
    // Without colours they are grey.
    let plain = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                 property float z\nend_header\n1 2 3\n";
    fs::write(&file, plain).unwrap();
    let grey = CapturePoint { at: [1.0, 2.0, 3.0], rgb8: [128; 3] };
    assert_eq!(read_points(&file).unwrap().unwrap(), [grey]);
}

#[test]
fn damaged_points_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        fs::write(&path, bytes).unwrap();
        let source: &Path = if name.ends_with("ply") { &path } else { dir.path() };
        let error = read_points(source).unwrap_err().to_string();
        fs::remove_file(&path).unwrap();
        assert!(error.contains(name), "{error}");
        error
    };
    let whole = colmap_binary(&POINTS);
    for end in [0, 7, 8, 30, whole.len() - 1] {
        let error = refused("points3D.bin", &whole[..end]);
        assert!(error.contains("byte") && error.contains("ends"), "{end}: {error}");
    }
    let nan = CapturePoint { at: [f64::NAN, 0.0, 0.0], ..POINTS[0] };
    assert!(refused("points3D.bin", &colmap_binary(&[nan])).contains("NaN"));
    assert!(refused("points3D.txt", colmap_text(&[nan]).as_bytes()).contains(":3"));
    assert!(refused("points3D.txt", b"1 2 3\n").contains("POINT3D_ID"));
    assert!(refused("points3D.txt", b"1 2 3 4 300 0 0 1\n").contains("R is \"300\""));
    assert!(refused("points.ply", &ply(&POINTS).as_bytes()[..60]).contains("end_header"));
    assert!(refused("points.ply", ply(&[nan]).as_bytes()).contains("row 0"));
}

#[test]
fn what_is_written_is_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("trained.ply");
    for sh_degree in 0..=3 {
        let scene = gaussians(40, sh_degree, 30.0, 3);
        let mut bytes = Vec::new();
        write_ply(&scene, &mut bytes).unwrap();
        fs::write(&path, &bytes).unwrap();
        let again = ingest::read(&path, &mut |_, _| {}).unwrap();
        assert_eq!(again.sh_degree, scene.sh_degree);
        assert_eq!(again.sh, scene.sh);
        assert_eq!(again.ln_scales, scene.ln_scales);
        assert_eq!(again.quats_wxyz, scene.quats_wxyz);
        assert_eq!(again.logit_opacities, scene.logit_opacities);
        let off = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-4);
        assert!(again.means_m.iter().zip(&scene.means_m).all(off));
    }
    // Far from the origin f32 would move them by a quarter of a metre.
    let mut far = gaussians(3, 0, 30.0, 3);
    far.means_m.iter_mut().for_each(|mean_m| mean_m[0] += 5_400_000.3);
    let mut bytes = Vec::new();
    write_ply(&far, &mut bytes).unwrap();
    fs::write(&path, &bytes).unwrap();
    assert_eq!(ingest::read(&path, &mut |_, _| {}).unwrap().means_m, far.means_m);
}
