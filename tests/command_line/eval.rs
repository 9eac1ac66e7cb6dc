//! `wildcity eval` on images that the program rendered itself, and that the tests then change.

use std::fs;
use std::path::Path;

use glam::{DMat3, DVec3};
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};

use crate::data::real;
use crate::in_folder::{done, refused};
use crate::scene_files::{gaussians, inria_columns, ply};

pub(crate) const WIDTH: u32 = 120;
pub(crate) const HEIGHT: u32 = 80;
/// The amount that is added to each value of the image `b`, of 255.
pub(crate) const OFF: u8 = 10;

/// Names, positions and the rows of `R_world_to_cam` of cameras that look at the origin, each
/// rolled a little.
fn cameras() -> Vec<(&'static str, DVec3, [DVec3; 3])> {
    let camera = |(index, name): (usize, &'static str)| {
        let turn = 0.7 * index as f64;
        let at = DVec3::new(4.0 * turn.cos(), -1.0 + 0.4 * turn, 4.0 * turn.sin());
        let z = -at.normalize();
        let x = DVec3::new(0.1 * turn, 1.0, 0.2).cross(z).normalize();
        (name, at, [x, z.cross(x), z])
    };
    ["a", "b", "c"].into_iter().enumerate().map(camera).collect()
}

/// A camera list, one camera per line. The lens is distorted.
fn list() -> String {
    let lines = cameras().into_iter().map(|(name, at, rows)| {
        let line = json!({"name": name, "image": format!("front/{name}.png"), "width": WIDTH, "height": HEIGHT,
            "fx": 90, "fy": 91, "cx": 60.5, "cy": 39, "lens": {"model": "opencv", "k": [-0.1, 0.02, 0, 0, 0, 0], "p": [0.001, 0]},
            "position": at.to_array(), "R_world_to_cam": rows.map(|row| row.to_array())});
        format!("{line}\n")
    });
    lines.collect()
}

/// The same cameras in OpenGL's axes.
fn transforms(more: &Value) -> String {
    let frames = cameras().into_iter().map(|(name, at, [x, y, z])| {
        let axes = DMat3::from_cols(x, -y, -z).transpose();
        let row = |k: usize| json!([axes.col(k).x, axes.col(k).y, axes.col(k).z, at[k]]);
        let mut frame = json!({"file_path": format!("front/{name}.png"),
            "transform_matrix": [row(0), row(1), row(2), [0, 0, 0, 1]]});
        frame.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        frame
    });
    json!({"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 90, "fl_y": 91, "cx": 60.5, "cy": 39,
        "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": 0, "frames": frames.collect::<Vec<_>>()})
    .to_string()
}

/// The same cameras as a COLMAP model.
fn write_colmap(dir: &Path) {
    fs::create_dir_all(dir).unwrap();
    let camera = format!("1 OPENCV {WIDTH} {HEIGHT} 90 91 60.5 39 -0.1 0.02 0.001 0\n");
    fs::write(dir.join("cameras.txt"), camera).unwrap();
    let images = cameras().into_iter().enumerate().map(|(index, (name, at, rows))| {
        let camera_from_world =
            DMat3::from_cols_array_2d(&rows.map(|row| row.to_array())).transpose();
        let q = glam::DQuat::from_mat3(&camera_from_world);
        let t = -(camera_from_world * at);
        let [id, w, x, y, z] = [index as f64 + 1.0, q.w, q.x, q.y, q.z];
        format!("{id} {w} {x} {y} {z} {} {} {} 1 front/{name}.png\n\n", t.x, t.y, t.z)
    });
    fs::write(dir.join("images.txt"), images.collect::<String>()).unwrap();
}

