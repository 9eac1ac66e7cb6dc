//! `wildcity eval` with models, networks, boxes and LiDAR, and off the drive.

use std::fs;
use std::path::Path;

use glam::DVec3;
use safetensors::Dtype;
use safetensors::tensor::{TensorView, serialize};
use serde_json::{Value, json};
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::Keyframe;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::eval::{HEIGHT, OFF, WIDTH, capture, eval};
use crate::in_folder::{done, refused};
use crate::onnx_doubles::{arithmetic, distance, mean_color, warped_where_valid};
use crate::onnx_models::{Folder, library};
use crate::scene_files::gaussians;

const IMAGES: [&str; 6] = ["--images", "views.jsonl", "--image-dir", "images", "--backend", "cpu"];

/// The manifest of a network that measures images.
fn network(onnx: &[u8], inputs: Value, output: &str) -> Folder {
    let mut folder = Folder::new(onnx, json!({}));
    let files = folder.manifest["files"].clone();
    folder.manifest = json!({
        "format": "wildcity.network/1", "name": "measure", "version": "2", "licence": "MIT", "files": files,
        "providers": ["cpu"], "timeout_ms": 60_000, "inputs": inputs, "output": output,
    });
    folder
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The list with a time of each image.
fn add_times(dir: &Path) {
    let text = fs::read_to_string(dir.join("views.jsonl")).unwrap();
    let timed = text.lines().enumerate().map(|(at, line)| {
        let mut camera: Value = serde_json::from_str(line).unwrap();
        camera["time_us"] = json!(100_000 * at);
        format!("{camera}\n")
    });
    fs::write(dir.join("views.jsonl"), timed.collect::<String>()).unwrap();
}

#[test]
fn a_model_that_brightens_mends_the_image_that_is_brighter() {
    let dir = capture();
    let at = dir.path();
    let range = json!([{"name": "image", "role": "rgb", "range": [0, 255]}]);
    let changes = json!({"inputs": range, "outputs": [{"name": "repaired", "role": "rgb", "range": [0, 255]}]});
    let folder = Folder::new(&arithmetic("Add", OFF.into()), changes);
    let [library, model] = [library(), folder.path()].map(|path| path.to_str().unwrap().to_owned());
    let with = ["--repair", &model, "--onnxruntime", &library, "--save-images"];
    let (said, made) = eval(at, "scene.ply", "views.jsonl", &with);
    let off_db = 20.0 * (255.0 / f64::from(OFF)).log10();
    for (index, image) in made["images"].as_array().unwrap().iter().enumerate() {
        let [before, after] = [&image["psnr_db"], &image["repaired"]["psnr_db"]];
        let [exact, off] = if index == 1 { [after, before] } else { [before, after] };
        assert_eq!(exact, "inf", "{image}");
        assert!((number(off) - off_db).abs() < 0.01, "{image}");
    }
    assert_eq!(made["subject"]["repair"]["model"], "double");
    let gain = number(&made["all"]["gain"]["flip"]);
    let flip = |of: &Value| number(&of["flip"]);
    assert!((gain - (flip(&made["all"]["repaired"]) - flip(&made["all"]))).abs() < 1e-12);
    assert!(gain > 0.01, "{gain}");
    assert!(said.contains("repaired: PSNR") && said.contains("gain: "), "{said}");
    assert!(at.join("out/repaired/front/b.png").is_file());
    let csv = fs::read_to_string(at.join("out/eval.csv")).unwrap();
    let lines: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    let column = lines[0].iter().position(|name| *name == "repaired_psnr_db").unwrap();
    assert_eq!((lines[2][column], lines[0].len()), ("inf", lines[2].len()));
    let page = fs::read_to_string(at.join("out/report.html")).unwrap();
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 3 * 5);

    // A model that compares with recorded images needs a twin with some.
    let inputs = json!([{"name": "image", "role": "rgb"}, {"name": "warped", "role": "reference_warped"},
        {"name": "valid", "role": "reference_valid"}]);
    let folder = Folder::new(&warped_where_valid(), json!({"inputs": inputs}));
    let model = folder.path().to_str().unwrap().to_owned();
    let arguments = [&["eval", "scene.ply"][..], &IMAGES, &["--repair", &model]].concat();
    let said = refused(at, &[&arguments[..], &["--onnxruntime", &library]].concat());
    assert!(
        said.contains("images of a recorded drive, which a scene file does not have"),
        "{said}"
    );
}

