//! OpenDRIVE maps.

use glam::DVec2;
use wildcity_convert::opendrive;
use wildcity_sim::map::{LaneKind, Map, MapFile};

use crate::case;

/// A straight road of 100 m with two lanes and a pavement, that continues into an arc of radius 50
/// m.
pub(crate) const ROADS: &str = r#"<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="6" name="two roads"/>
  <road name="a" length="100.0" id="1" junction="-1">
    <link><successor elementType="road" elementId="2" contactPoint="start"/></link>
    <type s="0.0" type="town"><speed max="50" unit="km/h"/></type>
    <planView><geometry s="0.0" x="0.0" y="0.0" hdg="0.0" length="100.0"><line/></geometry></planView>
    <elevationProfile><elevation s="0.0" a="1.0" b="0.02" c="0.0" d="0.0"/></elevationProfile>
    <lanes><laneSection s="0.0">
      <left><lane id="1" type="driving" level="false"><link><successor id="1"/></link>
        <width sOffset="0.0" a="3.5" b="0.0" c="0.0" d="0.0"/></lane></left>
      <center><lane id="0" type="none" level="false"/></center>
      <right><lane id="-1" type="driving" level="false"><link><successor id="-1"/></link>
        <width sOffset="0.0" a="3.5" b="0.0" c="0.0" d="0.0"/></lane>
        <lane id="-2" type="sidewalk" level="false"><width sOffset="0.0" a="2.0" b="0.0" c="0.0" d="0.0"/></lane></right>
    </laneSection></lanes>
  </road>
  <road name="b" length="50.0" id="2" junction="-1">
    <link><predecessor elementType="road" elementId="1" contactPoint="end"/></link>
    <planView><geometry s="0.0" x="100.0" y="0.0" hdg="0.0" length="50.0"><arc curvature="0.02"/></geometry></planView>
    <elevationProfile><elevation s="0.0" a="3.0" b="0.0" c="0.0" d="0.0"/></elevationProfile>
    <lanes><laneSection s="0.0">
      <left><lane id="1" type="driving" level="false"><link><predecessor id="1"/></link>
        <width sOffset="0.0" a="3.5" b="0.0" c="0.0" d="0.0"/></lane></left>
      <center><lane id="0" type="none" level="false"/></center>
      <right><lane id="-1" type="driving" level="false"><link><predecessor id="-1"/></link>
        <width sOffset="0.0" a="3.5" b="0.0" c="0.0" d="0.0"/></lane></right>
    </laneSection></lanes>
  </road>
</OpenDRIVE>
"#;

#[test]
fn lanes_have_their_places_directions_and_links() {
    let imported = opendrive::read(ROADS.as_bytes(), None).unwrap();
    let map = Map::new(imported.map).unwrap();
    let right = map.lane("1/0/-1").unwrap();
    assert_eq!(
        (right.kind, right.next.as_slice()),
        (LaneKind::Driving, &["2/0/-1".to_owned()][..])
    );
    assert!((right.limit_mps.unwrap() - 50.0 / 3.6).abs() < 1e-4);
    let [x, y, z] = *right.center.last().unwrap();
    assert!((x - 100.0).abs() < 1e-3 && (y + 1.75).abs() < 1e-3 && (z - 3.0).abs() < 1e-3);
    // The left lane drives back.
    let left = map.lane("1/0/1").unwrap();
    assert!(left.center[0][0] > 99.0 && left.center.last().unwrap()[0] < 1.0);
    assert!((left.left[0][1]).abs() < 1e-3, "its left edge is the middle: {:?}", left.left[0]);
    assert_eq!(map.lane("2/0/1").unwrap().next, ["1/0/1"]);
    assert_eq!(map.lane("1/0/-2").unwrap().kind, LaneKind::Sidewalk);
    // On the arc, 1.75 m outside of radius 50 m about (100, 50).
    for [x, y, _] in &map.lane("2/0/-1").unwrap().center {
        let radius_m = DVec2::new(x - 100.0, y - 50.0).length();
        assert!((radius_m - 51.75).abs() < 1e-2, "{radius_m}");
    }
    let at = |x: f64, y: f64| map.lanes_at(DVec2::new(x, y)).count();
    assert_eq!([at(50.0, -1.0), at(50.0, 1.0), at(50.0, -4.0), at(50.0, 0.0)], [1, 1, 0, 2]);
    assert!(map.is_drivable(DVec2::new(50.0, -3.4)) && !map.is_drivable(DVec2::new(50.0, -3.6)));
}

#[test]
fn what_is_no_map_is_refused() {
    let place = |text: &str| opendrive::read(text.as_bytes(), None).unwrap_err();
    assert_eq!(place("<OpenDRIVE/>").place, "OpenDRIVE");
    assert_eq!(place("{}").place, "XML");
    let far = ROADS.replace("x=\"0.0\" y=\"0.0\"", "x=\"400000.0\" y=\"5000000.0\"");
    assert!(place(&far).message.contains("apart"), "{}", place(&far));
    let far = far.replace("x=\"100.0\" y=\"0.0\"", "x=\"400100.0\" y=\"5000000.0\"");
    let error = place(&far);
    assert!(error.message.contains("--origin 400000.0,5000000.0"), "{error}");
    assert_eq!(opendrive::read(&[0xff, 0xfe], None).unwrap_err().place, "file");
}

/// The ends of the middle of a lane.
fn ends(map: &MapFile, lane: &str) -> [[f64; 3]; 2] {
    let lane = map.lanes.iter().find(|one| one.id == lane).unwrap();
    [lane.center[0], *lane.center.last().unwrap()]
}