/// A scene, a camera list, and images that the program rendered; `b` is brighter by [`OFF`].
pub(crate) fn capture() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let mut scene = gaussians(300, 1, 1.5, 7);
    // Balls of 8 to 20 cm, not too bright: so an added OFF is not clamped.
    scene.ln_scales.iter_mut().for_each(|scales| *scales = scales.map(|s| -1.5 + s / 7.0));
    scene.sh.iter_mut().for_each(|value| *value *= 0.3);
    fs::write(at.join("scene.ply"), ply(&scene, &inria_columns(1, false))).unwrap();
    fs::write(at.join("views.jsonl"), list()).unwrap();
    done(
        at,
        &[
            "render",
            "scene.ply",
            "--cameras",
            "views.jsonl",
            "--out",
            "images/front",
            "--backend",
            "cpu",
        ],
    );
    let path = at.join("images/front/b.png");
    let mut image = image::open(&path).unwrap().into_rgb8();
    assert!(image.iter().all(|value| *value <= 255 - OFF), "an added {OFF} would be clamped");
    assert!(image.iter().filter(|value| **value > 40).count() > 2000, "there is little to see");
    image.iter_mut().for_each(|value| *value += OFF);
    image.save(&path).unwrap();
    dir
}

pub(crate) fn eval(dir: &Path, scene: &str, images: &str, more: &[&str]) -> (String, Value) {
    let fixed = [
        "eval",
        scene,
        "--images",
        images,
        "--image-dir",
        "images",
        "--out",
        "out",
        "--backend",
        "cpu",
    ];
    let said = done(dir, &[&fixed, more].concat());
    (said, serde_json::from_slice(&fs::read(dir.join("out/eval.json")).unwrap()).unwrap())
}

#[test]
fn an_image_that_was_spoiled_by_a_known_amount_has_that_error() {
    let dir = capture();
    let (said, made) =
        eval(dir.path(), "scene.ply", "views.jsonl", &["--align-exposure", "--show", "1"]);
    let off_db = 20.0 * (255.0 / f64::from(OFF)).log10();
    let images = made["images"].as_array().unwrap();
    assert_eq!(images.len(), 3);
    for (index, image) in images.iter().enumerate() {
        let name = ["a", "b", "c"][index];
        assert_eq!(
            (&image["name"], &image["camera"]),
            (&json!(format!("front/{name}.png")), &json!("front"))
        );
        assert!(image["covered"].as_f64().unwrap() > 0.05, "{image}");
        if name == "b" {
            assert!((image["psnr_db"].as_f64().unwrap() - off_db).abs() < 1e-9, "{image}");
            assert!((0.01..0.3).contains(&image["flip"].as_f64().unwrap()), "{image}");
            assert!(image["ssim"].as_f64().unwrap() < 0.999, "{image}");
            // The best change of exposure removes a constant.
            assert!(image["aligned"]["psnr_db"].as_f64().unwrap() > 200.0, "{image}");
            assert!((image["aligned"]["exposure"]["gain"][0].as_f64().unwrap() - 1.0).abs() < 1e-9);
        } else {
            assert_eq!(
                (&image["psnr_db"], &image["ssim"], &image["flip"]),
                (&json!("inf"), &json!(1.0), &json!(0.0))
            );
        }
    }
    // The mean of the images' values, and the pixels of all.
    assert_eq!(made["all"]["psnr_db"], "inf");
    let pooled_db = off_db + 10.0 * 3.0_f64.log10();
    assert!((made["all"]["pooled_psnr_db"].as_f64().unwrap() - pooled_db).abs() < 1e-9, "{made}");
    let mean =
        |name: &str| images.iter().map(|image| image[name].as_f64().unwrap()).sum::<f64>() / 3.0;
    for name in ["ssim", "ssim_mirrored", "flip"] {
        assert!((made["all"][name].as_f64().unwrap() - mean(name)).abs() < 1e-12, "{name}: {made}");
    }
    assert!(said.contains("mean of 3 images: PSNR infinite, SSIM 0.9"), "{said}");
    assert!(said.contains("worst: front/b.png, 28.13 dB"), "{said}");
    // The CSV has the same numbers, and the page the pictures of the worst image.
    let csv = fs::read_to_string(dir.path().join("out/eval.csv")).unwrap();
    let lines: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    let column = lines[0].iter().position(|name| *name == "psnr_db").unwrap();
    assert_eq!((lines.len(), lines[1][column], lines[2].len()), (4, "inf", lines[0].len()));
    assert_eq!(lines[2][column].parse(), Ok(images[1]["psnr_db"].as_f64().unwrap()));
    let page = fs::read_to_string(dir.path().join("out/report.html")).unwrap();
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 3, "one image, three pictures");
    assert!(page.contains("<b>front/b.png</b> 28.13 dB"), "the worst image is shown");
    let verdict = page.find("On average a rendered image has ").unwrap();
    assert!(verdict < page.find("<table").unwrap(), "the result is first");
    assert!(
        page.contains("; the worst is front/b.png with 28.13 dB"),
        "{}",
        &page[verdict..][..200]
    );
    for outside in ["src=\"http", "href=\"http", "<link", "<script", "@import"] {
        assert!(!page.contains(outside), "{outside}");
    }
}

