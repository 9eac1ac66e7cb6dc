//! The pixels that boxes hide, against shapely.

use serde_json::{Value, json};

use wildcity_eval::{Boxes, GROWN_PX, hide};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};

#[test]
fn hidden_pixels_are_those_of_shapely() {
    let made: Value = serde_json::from_str(include_str!("boxes.json")).unwrap();
    let number = |value: &Value| value.as_f64().unwrap();
    let [width, height] = [0, 1].map(|at| made["size_px"][at].as_u64().unwrap() as u32);
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|at| number(&made["pinhole"][at]));
    let camera = Camera::from_pinhole(width, height, Pinhole { fx, fy, cx, cy });
    let cases = made["cases"].as_array().unwrap();
    let mut hidden = 0;
    for (index, case) in cases.iter().enumerate() {
        let world_from_camera: Pose = serde_json::from_value(case["camera"].clone()).unwrap();
        // As a file has them, all of them moving.
        let lines = case["boxes"].as_array().unwrap().iter().enumerate().map(|(track, one)| {
            let line = json!({"time_us": 7, "track": track, "size": one["size"],
                "world_from_box": one["world_from_box"], "velocity": [2, 0, 0]});
            format!("{line}\n")
        });
        let boxes = Boxes::parse(&lines.collect::<String>()).unwrap();
        let mut counts = vec![true; camera.pixels()];
        for one in boxes.moving_at(7) {
            let hull = one.hull_px(&camera, &world_from_camera);
            hide(&hull, [width, height], GROWN_PX, &mut counts);
        }
        let rows = case["hidden"].as_array().unwrap().iter().map(|row| row.as_str().unwrap());
        let wanted: Vec<bool> = rows.flat_map(|row| row.chars().map(|c| c == '.')).collect();
        let wrong = counts.iter().zip(&wanted).filter(|(a, b)| a != b).count();
        assert_eq!((counts.len(), wrong), (wanted.len(), 0), "case {index}");
        hidden += counts.iter().filter(|counts| !**counts).count();
    }
    assert!(cases.len() == 12 && hidden > 5000, "{hidden} pixels");
}