fn assert_near(found: [f64; 3], wanted: [f64; 3]) {
    let is_near = found.iter().zip(wanted).all(|(found, wanted)| (found - wanted).abs() < 1e-3);
    assert!(is_near, "{found:?}, not {wanted:?}");
}

/// A road in UTM, as surveyed maps are.
#[test]
fn roads_far_from_the_origin_move_to_it_and_give_its_place_on_the_earth() {
    let anchor = "EPSG:32632,691000,5334000".parse().unwrap();
    let origin = Some([691_000.0, 5_334_000.0]);
    for (name, origin) in [("utm", origin), ("utm_off", None), ("utm_off", origin)] {
        let Some(text) = case(&format!("xodr_utm/{name}.xodr")) else { return };
        let imported = opendrive::read(&text, origin).unwrap();
        let [from, to] = ends(&imported.map, "1/0/1");
        assert_near(from, [100.5, 2.0, 0.0]);
        assert_near(to, [0.5, 2.0, 0.0]);
        assert_eq!(imported.geo.as_ref(), Some(&anchor), "{name}");
        // An offset that the file itself does not call for is told.
        assert_eq!(!imported.warnings.is_empty(), origin.is_none(), "{:?}", imported.warnings);
    }
    let Some(text) = case("xodr_utm/utm.xodr") else { return };
    let error = opendrive::read(&text, None).unwrap_err().message;
    assert!(error.contains("--origin 691000.0,5334000.0"), "{error}");
    let elsewhere = opendrive::read(&text, Some([500_000.0, 5_334_000.0])).unwrap_err();
    assert!(elsewhere.message.contains("give a place on the map"), "{elsewhere}");
}

/// By the standard, the offset takes the coordinates of the file to the projection.
#[test]
fn an_offset_of_a_local_file_is_the_place_of_its_origin() {
    let header = "<header revMajor=\"1\" revMinor=\"6\" name=\"two roads\"><geoReference>+proj=utm +zone=32 \
                  +datum=WGS84</geoReference><offset x=\"691000\" y=\"5334000\" z=\"510\" hdg=\"0\"/></header>";
    let text = ROADS.replace("<header revMajor=\"1\" revMinor=\"6\" name=\"two roads\"/>", header);
    assert_ne!(text, ROADS);
    let imported = opendrive::read(text.as_bytes(), None).unwrap();
    assert_eq!(imported.geo, Some("EPSG:32632,691000,5334000,510".parse().unwrap()));
    let [from, _] = ends(&imported.map, "1/0/-1");
    let moved = opendrive::read(text.as_bytes(), Some([690_990.0, 5_334_020.0])).unwrap();
    let [beside, _] = ends(&moved.map, "1/0/-1");
    assert_near(beside, [from[0] + 10.0, from[1] - 20.0, from[2]]);
    let turned = text.replace("hdg=\"0\"/></header>", "hdg=\"0.1\"/></header>");
    assert_eq!(opendrive::read(turned.as_bytes(), None).unwrap().geo, None);
    let error = opendrive::read(turned.as_bytes(), Some([691e3, 5334e3])).unwrap_err();
    assert!(error.message.contains("hdg"), "{error}");
}

#[test]
fn edges_of_a_banked_road_are_along_its_bank() {
    let Some(text) = case("xodr_bank_edges/bank.xodr") else { return };
    let map = opendrive::read(&text, None).unwrap().map;
    let lane = &map.lanes[0];
    let [sin, cos] = [0.5_f64.sin(), 0.5_f64.cos()];
    for (left, right) in lane.left.iter().zip(&lane.right) {
        assert_near([0.0, left[1], left[2]], [0.0, 0.0, 0.0]);
        assert_near([0.0, right[1], right[2]], [0.0, -4.0 * cos, -4.0 * sin]);
    }
}

/// A lane that becomes wider by 1 m in 10 m: its middle turns by 2.9 degrees, its ends stay across
/// the road.
#[test]
fn edges_of_a_widening_lane_are_across_the_road() {
    let text = r#"<OpenDRIVE><header revMajor="1" revMinor="7"/>
<road name="a" length="10" id="1" junction="-1"><link/>
<planView><geometry s="0" x="0" y="0" hdg="0" length="10"><line/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3" b="0.1" c="0" d="0"/></lane></right>
</laneSection></lanes></road></OpenDRIVE>"#;
    let map = opendrive::read(text.as_bytes(), None).unwrap().map;
    let lane = &map.lanes[0];
    for (at, middle) in lane.center.iter().enumerate() {
        assert_near(lane.left[at], [middle[0], 0.0, 0.0]);
        assert_near(lane.right[at], [middle[0], -3.0 - 0.1 * middle[0], 0.0]);
    }
}

/// The reader of roads takes a number that is none for 0: a lane of no length.
#[test]
fn numbers_that_are_none_are_refused() {
    let curve =
        "<paramPoly3 aU=\"0\" bU=\"1\" cU=\"0\" dU=\"0\" aV=\"0\" bV=\"0\" cV=\"NaN\" dV=\"0\"/>";
    let text = ROADS.replacen("<line/>", curve, 1);
    let error = opendrive::read(text.as_bytes(), None).unwrap_err();
    assert!(error.place.ends_with("<paramPoly3>") && error.message.contains("cV"), "{error}");
    let text = ROADS.replacen("length=\"100.0\"><line", "length=\"1e999\"><line", 1);
    assert_ne!(text, ROADS);
    assert!(opendrive::read(text.as_bytes(), None).is_err());
}
