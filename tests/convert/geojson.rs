//! GeoJSON maps.

use glam::DVec2;
use serde_json::{Value, json};
use wildcity_convert::geojson;
use wildcity_sim::map::{AreaKind, Map};

fn feature(layer: &str, kind: &str, coordinates: Value, mut properties: Value) -> Value {
    properties["layer"] = layer.into();
    json!({"type": "Feature", "properties": properties,
           "geometry": {"type": kind, "coordinates": coordinates}})
}

fn collection(features: Vec<Value>) -> String {
    json!({"type": "FeatureCollection", "features": features}).to_string()
}

/// A lane, a crosswalk and a stop line.
pub(crate) fn own() -> String {
    let square = json!([[[20, -5, 0], [24, -5, 0], [24, 5, 0], [20, 5, 0], [20, -5, 0]]]);
    collection(vec![
        feature(
            "lane",
            "LineString",
            json!([[0, 0], [50, 0], [100, 0, 1.0]]),
            json!({"id": "a", "width_m": 3.5, "next": ["b"], "limit_mps": 8.3}),
        ),
        feature(
            "lane",
            "LineString",
            json!([[100, 0, 1.0], [150, 20]]),
            json!({"id": "b", "width_m": 3}),
        ),
        feature("crosswalk", "Polygon", square, json!({})),
        feature("stop_line", "LineString", json!([[18, -2], [18, 2]]), json!({"lights": ["l1"]})),
    ])
}

/// A lane and a connector with nuPlan's layers.
fn nuplan() -> String {
    let line = |y: f64| json!([[0.0, y], [30.0, y]]);
    collection(vec![
        feature("baseline_paths", "LineString", line(0.0), json!({"lane_fid": 7})),
        feature("boundaries", "LineString", line(1.8), json!({"fid": 1})),
        // In the other direction.
        feature("boundaries", "LineString", json!([[30.0, -1.8], [0.0, -1.8]]), json!({"fid": 2})),
        feature(
            "lanes_polygons",
            "Polygon",
            json!([]),
            json!({"fid": 7, "left_boundary_fid": 1, "right_boundary_fid": 2}),
        ),
        feature(
            "baseline_paths",
            "LineString",
            json!([[30, 0], [40, 0]]),
            json!({"lane_connector_fid": 9}),
        ),
        feature("boundaries", "LineString", json!([[30, 2], [40, 2]]), json!({"fid": 3})),
        feature("boundaries", "LineString", json!([[30, -2], [40, -2]]), json!({"fid": 4})),
        feature(
            "gen_lane_connectors_scaled_width_polygons",
            "Polygon",
            json!([]),
            json!({"fid": 9, "left_boundary_fid": 3, "right_boundary_fid": 4,
                       "exit_lane_fid": 7, "entry_lane_fid": 8}),
        ),
    ])
}

#[test]
fn own_layers_make_lanes_and_areas() {
    let map = Map::new(geojson::read(own().as_bytes(), None).unwrap()).unwrap();
    assert_eq!(map.lane("a").unwrap().next, ["b"]);
    assert_eq!(map.lane("a").unwrap().left[0], [0.0, 1.75, 0.0]);
    assert!(map.is_in(DVec2::new(22.0, 4.0), AreaKind::Crosswalk));
    assert_eq!(map.file().stop_lines[0].lights, ["l1"]);
    assert!(map.is_drivable(DVec2::new(60.0, -1.7)) && !map.is_drivable(DVec2::new(60.0, -1.8)));
}

#[test]
fn nuplans_layers_make_lanes_with_links() {
    let map = Map::new(geojson::read(nuplan().as_bytes(), None).unwrap()).unwrap();
    let lane = map.lane("7").unwrap();
    assert_eq!(lane.next, ["9"]);
    assert_eq!(lane.right, [[0.0, -1.8, 0.0], [30.0, -1.8, 0.0]], "turned along its lane");
    assert!(map.lane("9").unwrap().intersection);
    assert!(map.is_in(DVec2::new(35.0, 0.0), AreaKind::Intersection));
}

#[test]
fn degrees_become_metres_from_an_origin() {
    let degrees = own().replace("[50,0]", "[0.0005,0]").replace("[100,0,1.0]", "[0.001,0,1.0]");
    let degrees = degrees.replace("[150,20]", "[0.0015,0.0002]");
    let map = geojson::read(degrees.as_bytes(), Some([0.0, 0.0])).unwrap();
    let [x, y, z] = map.lanes[0].center[2];
    // On the equator, 0.001° are 111.319 m.
    assert!((x - 111.319).abs() < 1e-3 && y.abs() < 1e-9 && z == 1.0, "{x} {y} {z}");
}

#[test]
fn mistakes_name_the_feature_and_the_fix() {
    let place = |from: &str, to: &str| {
        let text = own();
        assert!(text.contains(from), "{from}");
        geojson::read(text.replacen(from, to, 1).as_bytes(), None).unwrap_err().place
    };
    assert_eq!(place("\"lane\"", "\"lame\""), "features[0].properties.layer");
    assert_eq!(place("\"width_m\":3.5", "\"width_m\":0"), "features[0].properties.width_m");
    assert_eq!(place("\"width_m\":3.5,", "").as_str(), "features[0].properties.width_m");
    assert_eq!(place("[50,0]", "[50]"), "features[0].geometry.coordinates");
    assert_eq!(place("\"Polygon\"", "\"Point\""), "features[2].geometry.type");
    assert_eq!(place("[\"b\"]", "[\"c\"]"), "lanes[0].next[0]");
    assert_eq!(place("FeatureCollection", "Feature"), "type");
    let unlinked = nuplan().replace("\"left_boundary_fid\":3", "\"left_boundary_fid\":33");
    let error = geojson::read(unlinked.as_bytes(), None).unwrap_err();
    assert_eq!(error.place, "features[7]");
}
