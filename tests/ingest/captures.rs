//! Cameras of captures: every model projects as the program that the file is of.
//!
//! The pixels are those of OpenCV 4 (`projectPoints`, `fisheye.projectPoints`), whose models are
//! COLMAP's (src/colmap/sensor/models.h) and instant-ngp's, and of nerfstudio's formula
//! (cameras/camera_utils.py) in NumPy.

use glam::DVec3;

use wildcity_scene::geometry::Camera;
use wildcity_twin::ingest::capture::{NerfstudioCapture, read_colmap, read_nerfstudio};

use crate::data::real;

/// Points in the axes of the camera.
const POINTS: [[f64; 3]; 3] = [[0.5, -0.3, 2.0], [-1.2, 0.8, 3.0], [2.0, 1.5, 4.0]];

type Pixels = [[f64; 2]; 3];

/// Models of COLMAP with their numbers and parameters.
const COLMAP: [(&str, i32, &[f64], Pixels); 11] = [
    ("SIMPLE_PINHOLE", 0, &[700.0, 640.0, 400.0], PINHOLE),
    (
        "PINHOLE",
        1,
        &[700.0, 710.0, 640.0, 400.0],
        [[815.0, 293.5], [360.0, 589.333333], [990.0, 666.25]],
    ),
    (
        "SIMPLE_RADIAL",
        2,
        &[700.0, 640.0, 400.0, -0.1],
        [[813.5125, 295.8925], [366.471111, 582.352593], [976.328125, 652.246094]],
    ),
    (
        "RADIAL",
        3,
        &[700.0, 640.0, 400.0, -0.1, 0.02],
        [[813.537788, 295.877327], [366.172002, 582.551999], [977.396240, 653.047180]],
    ),
    (
        "OPENCV",
        4,
        &[700.0, 710.0, 640.0, 400.0, -0.1, 0.02, 0.001, -0.002],
        [[813.191288, 294.588661], [365.251113, 585.727884], [976.411865, 656.606671]],
    ),
    ("OPENCV_FISHEYE", 5, &[700.0, 710.0, 640.0, 400.0, -0.03, -0.005, -0.001, 0.0007], FISHEYE),
    (
        "FULL_OPENCV",
        6,
        &[700.0, 710.0, 640.0, 400.0, -0.1, 0.02, 0.001, -0.002, -0.004, 0.01, 0.003, 0.001],
        [[813.039615, 294.680964], [365.943324, 585.259818], [974.842847, 655.413097]],
    ),
    (
        "SIMPLE_RADIAL_FISHEYE",
        8,
        &[700.0, 640.0, 400.0, -0.03],
        [[809.869030, 298.078582], [380.570711, 572.952859], [949.887351, 632.415513]],
    ),
    (
        "RADIAL_FISHEYE",
        9,
        &[700.0, 640.0, 400.0, -0.03, -0.005],
        [[809.863515, 298.081891], [380.623337, 572.917775], [949.735065, 632.301299]],
    ),
    (
        "SIMPLE_FISHEYE",
        14,
        &[700.0, 640.0, 400.0],
        [[810.280138, 297.831917], [378.998337, 574.001108], [952.815617, 634.611712]],
    ),
    (
        "FISHEYE",
        15,
        &[700.0, 710.0, 640.0, 400.0],
        [[810.280138, 296.372373], [378.998337, 576.486838], [952.815617, 637.963308]],
    ),
];

const PINHOLE: Pixels = [[815.0, 295.0], [360.0, 586.666667], [990.0, 662.5]];
const FISHEYE: Pixels =
    [[809.863432, 296.625969], [380.625153, 575.386801], [949.727637, 635.614238]];
/// nerfstudio's lens of perspective models with k1, k2, k3, p1, p2 = -0.1, 0.02, -0.004, 0.001,
/// -0.002.
const NERFSTUDIO: Pixels =
    [[813.190858, 294.588922], [365.264939, 585.718536], [976.328419, 656.543192]];

fn check(camera: &Camera, wanted: &Pixels, about: &str) {
    for (point, wanted) in POINTS.iter().zip(wanted) {
        let pixel = camera.project(DVec3::from_array(*point)).unwrap();
        let off = (pixel - glam::DVec2::from_array(*wanted)).length();
        assert!(off < 1e-4, "{about}: {point:?} is at {pixel}, not {wanted:?}");
    }
}