#[test]
fn lists_nerfstudio_and_colmap_give_the_same() {
    let dir = capture();
    let at = dir.path();
    fs::write(at.join("transforms.json"), transforms(&json!({}))).unwrap();
    write_colmap(&at.join("sparse/0"));
    let images = |made: Value| made["images"].clone();
    let (_, list) = eval(at, "scene.ply", "views.jsonl", &[]);
    let (_, nerfstudio) = eval(at, "scene.ply", "transforms.json", &[]);
    let (_, colmap) = eval(at, "scene.ply", "sparse/0", &[]);
    // A pose that is written in other axes differs in its last bits, and so may a pixel by one of
    // 255.
    for other in [&nerfstudio, &colmap] {
        assert_eq!(other["images"].as_array().unwrap().len(), 3);
        for (image, listed) in
            other["images"].as_array().unwrap().iter().zip(list["images"].as_array().unwrap())
        {
            assert_eq!(image["name"], listed["name"]);
            let db = image["psnr_db"].as_f64().unwrap_or(f64::INFINITY);
            let least_db = listed["psnr_db"].as_f64().unwrap_or(60.0);
            assert!(db > least_db - 0.01, "{image} {listed}");
        }
    }
    // Without --image-dir, COLMAP's images are next to its model.
    done(at, &["eval", "scene.ply", "--images", "sparse/0", "--out", "beside", "--backend", "cpu"]);
    let beside: Value =
        serde_json::from_slice(&fs::read(at.join("beside/eval.json")).unwrap()).unwrap();
    assert_eq!(images(beside), images(colmap));
    // Every second image in the order of the names.
    let (said, _) = eval(at, "scene.ply", "transforms.json", &["--every", "2"]);
    assert!(
        said.contains("mean of 2 images: PSNR infinite") || said.contains("worst: front/a.png"),
        "{said}"
    );
    assert!(!said.contains("front/b.png"), "{said}");
}

#[test]
fn a_twin_has_the_axes_and_the_unit_of_its_import() {
    let dir = capture();
    let at = dir.path();
    fs::write(at.join("transforms.json"), transforms(&json!({}))).unwrap();
    done(
        at,
        &[
            "import",
            "scene.ply",
            "--twin",
            "street",
            "--axes",
            "y-down-z-forward",
            "--scale",
            "2",
            "--record",
            "f32",
        ],
    );
    let (_, made) = eval(at, "street", "transforms.json", &["--set", "tau_px=0"]);
    assert_eq!(made["subject"]["version"], 1);
    for image in made["images"].as_array().unwrap() {
        let least_db = if image["name"] == "front/b.png" { 28.0 } else { 50.0 };
        assert!(image["psnr_db"].as_f64().unwrap_or(f64::INFINITY) > least_db, "{image}");
    }
    // The poses of a list are in the axes of the twin: there these cameras look elsewhere.
    let (_, list) = eval(at, "street", "views.jsonl", &[]);
    assert!(list["images"][0]["psnr_db"].as_f64().unwrap() < 30.0, "{list}");
    let (_, list) = eval(
        at,
        "street",
        "views.jsonl",
        &["--axes", "y-down-z-forward", "--scale", "2", "--set", "tau_px=0"],
    );
    assert!(list["images"][0]["psnr_db"].as_f64().unwrap_or(f64::INFINITY) > 50.0, "{list}");
}