#[test]
fn networks_measure_what_counts() {
    let dir = capture();
    let at = dir.path();
    let port = |name: &str, role: &str| json!({"name": name, "role": role});
    let inputs = json!([port("image", "image"), port("truth", "truth")]);
    let lpips = network(&distance(), inputs, "distance");
    let features = network(&mean_color(), json!([port("image", "image")]), "features");
    let paths = [library(), lpips.path(), features.path()];
    let [library, lpips, features] = paths.map(|path| path.to_str().unwrap().to_owned());
    let with = ["--lpips", &lpips, "--features", &features, "--onnxruntime", &library];
    let (said, made) = eval(at, "scene.ply", "views.jsonl", &with);
    // Values from -1 to 1.
    let wanted = 2.0 * f64::from(OFF) / 255.0;
    let images = made["images"].as_array().unwrap();
    assert!((number(&images[1]["lpips"]) - wanted).abs() < 1e-6, "{made}");
    assert_eq!(number(&images[0]["lpips"]), 0.0);
    assert!((number(&made["all"]["lpips"]) - wanted / 3.0).abs() < 1e-6, "{made}");
    assert_eq!(made["subject"]["lpips_network"], "measure 2");
    assert!(
        made["kid"]["rendered"]["mean"].is_number() && said.contains("KID by measure 2"),
        "{said}"
    );
    assert_eq!(
        (&made["kid"]["rendered"]["subsets"], &made["kid"]["rendered"]["subset_size"]),
        (&json!(1), &json!(3))
    );
    // A network of the other kind.
    let arguments = [&["eval", "scene.ply"][..], &IMAGES, &["--lpips", &features]].concat();
    let said = refused(at, &[&arguments[..], &["--onnxruntime", &library]].concat());
    assert!(
        said.contains("--lpips takes a network with the roles \"image\" and \"truth\""),
        "{said}"
    );
    let said =
        refused(at, &[&["eval", "scene.ply"][..], &IMAGES, &["--lpips", "none.json"]].concat());
    assert!(said.contains("--lpips none.json") && said.contains("No such file"), "{said}");
}

