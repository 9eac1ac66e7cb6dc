//! Places against those of PROJ.

use glam::DQuat;

use super::*;

/// Origin (latitude, longitude, altitude), position in its tangent plane, and that point: by PROJ
/// 9.5 (`+proj=topocentric`), whose own inverse is exact to about 1e-8 m.
const TOPOCENTRIC: [([f64; 3], [f64; 3], [f64; 3]); 15] = [
    ([52.5162, 13.3777, 34.0], [0.0, 0.0, 0.0], [52.5162000000000, 13.3777000000000, 34.000000000]),
    (
        [52.5162, 13.3777, 34.0],
        [1500.0, -820.5, 12.25],
        [52.5088245047702, 13.3997922452681, 46.478805781],
    ),
    (
        [52.5162, 13.3777, 34.0],
        [-25000.0, 40000.0, 150.0],
        [52.8750564866755, 13.0064175457977, 358.357379818],
    ),
    ([-33.8568, 151.2153, 5.0], [0.0, 0.0, 0.0], [-33.856_8, 151.215_3, 5.000000000]),
    (
        [-33.8568, 151.2153, 5.0],
        [1500.0, -820.5, 12.25],
        [-33.8641961458479, 151.2315106439513, 17.479165527],
    ),
    (
        [-33.8568, 151.2153, 5.0],
        [-25000.0, 40000.0, 150.0],
        [-33.4958900840567, 150.9462843422943, 329.821766813],
    ),
    ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0000000000000, 0.0000000000000, 0.000000000]),
    ([0.0, 0.0, 0.0], [1500.0, -820.5, 12.25], [-0.0074203369630, 0.0134747031335, 12.479514647]),
    (
        [0.0, 0.0, 0.0],
        [-25000.0, 40000.0, 150.0],
        [0.3617315743570, -0.2245723895259, 325.262725256],
    ),
    (
        [64.1466, -21.9426, 1200.0],
        [0.0, 0.0, 0.0],
        [64.1466000000001, -21.9426000000000, 1200.000000012],
    ),
    (
        [64.1466, -21.9426, 1200.0],
        [1500.0, -820.5, 12.25],
        [64.1392380484639, -21.9117974917613, 1212.478561588],
    ),
    (
        [64.1466, -21.9426, 1200.0],
        [-25000.0, 40000.0, 150.0],
        [64.5044019960229, -22.4627987726903, 1524.068812202],
    ),
    ([-77.85, 166.67, 30.0], [0.0, 0.0, 0.0], [-77.85, 166.67, 29.999999999]),
    (
        [-77.85, 166.67, 30.0],
        [1500.0, -820.5, 12.25],
        [-77.8573418846524, 166.7338540101861, 42.478439325],
    ),
    (
        [-77.85, 166.67, 30.0],
        [-25000.0, 40000.0, 150.0],
        [-77.4897567392669, 165.6365449178389, 353.896703038],
    ),
];

/// UTM zone, easting and northing, latitude and longitude, and meridian convergence in degrees: by
/// PROJ 9.5.
const UTM: [(&str, [f64; 2], [f64; 2], f64); 6] = [
    ("EPSG:32633", [391779.0, 5820076.5], [52.5200389577798, 13.4049947675464], -1.2658642168),
    ("EPSG:32756", [334900.0, 6252300.25], [-33.8566962673666, 151.2152960012971], 0.9945149782),
    ("EPSG:32601", [500000.0, 0.0], [0.0000000000000, -177.0000000000000], -0.0000000000),
    ("EPSG:32660", [720000.0, 9200000.0], [82.5873256548401, -167.5453602366381], 15.3315832802),
    ("EPSG:32719", [166021.5, 1116915.0], [-79.5796153662859, -85.7635305730360], 16.5022155700),
    ("EPSG:32632", [833000.5, 7300000.0], [65.6488478385064, 16.2503979593914], 6.6113753936),
];

fn point([latitude_deg, longitude_deg, altitude_m]: [f64; 3]) -> GeoPoint {
    GeoPoint { latitude_deg, longitude_deg, altitude_m }
}

fn facing(position_m: DVec3, yaw_rad: f64) -> Pose {
    Pose { position_m, rotation: DQuat::from_rotation_z(yaw_rad) }
}

