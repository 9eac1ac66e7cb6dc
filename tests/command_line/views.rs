//! `wildcity twin views`.

use std::fs;
use std::path::Path;

use glam::DVec3;
use image::{Rgb, RgbImage};
use serde_json::json;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::Keyframe;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::in_folder::{done, refused};
use crate::scene_files::gaussians;

const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// Images every 0.5 m along x, of 200 x 100 px, each of one grey, and their camera list.
fn capture(dir: &Path) {
    fs::create_dir(dir.join("images")).unwrap();
    let mut lines = String::new();
    for at in 0..21_u8 {
        let name = format!("images/Front-{at:03}.png");
        RgbImage::from_pixel(200, 100, Rgb([10 * at; 3])).save(dir.join(&name)).unwrap();
        let line = json!({"name": format!("f{at}"), "image": name, "width": 200, "height": 100, "fx": 150,
            "fy": 150, "cx": 100, "cy": 50, "position": [0.5 * f64::from(at), 1.0, 2.0], "R_world_to_cam": IDENTITY});
        lines += &format!("{line}\n");
    }
    fs::write(dir.join("list.jsonl"), lines).unwrap();
}

#[test]
fn images_are_stored_scaled_along_the_drive_and_removed() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    capture(at);
    let catalog = Catalog::open(&at.join("twins")).unwrap();
    let scene = gaussians(100, 0, 10.0, 1);
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose { position_m: DVec3::X * i as f64, ..Pose::IDENTITY },
    };
    let log = Trajectory { name: "log".to_owned(), keyframes: (-3..20).map(keyframe).collect() };
    let new = |name, trajectories| NewVersion {
        trajectories,
        ..NewVersion::from_gaussians(name, &scene, Provenance::new("test".to_owned()))
    };
    catalog.commit(new("street", vec![log]), &mut |_, _| {}).unwrap();
    catalog.commit(new("bare", Vec::new()), &mut |_, _| {}).unwrap();
    let views = |twin: &'static str| {
        ["twin", "views", twin, "--twins", "twins", "--images", "list.jsonl", "--every", "2m"]
    };
    let said = done(at, &[&views("street")[..], &["--side", "100"]].concat());
    assert!(said.starts_with("twin street version 2: 6 recorded images of 0.0 MB"), "{said}");
    let far = [&views("street")[..], &["--axes", "identity", "--scale", "1000"]].concat();
    let said = refused(at, &far);
    assert!(said.contains("m or more from the drives") && said.contains("--scale"), "{said}");

    let version = catalog.version("street", None).unwrap();
    let stored = catalog.views(&version).unwrap();
    assert_eq!(stored.len(), 6);
    for (index, view) in stored.iter().enumerate() {
        // The drive starts 3 m before the first image.
        assert!((view.station_m - (3.0 + 2.0 * index as f64)).abs() < 1e-9, "{view:?}");
        assert_eq!((&*view.trajectory, &*view.camera_name), ("log", "front"));
        let camera = &view.camera;
        assert_eq!([camera.width_px, camera.height_px], [100, 50]);
        assert_eq!((camera.pinhole.fx, camera.pinhole.cy), (75.0, 25.0));
        let position_m = DVec3::new(2.0 * index as f64, 1.0, 2.0);
        assert!(view.world_from_camera.position_m.distance(position_m) < 1e-9);
        let bytes = catalog.view_image(&version, view).unwrap();
        let image = image::load_from_memory(&bytes).unwrap().into_rgb8();
        assert_eq!(image.dimensions(), (100, 50));
        let grey = 40 * index as u8;
        assert!(image.iter().all(|value| value.abs_diff(grey) <= 3), "{index}");
    }
    assert!(stored.iter().all(|view| view.mask.is_none() && view.exposure_stops.is_none()));
    let said = done(at, &["twin", "show", "street", "--twins", "twins"]);
    assert!(said.contains("views       6 recorded images"), "{said}");

    let said = refused(at, &views("bare"));
    assert!(said.contains("no recorded drive") && said.contains("wildcity twin drive"), "{said}");
    let said = done(at, &["twin", "views", "street", "--twins", "twins", "--remove"]);
    assert!(said.starts_with("twin street version 3: no recorded images"), "{said}");
    assert_eq!(catalog.version("street", None).unwrap().manifest.views, None);
}

#[test]
fn masks_and_exposures_of_the_list_are_stored_and_a_bend_leaves_no_gap() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    capture(at);
    // The first row of the first image's mask is black; the second image is brighter.
    let mut mask = RgbImage::from_pixel(200, 100, Rgb([255; 3]));
    (0..200).for_each(|column| mask.put_pixel(column, 0, Rgb([0; 3])));
    mask.save(at.join("mask.png")).unwrap();
    RgbImage::from_pixel(200, 100, Rgb([255; 3])).save(at.join("white.png")).unwrap();
    let text = fs::read_to_string(at.join("list.jsonl")).unwrap();
    let lines = text.lines().enumerate().map(|(index, line)| {
        let mut camera: serde_json::Value = serde_json::from_str(line).unwrap();
        camera["mask"] = json!(if index == 0 { "mask.png" } else { "white.png" });
        if index == 4 {
            camera["exposure_stops"] = json!(1.25);
        }
        // 1.95 m apart along the drive, as in a bend.
        camera["position"][0] = json!(0.4875 * index as f64);
        format!("{camera}\n")
    });
    fs::write(at.join("list.jsonl"), lines.collect::<String>()).unwrap();
    let catalog = Catalog::open(&at.join("twins")).unwrap();
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose { position_m: DVec3::X * i as f64, ..Pose::IDENTITY },
    };
    let log = Trajectory { name: "log".to_owned(), keyframes: (0..20).map(keyframe).collect() };
    let scene = gaussians(100, 0, 10.0, 1);
    let street = NewVersion {
        trajectories: vec![log],
        ..NewVersion::from_gaussians("street", &scene, Provenance::new("test".to_owned()))
    };
    catalog.commit(street, &mut |_, _| {}).unwrap();
    let views = ["twin", "views", "street", "--twins", "twins", "--images", "list.jsonl"];
    done(at, &[&views[..], &["--every", "2m", "--side", "100"]].concat());
    let version = catalog.version("street", None).unwrap();
    let stored = catalog.views(&version).unwrap();
    assert_eq!(stored.len(), 6, "{stored:?}");
    let stops: Vec<Option<f64>> = stored.iter().map(|view| view.exposure_stops).collect();
    assert_eq!(stops, [None, Some(1.25), None, None, None, None]);
    assert!(stored[1..].iter().all(|view| view.mask.is_none()), "all pixels count");
    let bytes = catalog.view_mask(&version, &stored[0]).unwrap().unwrap();
    let mask = image::load_from_memory(&bytes).unwrap().into_luma8();
    assert_eq!(mask.dimensions(), (100, 50));
    let dark = mask.enumerate_pixels().filter(|(_, _, value)| value.0[0] < 128);
    let rows: Vec<u32> = dark.map(|(_, row, _)| row).collect();
    // Shrinking to a half brings three rows of the stored image in touch with it.
    assert_eq!(rows, [[0; 100], [1; 100], [2; 100]].concat());

    let text = fs::read_to_string(at.join("list.jsonl")).unwrap();
    fs::write(at.join("list.jsonl"), text.replace("1.25", "125")).unwrap();
    let said = refused(at, &views);
    assert!(said.contains("exposure_stops is 125; give -16 to 16"), "{said}");
}