#[test]
fn masked_pixels_do_not_count_and_smaller_images_scale_their_cameras() {
    let dir = capture();
    let at = dir.path();
    // `b` is changed in its left half only; masks hide that half.
    let path = at.join("images/front/b.png");
    let mut image = image::open(&path).unwrap().into_rgb8();
    for (x, _, pixel) in image.enumerate_pixels_mut() {
        *pixel =
            if x < WIDTH / 2 { Rgb([255, 0, 255]) } else { Rgb(pixel.0.map(|value| value - OFF)) };
    }
    image.save(&path).unwrap();
    fs::create_dir_all(at.join("masks/front")).unwrap();
    let mask =
        GrayImage::from_fn(WIDTH, HEIGHT, |x, _| Luma([if x < WIDTH / 2 { 0 } else { 255 }]));
    for name in ["a.png", "b.png.png", "c.png"] {
        mask.save(at.join("masks/front").join(name)).unwrap();
    }
    let (_, made) = eval(at, "scene.ply", "views.jsonl", &["--masks", "masks"]);
    for image in made["images"].as_array().unwrap() {
        let numbers = [&image["psnr_db"], &image["ssim"], &image["flip"], &image["counted"]];
        assert_eq!(numbers, [&json!("inf"), &json!(1.0), &json!(0.0), &json!(0.5)]);
    }
    // Names of transforms.json start with the folder of the images; masks need not be in a folder
    // of that name.
    let frames = transforms(&json!({})).replace("front/", "images/front/");
    fs::write(at.join("transforms.json"), frames).unwrap();
    mask.save(at.join("masks/front/b.png")).unwrap();
    let beside = ["eval", "scene.ply", "--images", "transforms.json", "--masks", "masks"];
    done(at, &[&beside[..], &["--out", "out", "--backend", "cpu"]].concat());
    let made: Value = serde_json::from_slice(&fs::read(at.join("out/eval.json")).unwrap()).unwrap();
    for image in made["images"].as_array().unwrap() {
        assert_eq!(image["counted"], json!(0.5), "{image}");
    }
    // transforms.json names masks in its own folder.
    mask.save(at.join("images/mask.png")).unwrap();
    fs::write(at.join("images/transforms.json"), transforms(&json!({"mask_path": "mask.png"})))
        .unwrap();
    done(
        at,
        &[
            "eval",
            "scene.ply",
            "--images",
            "images",
            "--out",
            "out",
            "--backend",
            "cpu",
            "--save-images",
        ],
    );
    let made: Value = serde_json::from_slice(&fs::read(at.join("out/eval.json")).unwrap()).unwrap();
    assert!(made["images"][1]["psnr_db"].as_f64().unwrap_or(f64::INFINITY) > 60.0, "{made}");
    let saved: RgbImage = image::open(at.join("out/rendered/front/a.png")).unwrap().into_rgb8();
    assert_eq!(saved.dimensions(), (WIDTH, HEIGHT));
    assert!(at.join("out/errors/front/b.png").is_file());

    // Images of half the size: the cameras are scaled, and the images of that size are close.
    fs::create_dir_all(at.join("images_2/front")).unwrap();
    for name in ["a", "b", "c"] {
        let image = image::open(at.join(format!("images/front/{name}.png"))).unwrap().into_rgb8();
        let half = image::imageops::resize(
            &image,
            WIDTH / 2,
            HEIGHT / 2,
            image::imageops::FilterType::Triangle,
        );
        half.save(at.join(format!("images_2/front/{name}.png"))).unwrap();
    }
    let half = [
        "eval",
        "scene.ply",
        "--images",
        "views.jsonl",
        "--image-dir",
        "images_2",
        "--backend",
        "cpu",
    ];
    done(at, &[&half[..], &["--out", "half"]].concat());
    let made: Value =
        serde_json::from_slice(&fs::read(at.join("half/eval.json")).unwrap()).unwrap();
    assert_eq!(made["images"][0]["size_px"], json!([WIDTH / 2, HEIGHT / 2]));
    assert!(made["images"][0]["psnr_db"].as_f64().unwrap() > 20.0, "{made}");
}