#[test]
fn points_of_a_tangent_plane_are_those_of_proj() {
    for (origin, xyz_m, expected) in TOPOCENTRIC {
        let anchor = GeoAnchor::Origin(point(origin));
        anchor.check().unwrap();
        let at = facing(DVec3::from_array(xyz_m), 0.0);
        let GeoPoint { latitude_deg, longitude_deg, altitude_m } =
            anchor.locate(&at).unwrap().point;
        // 2e-12 degrees are 0.2 µm on the ground.
        assert!((latitude_deg - expected[0]).abs() < 2e-12, "{latitude_deg}, {expected:?}");
        assert!((longitude_deg - expected[1]).abs() < 2e-12, "{longitude_deg}, {expected:?}");
        assert!((altitude_m - expected[2]).abs() < 3e-8, "{altitude_m}, {expected:?}");
        let back_m = anchor.position_m(&anchor.locate(&at).unwrap().point).unwrap();
        assert!((back_m - at.position_m).length() < 1e-8, "{back_m}");
    }
}

#[test]
fn points_of_utm_are_those_of_proj() {
    for (zone, [easting_m, northing_m], [latitude_deg, longitude_deg], convergence) in UTM {
        let anchor: GeoAnchor =
            format!("{zone},{},{}", easting_m - 10.0, northing_m).parse().unwrap();
        // 10 m less in the anchor, and 10 m in the pose: the sum is the tabulated easting. The rig
        // looks along y, to grid north.
        let at = facing(DVec3::new(10.0, 0.0, 3.0), std::f64::consts::FRAC_PI_2);
        let GeoPose { point, heading_deg } = anchor.locate(&at).unwrap();
        assert!((point.latitude_deg - latitude_deg).abs() < 1e-12, "{zone}: {point:?}");
        assert!((point.longitude_deg - longitude_deg).abs() < 1e-12, "{zone}: {point:?}");
        assert_eq!(point.altitude_m, 3.0);
        // A rig that faces grid north has the convergence as its heading.
        let off_deg = (heading_deg - convergence + 180.0).rem_euclid(360.0) - 180.0;
        assert!(off_deg.abs() < 1e-9, "{zone}: {heading_deg}, {convergence}");
        let back_m = anchor.position_m(&point).unwrap();
        assert!((back_m - at.position_m).length() < 2e-8, "{zone}: {back_m}");
    }
}

#[test]
fn headings_are_from_north_to_the_east() {
    let anchor: GeoAnchor = "52.5,13.4,34".parse().unwrap();
    for (yaw_deg, expected) in
        [(90.0, 0.0), (0.0, 90.0), (180.0, 270.0), (-90.0, 180.0), (45.0, 45.0)]
    {
        let at = facing(DVec3::ZERO, f64::to_radians(yaw_deg));
        let found = anchor.locate(&at).unwrap().heading_deg;
        let off_deg = (found - expected + 180.0).rem_euclid(360.0) - 180.0;
        assert!(off_deg.abs() < 1e-9, "{yaw_deg}: {found}");
    }
    // 40 km to the east, the meridian is turned by 0.59 degrees of longitude times the sine of the
    // latitude.
    let located =
        anchor.locate(&facing(DVec3::new(40_000.0, 0.0, 0.0), std::f64::consts::FRAC_PI_2));
    let far = located.unwrap();
    let turned_deg = (far.point.longitude_deg - 13.4) * 52.5f64.to_radians().sin();
    assert!((far.heading_deg - turned_deg).abs() < 2e-3, "{far:?}, {turned_deg}");
}

#[test]
fn what_is_no_anchor_is_refused() {
    for text in ["", "52.5", "52.5,13.4,1,2", "x,13", "EPSG:32633", "EPSG:32633,1"] {
        let refused = text.parse::<GeoAnchor>().unwrap_err();
        assert!(matches!(refused, GeoError::Malformed { .. }), "{text}: {refused}");
    }
    for (text, named) in [
        ("91,0", "latitude_deg"),
        ("0,181", "longitude_deg"),
        ("0,NaN", "longitude_deg"),
        ("EPSG:3857,0,0", "projection"),
        ("EPSG:32661,500000,0", "projection"),
        ("EPSG:32633,0,0", "easting_m"),
    ] {
        let said = text.parse::<GeoAnchor>().unwrap_err().to_string();
        assert!(said.contains(named), "{text}: {said}");
    }
}