/// The camera of a COLMAP model of one image, as text.
fn from_text(name: &str, parameters: &str) -> Result<Camera, String> {
    let dir = tempfile::tempdir().unwrap();
    let cameras = format!("1 {name} 1280 800 {parameters}\n");
    std::fs::write(dir.path().join("cameras.txt"), cameras).unwrap();
    std::fs::write(dir.path().join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
    let read = read_colmap(dir.path()).map_err(|error| error.to_string())?;
    Ok(read[0].camera)
}

/// The same, in the binary form.
fn from_bytes(number: i32, parameters: &[f64]) -> Result<Camera, String> {
    let dir = tempfile::tempdir().unwrap();
    let one = 1_u64.to_le_bytes();
    let id = 1_i32.to_le_bytes();
    let mut cameras = [&one[..], &id, &number.to_le_bytes()].concat();
    cameras.extend([1280_u64, 800].iter().flat_map(|side| side.to_le_bytes()));
    cameras.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
    let mut images = [&one[..], &id].concat();
    images.extend([1.0_f64, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0].iter().flat_map(|v| v.to_le_bytes()));
    images.extend([&id[..], b"a.png\0", &0_u64.to_le_bytes()].concat());
    std::fs::write(dir.path().join("cameras.bin"), cameras).unwrap();
    std::fs::write(dir.path().join("images.bin"), images).unwrap();
    let read = read_colmap(dir.path()).map_err(|error| error.to_string())?;
    Ok(read[0].camera)
}

#[test]
fn models_of_colmap_are_those_of_opencv() {
    for (name, number, parameters, wanted) in COLMAP {
        let text: Vec<String> = parameters.iter().map(f64::to_string).collect();
        check(&from_text(name, &text.join(" ")).unwrap(), &wanted, name);
        check(&from_bytes(number, parameters).unwrap(), &wanted, name);
    }
}

#[test]
fn models_of_colmap_without_a_lens_are_not_supported() {
    for (number, name) in [
        (7, "FOV"),
        (10, "THIN_PRISM_FISHEYE"),
        (11, "RAD_TAN_THIN_PRISM_FISHEYE"),
        (12, "SIMPLE_DIVISION"),
        (13, "DIVISION"),
        (16, "EUCM"),
        (17, "EQUIRECTANGULAR"),
    ] {
        let wanted = format!("the camera model {name} is not supported");
        for text in [from_text(name, "1 2 3").unwrap_err(), from_bytes(number, &[]).unwrap_err()] {
            assert!(text.contains(&wanted), "{text}");
        }
    }
    assert!(
        from_text("LENS", "1").unwrap_err().contains("\"LENS\" is not a camera model of COLMAP")
    );
    assert!(from_bytes(99, &[]).unwrap_err().contains("model 99 is not one of COLMAP's"));
}

/// The camera of a transforms.json with these fields of the file.
fn from_transforms(fields: &str) -> Result<Camera, String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("transforms.json");
    let frame =
        r#"{"file_path": "a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#;
    let text = format!(r#"{{"w": 1280, "h": 800, {fields}, "frames": [{frame}]}}"#);
    std::fs::write(&path, text).unwrap();
    let read = read_nerfstudio(&path).map_err(|error| error.to_string())?;
    Ok(read.frames[0].posed.camera)
}

#[test]
fn lenses_of_transforms_are_those_of_their_programs() {
    let focal = r#""fl_x": 700, "fl_y": 710, "cx": 640, "cy": 400"#;
    let k = r#""k1": -0.03, "k2": -0.005, "k3": -0.001, "k4": 0.0007"#;
    let opencv = r#""k1": -0.1, "k2": 0.02, "k3": -0.004, "p1": 0.001, "p2": -0.002"#;
    let list = r#""distortion_params": [-0.1, 0.02, -0.004, 0, 0.001, -0.002]"#;
    let cases = [
        // nerfstudio, its exporters of Metashape and Record3D.
        (format!(r#"{focal}, "camera_model": "OPENCV", {opencv}"#), NERFSTUDIO),
        (format!(r#"{focal}, "camera_model": "OPENCV", {list}"#), NERFSTUDIO),
        (format!(r#"{focal}, "camera_model": "OPENCV_FISHEYE", {k}"#), FISHEYE),
        // instant-ngp.
        (format!(r#"{focal}, {opencv}"#), NERFSTUDIO),
        (format!(r#"{focal}, "is_fisheye": true, {k}"#), FISHEYE),
        // Angles of view: 2 atan(640 / 700) and 2 atan(400 / 700).
        (r#""camera_angle_x": 1.4813038638856655, "camera_angle_y": 1.0382922284930458284930458"#.to_owned(), PINHOLE),
        (r#""x_fov": 84.87245957707, "is_fisheye": false"#.to_owned(), PINHOLE),
        (r#""fl_y": 700, "rolling_shutter": [0, 0, 0, 0]"#.to_owned(), PINHOLE),
    ];
    for (fields, wanted) in cases {
        let camera = from_transforms(&fields).unwrap_or_else(|error| panic!("{fields}: {error}"));
        let off = POINTS.iter().zip(&wanted).map(|(point, wanted)| {
            let pixel = camera.project(DVec3::from_array(*point)).unwrap();
            (pixel - glam::DVec2::from_array(*wanted)).length()
        });
        assert!(off.fold(0.0, f64::max) < 1e-3, "{fields}");
    }
}

#[test]
fn fields_of_transforms_that_make_another_camera_are_named() {
    let focal = r#""fl_x": 700"#;
    for (fields, named) in [
        (r#""k4": 0.02"#, "k4: is 0.02"),
        (r#""camera_model": "OPENCV", "k4": 0.02"#, "k4: is 0.02"),
        (r#""camera_model": "OPENCV_FISHEYE", "p1": 0.1"#, "p1: is 0.1"),
        (
            r#""camera_model": "OPENCV", "is_fisheye": true"#,
            "is_fisheye: is true, and camera_model",
        ),
        (r#""is_fisheye": 1"#, "is_fisheye: is 1, not true or false"),
        (r#""camera_model": "FISHEYE624""#, "camera_model: is \"FISHEYE624\""),
        (r#""camera_model": 4"#, "camera_model: is 4, not a text"),
        (r#""distortion_params": [1, 2]"#, "distortion_params: is [1,2]"),
        (r#""ftheta_p0": 0.1"#, "ftheta_p0: is not read"),
        (r#""equirectangular": true"#, "equirectangular: is not read"),
        (r#""rolling_shutter": [0, 0, 0.01, 0]"#, "rolling_shutter: is not read"),
        (r#""x_fov": 50"#, "x_fov: says a focal length of"),
        (r#""orthographic": true"#, "orthographic: is not read"),
        (r#""k5": 0.1"#, "k5: is not read"),
        (r#""k6": 0.1"#, "k6: is not read"),
        (r#""b1": 3"#, "b1: is not read"),
        (r#""k1": -0.1, "distortion_params": [0, 0, 0, 0, 0, 0]"#, "says k1 0, and k1 is -0.1"),
    ] {
        let text = from_transforms(&format!("{focal}, {fields}")).unwrap_err();
        assert!(text.contains(named), "{text}");
    }
}

/// What is read of a transforms.json with these fields of the file and of its frame.
fn transforms(fields: &str, of_frame: &str) -> Result<NerfstudioCapture, String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("transforms.json");
    let frame = format!(
        r#"{{"file_path": "a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]{of_frame}}}"#
    );
    let text =
        format!(r#"{{"w": 1280, "h": 800, "fl_x": 700{fields}, "frames": [{frame}, {frame}]}}"#);
    std::fs::write(&path, text).unwrap();
    read_nerfstudio(&path).map_err(|error| error.to_string())
}

#[test]
fn a_field_of_a_camera_in_the_file_and_in_its_frames_is_one() {
    for (of_file, of_frame, named) in [
        ("", r#", "fl_x": 900"#, "frames[0].fl_x: is 900, and 700 for the whole file"),
        (r#", "cx": 640"#, r#", "cx": 641"#, "frames[0].cx: is 641"),
        (r#", "k1": 0.1"#, r#", "k1": 0"#, "frames[0].k1: is 0, and 0.1"),
        (
            r#", "k1": 0.1"#,
            r#", "distortion_params": [0, 0, 0, 0, 0, 0]"#,
            "frames[0].distortion_params: says k1 0",
        ),
        (r#", "is_fisheye": true"#, r#", "is_fisheye": false"#, "frames[0].is_fisheye: is false"),
    ] {
        let text = transforms(of_file, of_frame).unwrap_err();
        assert!(text.contains(named), "{text}");
    }
    // Programs write both, with the same values.
    let of_frame = r#", "fl_x": 700.0, "k1": null, "distortion_params": [0.1, 0, 0, 0, 0, 0]"#;
    let same = transforms(r#", "k1": 0.1, "camera_model": "OPENCV""#, of_frame).unwrap();
    assert_eq!(same.frames[0].posed.camera.pinhole.fx, 700.0);
}

#[test]
fn times_and_masks_that_are_not_read_are_named() {
    let warned =
        |of_file: &str, of_frame: &str| transforms(of_file, of_frame).unwrap().warnings.join("; ");
    assert_eq!(warned("", ""), "");
    assert!(warned("", r#", "timestamp": 0.5"#).starts_with("timestamp is not read"));
    assert!(warned("", r#", "time": 0.5"#).starts_with("time is not read"));
    assert_eq!(warned("", r#", "time": 0.5, "time_us": 500000"#), "");
    let crop = warned(r#", "fisheye_crop_radius": 300"#, "");
    assert!(crop.starts_with("fisheye_crop_radius is not read"), "{crop}");
    for (time, named) in [("500000.0", "is 500000.0;"), (r#""5""#, r#"is "5";"#)] {
        let text = transforms("", &format!(r#", "time_us": {time}"#)).unwrap_err();
        assert!(text.contains(&format!("frames[0].time_us: {named}")), "{text}");
    }
    let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,2]]";
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("transforms.json");
    let frame = format!(r#"{{"file_path": "a.png", "transform_matrix": {matrix}}}"#);
    let text = format!(r#"{{"w": 1280, "h": 800, "fl_x": 700, "frames": [{frame}]}}"#);
    std::fs::write(&path, text).unwrap();
    let text = read_nerfstudio(&path).unwrap_err().to_string();
    assert!(text.contains("transform_matrix: the last row must be 0, 0, 0, 1"), "{text}");
}

/// The names of the images of a COLMAP model whose images.txt has these lines.
fn colmap_images(lines: &str) -> Result<Vec<String>, String> {
    let dir = tempfile::tempdir().unwrap();
    let camera = "1 PINHOLE 1280 800 700 700 640 400\n";
    std::fs::write(dir.path().join("cameras.txt"), camera).unwrap();
    std::fs::write(dir.path().join("images.txt"), lines).unwrap();
    let read = read_colmap(dir.path()).map_err(|error| error.to_string())?;
    Ok(read.into_iter().map(|image| image.name).collect())
}

#[test]
fn images_of_colmap_without_their_points_are_refused() {
    let image = |number: usize| format!("{number} 1 0 0 0 0 0 0 1 {number}.png\n");
    let with = |points: &str| [image(1), points.to_owned(), image(2), points.to_owned()].concat();
    for points in ["\n", "1.5 2.5 -1 3 4 7\n", "  \n", "\r\n"] {
        assert_eq!(colmap_images(&with(points)).unwrap(), ["1.png", "2.png"], "{points:?}");
    }
    assert_eq!(colmap_images(with("\n").trim_end()).unwrap(), ["1.png", "2.png"]);
    for points in ["", "1.5 2.5\n", "1.5 2.5 a\n"] {
        let text = colmap_images(&with(points)).unwrap_err();
        assert!(
            text.contains("images.txt:2: ") && text.contains("is not a line of points"),
            "{text}"
        );
    }
}

#[test]
fn cases_of_captures_are_read_or_refused_by_name() {
    let Some(fisheye) = real("cases/ingp_is_fisheye/ingp_fisheye.json") else { return };
    let read = read_nerfstudio(&fisheye).unwrap();
    let at = read.frames[0].posed.camera.project(DVec3::new(1.0, 0.0, 1.0)).unwrap();
    // 700 θ (1 + k1 θ² + ..) of 45°.
    let square = std::f64::consts::FRAC_PI_4.powi(2);
    let k = [1.0, -0.03, -0.005, -0.001, 0.0007];
    let radius = k.iter().rev().fold(0.0, |sum, k| sum * square + k) * square.sqrt();
    assert!((at.x - 640.0 - 700.0 * radius).abs() < 1e-6, "{at}");
    let k4 = real("cases/transforms_k4/ns_k4.json").unwrap();
    assert!(read_nerfstudio(&k4).unwrap_err().to_string().contains("frames[0].k4: is 0.02"));
    let timed = real("cases/transforms_time_us/tj_time.json").unwrap();
    let times_us: Vec<_> =
        read_nerfstudio(&timed).unwrap().frames.iter().map(|frame| frame.posed.time_us).collect();
    assert_eq!(times_us[..3], [Some(0), Some(500_000), Some(1_000_000)]);
    for model in ["SIMPLE_FISHEYE", "bin_fisheye"] {
        let file = if model == "bin_fisheye" { "cameras.bin" } else { "cameras.txt" };
        let path = real(&format!("cases/colmap_new_models/{model}/{file}")).unwrap();
        assert!(!read_colmap(path.parent().unwrap()).unwrap().is_empty());
    }
    let eucm = real("cases/colmap_new_models/EUCM/cameras.txt").unwrap();
    let text = read_colmap(eucm.parent().unwrap()).unwrap_err().to_string();
    assert!(text.contains("the camera model EUCM is not supported"), "{text}");
}