#[test]
fn what_is_missing_or_of_another_size_is_named() {
    let dir = capture();
    let at = dir.path();
    let images =
        ["eval", "scene.ply", "--images", "views.jsonl", "--out", "out", "--backend", "cpu"];
    let said = refused(at, &images);
    assert!(
        said.contains("there is no image front/a.png") && said.contains("--image-dir"),
        "{said}"
    );
    let images = [&images[..], &["--image-dir", "images"]].concat();
    let said = refused(at, &[&images[..], &["--masks", "masks"]].concat());
    assert!(
        said.contains("there is no mask masks/front/a.png, nor masks/front/a.png.png"),
        "{said}"
    );
    fs::create_dir_all(at.join("masks/front")).unwrap();
    for name in ["a", "b", "c"] {
        GrayImage::new(5, 5).save(at.join(format!("masks/front/{name}.png"))).unwrap();
    }
    let said = refused(at, &[&images[..], &["--masks", "masks"]].concat());
    assert!(
        said.contains("image front/a.png: the mask") && said.contains("has 5 x 5 px"),
        "{said}"
    );
    RgbImage::new(WIDTH, HEIGHT / 2).save(at.join("images/front/c.png")).unwrap();
    let said = refused(at, &images);
    assert!(
        said.contains("image front/c.png") && said.contains("120 x 40 px, but its camera 120 x 80"),
        "{said}"
    );
    fs::write(at.join("images/front/c.png"), "no picture").unwrap();
    assert!(
        refused(at, &images).contains("cannot read images/front/c.png"),
        "{}",
        refused(at, &images)
    );
    let said = refused(at, &["eval", "scene.ply", "--images", "nothing.json"]);
    assert!(said.contains("--images nothing.json"), "{said}");
}

/// The only image of a real capture that is not ours: by another renderer, in f64. No photograph
/// with its camera is in the data.
#[test]
fn another_programs_image_of_a_real_capture_is_met() {
    let Some(scene) = real("scenes/skull/skull.ply") else { return };
    let Some(camera) = real("reference/skull_front.camera.json") else { return };
    let Some(image) = real("reference/skull_front.oracle.png") else { return };
    let dir = tempfile::tempdir().unwrap();
    let mut listed: Value = serde_json::from_slice(&fs::read(camera).unwrap()).unwrap();
    listed["image"] = json!("skull_front.oracle.png");
    fs::write(dir.path().join("front.json"), listed.to_string()).unwrap();
    let folder = image.parent().unwrap().to_str().unwrap();
    let scene = scene.to_str().unwrap();
    let arguments = [
        "eval",
        scene,
        "--images",
        "front.json",
        "--image-dir",
        folder,
        "--out",
        "out",
        "--backend",
        "cpu",
    ];
    done(dir.path(), &[&arguments[..], &["--set", "alpha_cap=0.999"]].concat());
    let made: Value =
        serde_json::from_slice(&fs::read(dir.path().join("out/eval.json")).unwrap()).unwrap();
    // Both round to 8 bits, and differ in a few values by one.
    let image = &made["images"][0];
    assert!(image["psnr_db"].as_f64().unwrap() > 55.0, "{image}");
    assert!(
        image["ssim"].as_f64().unwrap() > 0.999 && image["flip"].as_f64().unwrap() < 0.01,
        "{image}"
    );
}

#[test]
fn an_image_whose_exposure_is_known_is_compared_in_it() {
    let dir = capture();
    let at = dir.path();
    let path = at.join("images/front/a.png");
    let mut image = image::open(&path).unwrap().into_rgb8();
    wildcity_scene::srgb::change_stops(&mut image, -1.0);
    image.save(&path).unwrap();
    let db = |images: &str| {
        let (_, made) = eval(at, "scene.ply", images, &[]);
        made["images"][0]["psnr_db"].clone()
    };
    assert!(db("views.jsonl").as_f64().unwrap() < 30.0);
    let list = fs::read_to_string(at.join("views.jsonl")).unwrap();
    let known = list.replacen("{", "{\"exposure_stops\": -1, ", 1);
    fs::write(at.join("known.jsonl"), known).unwrap();
    assert_eq!(db("known.jsonl"), "inf");
    let frames = transforms(&json!({"exposure_stops": -1}));
    fs::write(at.join("transforms.json"), frames).unwrap();
    // The poses of the two lists differ in their last bits.
    let frames_db = db("transforms.json");
    assert!(frames_db == "inf" || frames_db.as_f64().unwrap() > 50.0, "{frames_db}");
    let frames = transforms(&json!({"exposure_stops": -17}));
    fs::write(at.join("transforms.json"), frames).unwrap();
    let said = refused(at, &["eval", "scene.ply", "--images", "transforms.json"]);
    assert!(said.contains("frames[0].exposure_stops: -17; give -16 to 16"), "{said}");
}