#[test]
fn boxes_hide_what_moves_and_lidar_measures_depth() {
    let dir = capture();
    let at = dir.path();
    let boxes = |more: Value| {
        let mut line = json!({"time_us": 100_000, "track": "car", "size": [1, 1, 1],
            "world_from_box": {"xyz": [0, 0, 0], "q": [1, 0, 0, 0]}});
        line.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        fs::write(at.join("boxes.jsonl"), format!("{line}\n")).unwrap();
    };
    boxes(json!({"velocity": [2, 0, 0]}));
    let arguments = [&["eval", "scene.ply"][..], &IMAGES, &["--boxes", "boxes.jsonl"]].concat();
    let said = refused(at, &arguments);
    assert!(said.contains("--boxes: image front/a.png has no time"), "{said}");
    add_times(at);
    let with = ["--boxes", "boxes.jsonl", "--save-images"];
    let (_, made) = eval(at, "scene.ply", "views.jsonl", &with);
    let images = made["images"].as_array().unwrap();
    for image in images {
        // A metre at 4 m and 90 px per unit: some 22 px of 120 x 80, grown by 3 px, and more at an
        // angle.
        let moving = number(&image["moving"]);
        assert!((0.05..0.25).contains(&moving), "{image}");
        assert!((number(&image["counted"]) - (1.0 - moving)).abs() < 1e-9, "{image}");
    }
    let mask = image::open(at.join("out/masks/front/b.png")).unwrap().into_luma8();
    assert_eq!(
        (mask.dimensions(), mask.get_pixel(60, 39).0, mask.get_pixel(2, 2).0),
        ((WIDTH, HEIGHT), [0], [255])
    );
    boxes(json!({"velocity": [0.5, 0, 0]}));
    let (_, made) = eval(at, "scene.ply", "views.jsonl", &with);
    assert_eq!(made["images"][1]["moving"], 0.0);

    // A point in the middle of the scene at the time of each image, and one in a gap of the poses.
    let bytes =
        |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let times =
        |values: &[i64]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let wide =
        |values: &[f64]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let point_times = times(&[0, 100_000, 200_000, 900_000]);
    let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let poses = wide(&[identity; 3].concat());
    let pose_times = times(&[0, 200_000, 1_000_000]);
    let with_points = |coordinates_m: [f32; 12]| {
        let points = bytes(&coordinates_m);
        let tensors = [
            ("points_m", TensorView::new(Dtype::F32, vec![4, 3], &points).unwrap()),
            ("time_us", TensorView::new(Dtype::I64, vec![4], &point_times).unwrap()),
            ("pose_time_us", TensorView::new(Dtype::I64, vec![3], &pose_times).unwrap()),
            ("world_from_rig", TensorView::new(Dtype::F64, vec![3, 4, 4], &poses).unwrap()),
        ];
        fs::write(at.join("lidar.safetensors"), serialize(tensors, None).unwrap()).unwrap();
        eval(at, "scene.ply", "views.jsonl", &["--lidar", "lidar.safetensors"])
    };
    let (said, made) = with_points([0.0; 12]);
    assert_eq!(
        made["subject"]["lidar"],
        json!({"file": "lidar.safetensors", "points": 3, "left_out": 1})
    );
    assert!(said.contains("1 LiDAR points were left out"), "{said}");
    let lidar = |image: &Value| image["lidar"].clone();
    let found: Vec<Value> = made["images"].as_array().unwrap().iter().map(lidar).collect();
    let seen: Vec<&Value> = found.iter().filter(|lidar| lidar["points"] == 1).collect();
    // Where the scene is opaque. It is a ball of about 1.5 m around the point.
    assert!(found.len() == 3 && !seen.is_empty(), "{found:?}");
    assert!(seen.iter().all(|lidar| number(&lidar["mean_m"]) < 3.0), "{found:?}");

    // Points that no image sees are reported, and not the mean of an empty set.
    let (said, made) = with_points([500.0; 12]);
    assert!(said.contains("no LiDAR point was compared") && !said.contains("NaN"), "{said}");
    let page = fs::read_to_string(at.join("out/report.html")).unwrap();
    assert!(page.contains("no LiDAR point was compared"));
    assert_eq!(made["all"]["lidar"]["points"], 0);
}

