//! `wildcity rig`: every preset is shown, drawn, and true to its lenses.

use std::process::{Command, Output};

use wildcity::scene::Rig;

fn wildcity(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_wildcity")).arg("rig").args(arguments).output().unwrap()
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
        let cameras = Rig::preset(name).unwrap().cameras;
        let shown = said(&wildcity(&["show", name]));
        assert_eq!(shown.lines().count(), cameras.len() + 2, "{shown}");
        let checked = wildcity(&["check", name, "--backend", "cpu"]);
        assert!(checked.status.success(), "{}", said(&checked));
        assert_eq!(said(&checked).lines().count(), cameras.len());
        let picture = dir.path().join("rig.svg");
        let drawn = wildcity(&["draw", name, "--out", picture.to_str().unwrap()]);
        assert!(drawn.status.success(), "{}", said(&drawn));
        let svg = std::fs::read_to_string(&picture).unwrap();
        assert!(svg.starts_with("<svg"), "{svg}");
        for camera in cameras {
            assert!(svg.contains(&camera.name), "{} is not in the picture", camera.name);
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
    for (name, yaw_deg) in [("front", 0.0), ("front_left", 55.0), ("back_right", -110.0)] {
        assert!((yaw_of(name) - yaw_deg).abs() < 0.06, "{name}: {shown}");
    }
}

#[test]
fn what_is_no_rig_is_refused() {
    let unknown = wildcity(&["check", "vehicle7"]);
    assert_eq!(unknown.status.code(), Some(1));
    let text = said(&unknown);
    assert!(text.contains("neither a file nor a preset") && text.contains("vehicle6"), "{text}");
}
