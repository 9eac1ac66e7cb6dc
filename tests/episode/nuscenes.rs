//! Export as tables of nuScenes: every table has the fields of its schema, and every token leads to
//! a row.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use serde_json::Value;
use wildcity_episode::{ExportError, NuscenesExport, NuscenesImage, export_nuscenes};
use wildcity_scene::Rig;

use crate::written::{Made, ego_at};

type Rows = BTreeMap<String, Vec<Value>>;

/// Fields of each table (docs/schema_nuscenes.md of the devkit), and the table to which a token
/// leads.
const SCHEMA: [(&str, &[(&str, &str)]); 13] = [
    ("attribute", &[("name", ""), ("description", "")]),
    (
        "calibrated_sensor",
        &[
            ("sensor_token", "sensor"),
            ("translation", ""),
            ("rotation", ""),
            ("camera_intrinsic", ""),
        ],
    ),
    ("category", &[("name", ""), ("description", ""), ("index", "")]),
    ("ego_pose", &[("translation", ""), ("rotation", ""), ("timestamp", "")]),
    (
        "instance",
        &[
            ("category_token", "category"),
            ("nbr_annotations", ""),
            ("first_annotation_token", "sample_annotation"),
            ("last_annotation_token", "sample_annotation"),
        ],
    ),
    ("log", &[("logfile", ""), ("vehicle", ""), ("date_captured", ""), ("location", "")]),
    ("map", &[("log_tokens", "log"), ("category", ""), ("filename", "")]),
    (
        "sample",
        &[("timestamp", ""), ("scene_token", "scene"), ("next", "sample"), ("prev", "sample")],
    ),
    (
        "sample_annotation",
        &[
            ("sample_token", "sample"),
            ("instance_token", "instance"),
            ("attribute_tokens", "attribute"),
            ("visibility_token", "visibility"),
            ("translation", ""),
            ("size", ""),
            ("rotation", ""),
            ("num_lidar_pts", ""),
            ("num_radar_pts", ""),
            ("next", "sample_annotation"),
            ("prev", "sample_annotation"),
        ],
    ),
    (
        "sample_data",
        &[
            ("sample_token", "sample"),
            ("ego_pose_token", "ego_pose"),
            ("calibrated_sensor_token", "calibrated_sensor"),
            ("filename", ""),
            ("fileformat", ""),
            ("width", ""),
            ("height", ""),
            ("timestamp", ""),
            ("is_key_frame", ""),
            ("next", "sample_data"),
            ("prev", "sample_data"),
        ],
    ),
    (
        "scene",
        &[
            ("name", ""),
            ("description", ""),
            ("log_token", "log"),
            ("nbr_samples", ""),
            ("first_sample_token", "sample"),
            ("last_sample_token", "sample"),
        ],
    ),
    ("sensor", &[("channel", ""), ("modality", "")]),
    ("visibility", &[("level", ""), ("description", "")]),
];

fn read(folder: &Path) -> Rows {
    let mut rows = Rows::new();
    for file in fs::read_dir(folder.join("v1.0-wildcity")).unwrap() {
        let path = file.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        rows.insert(name, serde_json::from_slice(&fs::read(path).unwrap()).unwrap());
    }
    rows
}