#[test]
fn views_beside_the_drive_are_told_without_a_real_image() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let mut scene = gaussians(3000, 0, 6.0, 1);
    scene.ln_scales.iter_mut().for_each(|scales| *scales = scales.map(|s| -1.2 + s / 7.0));
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose { position_m: DVec3::X * (i as f64 - 8.0), ..Pose::IDENTITY },
    };
    let log = Trajectory { name: "log".to_owned(), keyframes: (0..16).map(keyframe).collect() };
    let catalog = Catalog::open(&at.join("twins")).unwrap();
    let new = |name, trajectories| NewVersion {
        trajectories,
        ..NewVersion::from_gaussians(name, &scene, Provenance::new("test".to_owned()))
    };
    catalog.commit(new("street", vec![log]), &mut |_, _| {}).unwrap();
    catalog.commit(new("bare", Vec::new()), &mut |_, _| {}).unwrap();
    // Along x of the world: z of the camera.
    let rows = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]];
    let lines = (0..3).map(|at| {
        let line = json!({"name": format!("v{at}"), "image": format!("v{at}.png"), "width": 96, "height": 64, "fx": 70,
            "fy": 70, "cx": 48, "cy": 32, "position": [f64::from(at) - 7.0, 0, 0], "R_world_to_cam": rows});
        format!("{line}\n")
    });
    fs::write(at.join("views.jsonl"), lines.collect::<String>()).unwrap();
    let render =
        ["render", "street", "--cameras", "views.jsonl", "--out", "images", "--backend", "cpu"];
    done(at, &[&render[..], &["--twins", "twins"]].concat());
    let inputs = json!([{"name": "image", "role": "rgb"}, {"name": "warped", "role": "reference_warped"},
        {"name": "valid", "role": "reference_valid"}]);
    let model = Folder::new(&warped_where_valid(), json!({"inputs": inputs}));
    let [library, model] = [library(), model.path()].map(|path| path.to_str().unwrap().to_owned());
    // References of a twin without recorded images are drawn with its rig.
    let with_model = ["--repair", &model, "--onnxruntime", &library];
    let street = [&["eval", "street"][..], &IMAGES, &["--twins", "twins"]].concat();
    let said = refused(at, &[&street[..], &with_model].concat());
    assert!(said.contains("images of a recorded drive, and the twin has none"), "{said}");

    let views = [
        "twin",
        "views",
        "street",
        "--twins",
        "twins",
        "--images",
        "views.jsonl",
        "--every",
        "0.5",
    ];
    done(at, &[&views[..], &["--image-dir", "images"]].concat());
    let held_out = ["--every", "2", "--extrapolate", "0.5,-2", "--out", "out"];
    let said = done(at, &[&street[..], &held_out, &with_model].concat());
    assert!(said.contains("0.5 m beside the drive: trust 0."), "{said}");
    let made: Value = serde_json::from_slice(&fs::read(at.join("out/eval.json")).unwrap()).unwrap();
    let repair = &made["subject"]["repair"];
    assert_eq!((&repair["references"], &repair["left_out"]), (&json!("recorded"), &json!(2)));
    let beside = made["extrapolation"].as_array().unwrap();
    assert_eq!((beside.len(), beside[0]["views"].as_array().unwrap().len()), (2, 2));
    let trust = |one: &Value| number(&one["trust"]);
    // exp(-0.5 / 5) and exp(-2 / 5), times shares of at most 1.
    assert!(trust(&beside[0]) <= 0.905 && trust(&beside[1]) <= 0.671, "{beside:?}");
    for (one, least_share) in beside.iter().zip([0.02, 0.005]) {
        for of in [&one["rendered"], &one["repaired"]] {
            let share = number(&of["reprojection_share"]);
            assert!((least_share..1.0).contains(&share), "{one}");
            assert!((10.0..60.0).contains(&number(&of["reprojection_psnr_db"])), "{one}");
            assert!((1e-4..0.3).contains(&number(&of["flicker"])), "{one}");
        }
        let ratio = number(&one["repaired"]["flicker"]) / number(&one["rendered"]["flicker"]);
        assert!((number(&one["flicker_ratio"]) - ratio).abs() < 1e-9, "{one}");
    }
    let share = |one: &Value| number(&one["rendered"]["reprojection_share"]);
    assert!(share(&beside[0]) > share(&beside[1]), "{beside:?}");
    let page = fs::read_to_string(at.join("out/report.html")).unwrap();
    assert!(page.contains("Beside the drive") && page.contains("alt=\"brought back\""));

    let bare =
        [&["eval", "bare"][..], &IMAGES, &["--twins", "twins", "--extrapolate", "1"]].concat();
    let said = refused(at, &bare);
    assert!(said.contains("need a twin with a recorded drive"), "{said}");
}
