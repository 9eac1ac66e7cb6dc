//! OpenDRIVE maps.

use glam::DVec2;
use wildcity_convert::opendrive;
use wildcity_sim::map::{LaneKind, Map};

/// A straight road of 100 m with two lanes and a pavement, that continues into an arc of radius 50 m.
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
    let imported = opendrive::read(ROADS.as_bytes()).unwrap();
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
    let place = |text: &str| opendrive::read(text.as_bytes()).unwrap_err();
    assert_eq!(place("<OpenDRIVE/>").place, "OpenDRIVE");
    assert_eq!(place("{}").place, "OpenDRIVE");
    let far = ROADS.replace("x=\"0.0\" y=\"0.0\"", "x=\"400000.0\" y=\"5000000.0\"");
    let error = place(&far);
    assert!(error.place.starts_with("lane 1/") && error.message.contains("offset"), "{error}");
    assert_eq!(opendrive::read(&[0xff, 0xfe]).unwrap_err().place, "file");
}
