//! `wildcity twin rig`: every preset is shown, drawn, and checked.

use std::process::{Command, Output};

use wildcity_render::compare::reprojection::ReprojectionErrors;
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, View};
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;

use crate::images::cpu;

fn wildcity(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["twin", "rig"])
        .args(arguments)
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned()
}

#[test]
fn presets_are_shown_checked_and_drawn() {
    let dir = tempfile::tempdir().unwrap();
    let names = said(&wildcity(&["show"]));
    for name in Rig::preset_names() {
        assert!(names.lines().any(|line| line == name), "{names}");
        let Rig { cameras, lidars, .. } = Rig::preset(name).unwrap();
        let shown = said(&wildcity(&["show", name]));
        assert_eq!(shown.lines().count(), cameras.len() + lidars.len() + 2, "{shown}");
        let checked = wildcity(&["check", name, "--backend", "cpu"]);
        assert!(checked.status.success(), "{}", said(&checked));
        assert_eq!(said(&checked).lines().count(), cameras.len());
        let picture = dir.path().join("rig.svg");
        let drawn = wildcity(&["draw", name, "--out", picture.to_str().unwrap()]);
        assert!(drawn.status.success(), "{}", said(&drawn));
        let svg = std::fs::read_to_string(&picture).unwrap();
        assert!(svg.starts_with("<svg"), "{svg}");
        let cameras = cameras.into_iter().map(|camera| camera.name);
        for sensor in cameras.chain(lidars.into_iter().map(|lidar| lidar.name)) {
            assert!(svg.contains(&sensor), "{sensor} is not in the picture");
        }
    }
}

#[test]
fn the_surround_rig_looks_all_around() {
    let shown = said(&wildcity(&["show", "surround6"]));
    let yaw_of = |name: &str| {
        let line = shown.lines().find(|line| line.split_whitespace().nth(1) == Some(name));
        line.unwrap().split_whitespace().rev().nth(1).unwrap().parse::<f64>().unwrap()
    };
    assert!(!shown.contains(" -0.0"), "{shown}");
    for (name, yaw_deg) in [("front", 0.0), ("front_left", 55.0), ("back_right", -110.0)] {
        assert!((yaw_of(name) - yaw_deg).abs() < 0.06, "{name}: {shown}");
    }
}

#[test]
fn invalid_rigs_are_refused() {
    let unknown = wildcity(&["check", "vehicle7"]);
    assert_eq!(unknown.status.code(), Some(1));
    let text = said(&unknown);
    assert!(text.contains("neither a file nor a preset") && text.contains("vehicle6"), "{text}");
}

/// The f-theta cameras of a real car, at full size and at the size that a driving model reads.
#[test]
fn points_are_reprojected_through_the_lenses_of_a_real_car() {
    let cpu = cpu();
    for mounted in Rig::preset("alpamayo2").unwrap().cameras {
        let full = mounted.camera;
        let small = full.scaled(576, 320).unwrap();
        for (backend, camera) in [(&cpu as &dyn Backend, full), (&cpu, small), (&Reference, small)]
        {
            let view = View::new(camera, Pose::IDENTITY);
            let ReprojectionErrors { count, worst_px } =
                ReprojectionErrors::measure(backend, &view).unwrap();
            let (name, width, drawn_by) = (&mounted.name, camera.width_px, backend.name());
            eprintln!("{name}, {width} px wide, {drawn_by}: {worst_px:.3} px");
            assert!(count > 20 && worst_px < 0.1, "{name}: {count} points, {worst_px} px");
        }
    }
}

#[test]
fn a_camera_with_reprojection_errors_fails_the_check() {
    // A view all around on 48 x 32 px: the lens distorts the image of a point, so that its centroid
    // is off.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rig.json");
    let place = r#""camera_to_rig": {"xyz": [0, 0, 1.5], "q": [0.5, -0.5, 0.5, -0.5]}"#;
    let coarse = r#""width": 48, "height": 32, "fx": 8, "fy": 8, "cx": 24, "cy": 16,
        "lens": {"model": "fisheye", "k": [0, 0, 0, 0], "max_angle": 2.8}"#;
    let fine = r#""width": 160, "height": 100, "fx": 90, "fy": 90, "cx": 80, "cy": 50"#;
    let cameras = [("fine", fine), ("coarse", coarse)]
        .map(|(name, camera)| format!(r#"{{"name": "{name}", {camera}, {place}}}"#));
    let rig = format!(r#"{{"name": "car", "cameras": [{}]}}"#, cameras.join(", "));
    std::fs::write(&path, rig).unwrap();
    let checked = wildcity(&["check", path.to_str().unwrap(), "--backend", "cpu"]);
    assert_eq!(checked.status.code(), Some(1), "{}", said(&checked));
    assert!(said(&checked).contains("where their lens says: coarse"), "{}", said(&checked));
}