/// Checks the fields and the tokens of all tables.
fn check(rows: &Rows) {
    let tables: Vec<&str> = rows.keys().map(String::as_str).collect();
    assert_eq!(tables, SCHEMA.map(|(name, _)| name));
    let mut tokens: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (table, its) in rows {
        let found: BTreeSet<&str> = its.iter().map(|row| row["token"].as_str().unwrap()).collect();
        assert_eq!(found.len(), its.len(), "{table}: a token stands twice");
        tokens.insert(table, found);
    }
    for (table, fields) in SCHEMA {
        for row in &rows[table] {
            let names: BTreeSet<&str> =
                row.as_object().unwrap().keys().map(String::as_str).collect();
            let wanted = fields.iter().map(|(name, _)| *name).chain(["token"]);
            assert_eq!(names, wanted.collect(), "{table}");
            for (name, target) in fields.iter().filter(|(_, target)| !target.is_empty()) {
                let one = [row[*name].clone()];
                let linked = row[*name].as_array().map_or(&one[..], Vec::as_slice);
                for token in linked.iter().map(|token| token.as_str().unwrap()) {
                    let is_end = matches!(*name, "next" | "prev") && token.is_empty();
                    assert!(is_end || tokens[target].contains(token), "{table}.{name} {token}");
                }
            }
        }
    }
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// The rows of a chain from its first one.
fn chain(rows: &[Value], is_its: impl Fn(&Value) -> bool) -> Vec<&Value> {
    let by_token = |token: &Value| rows.iter().find(|row| row["token"] == *token);
    let mut found: Vec<&Value> =
        rows.iter().filter(|row| is_its(row) && row["prev"] == "").collect();
    assert_eq!(found.len(), 1, "one beginning");
    while let Some(next) = by_token(&found[found.len() - 1]["next"]) {
        assert_eq!(next["prev"], found[found.len() - 1]["token"]);
        found.push(next);
    }
    assert_eq!(found.len(), rows.iter().filter(|row| is_its(row)).count());
    found
}

#[test]
fn tables_have_the_fields_and_the_tokens_of_the_schema() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("out");
    let episode = Made { steps: 20, actors: 3, ..Made::default() }.read();
    let rig = Rig::preset("vehicle6").unwrap();
    let mut export = NuscenesExport::begin(&episode, Some(&rig), &folder).unwrap();
    assert!(!folder.exists(), "it has its name only when it is whole");
    for step in 0..=20 {
        let time_us = 100_000 * step + 7_000;
        for camera in [0, 3] {
            let world_from_rig = ego_at(step as f64);
            let jpeg = format!("{camera} at {step}");
            let image = NuscenesImage { camera, time_us, world_from_rig, jpeg: jpeg.as_bytes() };
            export.image(&image).unwrap();
        }
    }
    let exported = export.finish().unwrap();
    let rows = read(&folder);
    check(&rows);
    assert_eq!(exported.messages, rows.values().map(|its| its.len() as u64).sum::<u64>());
    // 2 s at 2 Hz, with both ends.
    let samples = chain(&rows["sample"], |_| true);
    let times: Vec<u64> =
        samples.iter().map(|row| row["timestamp"].as_u64().unwrap() - 1_000_000_000).collect();
    assert_eq!(times, [0, 500_000, 1_000_000, 1_500_000, 2_000_000]);
    assert_eq!(rows["scene"][0]["nbr_samples"], 5);
    assert_eq!(rows["sensor"].len(), 6);

    let mount = &rows["calibrated_sensor"][3];
    let camera = &rig.cameras[3];
    assert_eq!(numbers(&mount["translation"]), camera.rig_from_camera.position_m.to_array());
    assert_eq!(numbers(&mount["rotation"]), camera.rig_from_camera.q_wxyz());
    let pinhole = &camera.camera.pinhole;
    assert_eq!(
        numbers(&mount["camera_intrinsic"][1]),
        [0.0, pinhole.fy, pinhole.cy - 0.5],
        "from the middle of the first pixel"
    );

    let images =
        chain(&rows["sample_data"], |row| row["calibrated_sensor_token"] == mount["token"]);
    assert_eq!(images.len(), 21);
    for (step, row) in images.into_iter().enumerate() {
        assert_eq!(row["timestamp"], 1_000_007_000 + 100_000 * step as u64);
        assert_eq!(row["is_key_frame"], step % 5 == 0);
        let file = row["filename"].as_str().unwrap();
        assert!(file.starts_with(if step % 5 == 0 { "samples/CAM_" } else { "sweeps/CAM_" }));
        assert_eq!(fs::read_to_string(folder.join(file)).unwrap(), format!("3 at {step}"));
        // Steps 3 to 7 are nearest to the second sample.
        assert_eq!(row["sample_token"], samples[(step + 2) / 5]["token"]);
        let pose = rows["ego_pose"].iter().find(|pose| pose["token"] == row["ego_pose_token"]);
        assert_eq!(pose.unwrap()["timestamp"], row["timestamp"]);
        let at_m = ego_at(step as f64).position_m.to_array();
        assert_eq!(numbers(&pose.unwrap()["translation"]), at_m);
    }
    assert!(folder.join(rows["map"][0]["filename"].as_str().unwrap()).is_file());
}

#[test]
fn boxes_are_those_of_the_actors() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("out");
    let episode = Made { steps: 20, actors: 3, ..Made::default() }.read();
    export_nuscenes(&episode, None, &folder).unwrap();
    let rows = read(&folder);
    check(&rows);
    assert_eq!(rows["ego_pose"].len(), 21, "a pose for each step, without images");
    assert_eq!((rows["instance"].len(), rows["sample_annotation"].len()), (3, 15));
    let its = &rows["instance"][2];
    let boxes = chain(&rows["sample_annotation"], |row| row["instance_token"] == its["token"]);
    assert_eq!(boxes[0]["token"], its["first_annotation_token"]);
    assert_eq!(boxes[4]["token"], its["last_annotation_token"]);
    // Width, length and height; the middle is half a height above the ground.
    assert_eq!(numbers(&boxes[0]["size"]), [1.8, 4.2, 1.5]);
    let line = episode.actors.iter().rfind(|line| line.step == 10).unwrap();
    let state = line.actors[2].state().unwrap();
    let up_m = state.world_from_actor.rotation * glam::DVec3::new(0.0, 0.0, 0.75);
    let wanted_m = (state.world_from_actor.position_m + up_m).to_array();
    for (found, wanted) in numbers(&boxes[2]["translation"]).into_iter().zip(wanted_m) {
        assert!((found - wanted).abs() < 1e-9);
    }
    let turned = numbers(&boxes[2]["rotation"]);
    for (found, wanted) in turned.into_iter().zip(state.world_from_actor.q_wxyz()) {
        assert!((found - wanted).abs() < 1e-9);
    }
    let moving = &rows["attribute"][0];
    assert_eq!(moving["name"], "vehicle.moving");
    assert_eq!(boxes[2]["attribute_tokens"][0], moving["token"]);
}

#[test]
fn two_exports_are_equal_and_a_folder_is_never_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let episode = Made::default().read();
    for name in ["a", "b"] {
        export_nuscenes(&episode, None, &dir.path().join(name)).unwrap();
    }
    assert_eq!(read(&dir.path().join("a")), read(&dir.path().join("b")));
    let again = export_nuscenes(&episode, None, &dir.path().join("a"));
    assert!(matches!(again, Err(ExportError::Exists(_))));
    let lost = export_nuscenes(&episode, None, &dir.path().join("no/such/out"));
    assert!(matches!(lost, Err(ExportError::Io { .. })));
    // An export that was not finished leaves nothing.
    drop(NuscenesExport::begin(&episode, None, &dir.path().join("c")).unwrap());
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
}
