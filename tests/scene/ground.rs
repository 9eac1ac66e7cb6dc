//! The ground of captures of one object: most of the Gaussians are the object and what stands far
//! behind it, and the pavement that it stands on is a small part of the scene.

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec3};
use wildcity_scene::Gaussians;
use wildcity_scene::align::{
    CamerasError, CaptureCameras, GroundError, GroundSearch, find_ground, find_ground_below,
};
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;

/// A truck on a pavement, as it is before the capture's axes: metres, z up, the pavement at z = 0.
#[derive(Clone, Copy, Debug)]
struct Capture {
    name: &'static str,
    /// Length of the object, in metres; width and height are shares of it.
    object_m: [f64; 3],
    /// Mean distance of the pavement's border from the object.
    pavement_m: f64,
    /// Gaussians of the object, the pavement, the rough land around it, and the far background.
    counts: [usize; 4],
    /// Direction and half angle of the background around the object, in radians.
    background: [f64; 2],
    /// The axes of the capture: up is roughly -y, tilted by this, in degrees.
    tilt_degrees: f64,
    /// Units of the capture for a metre.
    scale: f64,
}

const TRUCK: Capture = Capture {
    name: "truck",
    object_m: [3.0, 1.5, 1.4],
    pavement_m: 4.5,
    counts: [14_000, 6_000, 8_000, 36_000],
    background: [0.0, PI],
    tilt_degrees: 8.0,
    scale: 0.37,
};

const CAPTURES: [Capture; 7] = [
    TRUCK,
    Capture { name: "small unit", scale: 1.0e-3, tilt_degrees: 0.0, ..TRUCK },
    Capture { name: "tilted, large unit", scale: 250.0, tilt_degrees: 35.0, ..TRUCK },
    // A wall of houses on one side only: the middle of the scene is not the object.
    Capture { name: "before houses", background: [1.1, 0.7], ..TRUCK },
    // The object has the most Gaussians, and rough land falls off all around the pavement.
    Capture { name: "on a mound", counts: [24_000, 8_000, 14_000, 40_000], ..TRUCK },
    Capture {
        name: "statue",
        object_m: [0.8, 0.8, 2.2],
        pavement_m: 3.0,
        counts: [9_000, 5_000, 6_000, 30_000],
        tilt_degrees: 20.0,
        ..TRUCK
    },
    Capture {
        name: "bus on a square",
        object_m: [12.0, 2.5, 3.2],
        pavement_m: 14.0,
        counts: [20_000, 14_000, 6_000, 20_000],
        tilt_degrees: -12.0,
        ..TRUCK
    },
];

/// Gaussians with a position, a normal and a size.
struct Cloud {
    gaussians: Gaussians,
    random: Random,
}

impl Cloud {
    fn push(&mut self, at_m: DVec3, normal: DVec3, size_m: f64, flatness: f64) {
        // Normals of trained splats scatter by some degrees.
        let mut bend = || self.random.range(-0.2, 0.2);
        let bent = (normal + DVec3::new(bend(), bend(), bend())).normalize();
        let q = DQuat::from_rotation_arc(DVec3::Z, bent);
        let ln =
            [size_m.ln(), (size_m * self.random.range(0.6, 1.0)).ln(), (size_m * flatness).ln()];
        self.gaussians.means_m.push(at_m.to_array());
        self.gaussians.quats_wxyz.push([q.w, q.x, q.y, q.z].map(|q| q as f32));
        self.gaussians.ln_scales.push(ln.map(|ln| ln as f32));
        self.gaussians.logit_opacities.push(self.random.range(-0.5, 4.0) as f32);
        self.gaussians.sh.extend([0.0; 3]);
    }

    /// Uniform on the unit sphere, of which equal slices along an axis have equal areas.
    fn direction(&mut self) -> DVec3 {
        let z = self.random.range(-1.0, 1.0);
        let angle = self.random.range(0.0, TAU);
        DVec3::new(angle.cos(), angle.sin(), 0.0) * (1.0 - z * z).sqrt() + z * DVec3::Z
    }
}

impl Capture {
    /// Distance of the pavement's ragged border in a direction.
    fn border_m(&self, angle: f64) -> f64 {
        let ragged = 0.22 * (3.0 * angle).sin() + 0.15 * (7.0 * angle + 1.0).cos();
        self.pavement_m * (1.0 + ragged + 0.1 * (23.0 * angle).sin())
    }

    fn gaussians(&self) -> Gaussians {
        let mut cloud =
            Cloud { gaussians: Gaussians::default(), random: Random::new(38, self.name, 0) };
        let [object, pavement, land, background] = self.counts;
        self.push_object(&mut cloud, object);
        self.push_pavement(&mut cloud, pavement);
        self.push_land(&mut cloud, land);
        self.push_background(&mut cloud, background);
        cloud.gaussians
    }

    /// The faces of a box with a round cab, without the face that it stands on.
    fn push_object(&self, cloud: &mut Cloud, count: usize) {
        let half = 0.5 * DVec3::from_array(self.object_m);
        for _ in 0..count {
            let toward = cloud.direction();
            // The superellipsoid x^8 + y^8 + z^8 = 1: a box with rounded edges.
            let share = toward.abs().powf(8.0);
            let at = toward / (share.x + share.y + share.z).powf(0.125);
            let normal = (at.abs().powf(7.0) * at.signum() / half).normalize();
            if normal.z < -0.5 {
                continue;
            }
            let noise = cloud.random.range(-0.01, 0.01);
            let at_m = at * half + half.z * DVec3::Z + noise * normal;
            cloud.push(at_m, normal, 0.02, 0.15);
        }
    }

    /// Large splats, rough by a centimetre; a third of them are round, and some hang below.
    fn push_pavement(&self, cloud: &mut Cloud, count: usize) {
        for index in 0..count {
            let angle = cloud.random.range(0.0, TAU);
            let away_m = self.border_m(angle) * cloud.random.unit().sqrt();
            let height_m = match index % 12 {
                0 => cloud.random.range(-0.6, 0.0),
                _ => cloud.random.range(-0.01, 0.01),
            };
            let flatness = if index % 3 == 0 { 0.9 } else { 0.1 };
            let at_m = DVec3::new(away_m * angle.cos(), away_m * angle.sin(), height_m);
            cloud.push(at_m, DVec3::Z, 0.08, flatness);
        }
    }

    /// Grass and earth from the border on: it falls off, with bumps, and its depth is uncertain.
    fn push_land(&self, cloud: &mut Cloud, count: usize) {
        for _ in 0..count {
            let angle = cloud.random.range(0.0, TAU);
            let beyond_m = 3.0 * self.pavement_m * cloud.random.unit().powi(2);
            let away_m = self.border_m(angle) + beyond_m;
            let at = DVec3::new(away_m * angle.cos(), away_m * angle.sin(), 0.0);
            let bumps_m = 0.3 * (0.9 * at.x).sin() + 0.25 * (1.3 * at.y + 0.5).cos();
            let height_m = -0.08 * beyond_m + bumps_m + cloud.random.range(-0.4, 0.4);
            let normal = cloud.direction();
            cloud.push(at + height_m * DVec3::Z, normal, 0.1, 0.4);
        }
    }

    /// Trees and houses, whose splats are large, some of them below the pavement, and a sky.
    fn push_background(&self, cloud: &mut Cloud, count: usize) {
        let [middle, half] = self.background;
        for index in 0..count {
            let angle = middle + cloud.random.range(-half, half);
            let away_m = self.pavement_m * cloud.random.range(4.0, 14.0);
            let height_m = cloud.random.range(-6.0, 11.0);
            let at_m = DVec3::new(away_m * angle.cos(), away_m * angle.sin(), height_m);
            let toward = cloud.direction();
            if index % 30 == 0 {
                cloud.push(
                    200.0 * DVec3::new(toward.x, toward.y, toward.z.abs()),
                    toward,
                    5.0,
                    0.5,
                );
            } else {
                cloud.push(at_m, toward, 0.02 * away_m, 0.4);
            }
        }
    }
}

#[test]
fn the_pavement_below_one_object_is_found() {
    let mut wrong = Vec::new();
    for (index, capture) in CAPTURES.into_iter().enumerate() {
        // Up is -y after this rotation, as in COLMAP's axes, and then tilted.
        let y_down = DQuat::from_rotation_x(0.5 * PI);
        let tilt =
            DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), capture.tilt_degrees.to_radians());
        let rotation = tilt * y_down;
        let mut gaussians = capture.gaussians();
        gaussians.transform(&Pose { position_m: DVec3::new(3.0, 1.0, -5.0), rotation });
        gaussians.scale(capture.scale);
        let up = rotation * DVec3::Z;
        let point = capture.scale * DVec3::new(3.0, 1.0, -5.0);
        // What is known of the up direction changes only which planes are left.
        let known: &[_] = if index == 0 { &[None, Some(DVec3::NEG_Y)] } else { &[None] };
        for &known in known {
            let search = GroundSearch { up: known, ..GroundSearch::default() };
            let found = find_ground(&gaussians, &search);
            let text = match &found {
                Err(error) => error.to_string(),
                Ok(plane) => {
                    let degrees = plane.up.angle_between(up).to_degrees();
                    let off_m = plane.up.dot(point - plane.point).abs() / capture.scale;
                    if degrees < 1.0 && off_m < 0.03 {
                        eprintln!("{}: {degrees:.2} degrees, {off_m:.3} m", capture.name);
                        continue;
                    }
                    format!("{degrees:.2} degrees and {off_m:.3} m off")
                }
            };
            wrong.push(format!("{} with up {known:?}: {text}", capture.name));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn an_object_without_a_pavement_has_no_ground() {
    for capture in [CAPTURES[0], CAPTURES[3], CAPTURES[6]] {
        let [object, _, land, background] = capture.counts;
        let bare = Capture { counts: [object, 0, land, background], ..capture };
        let found = find_ground(&bare.gaussians(), &GroundSearch::default());
        assert!(matches!(found, Err(GroundError::NoPlane { .. })), "{}: {found:?}", bare.name);
    }
}

/// A house with ledges, of which photographs show little of the ground before it, and more that
/// hangs below it than lies on it.
fn house() -> Gaussians {
    let mut cloud = Cloud { gaussians: Gaussians::default(), random: Random::new(41, "house", 0) };
    for index in 0..12_000 {
        let x_m = cloud.random.range(-12.0, 12.0);
        let z_m = cloud.random.range(0.0, 10.0);
        if index % 8 == 0 {
            // On one of three ledges.
            let ledge_m = [1.3, 4.0, 8.0][index / 8 % 3];
            let y_m = cloud.random.range(11.2, 12.0);
            cloud.push(DVec3::new(x_m, y_m, ledge_m), DVec3::Z, 0.05, 0.1);
        } else {
            let y_m = 12.0 + cloud.random.range(-0.05, 0.05);
            cloud.push(DVec3::new(x_m, y_m, z_m), DVec3::NEG_Y, 0.05, 0.1);
        }
    }
    for index in 0..900 {
        let at_m = DVec3::new(
            cloud.random.range(-10.0, 10.0),
            cloud.random.range(3.0, 11.0),
            cloud.random.range(-0.03, 0.03),
        );
        cloud.push(at_m, DVec3::Z, 0.1, if index % 2 == 0 { 0.9 } else { 0.1 });
    }
    for _ in 0..1_500 {
        let at_m = DVec3::new(
            cloud.random.range(-14.0, 14.0),
            cloud.random.range(2.0, 16.0),
            cloud.random.range(-8.0, -0.3),
        );
        let normal = cloud.direction();
        cloud.push(at_m, normal, 0.2, 0.4);
    }
    cloud.gaussians
}

/// Photographs from around the house, tilted to its roof by 8 degrees.
fn photographs() -> Vec<Pose> {
    let pose = |index: usize| {
        let angle = -0.9 + 0.18 * index as f64;
        let position_m = DVec3::new(13.0 * angle.sin(), 12.0 - 13.0 * angle.cos(), 1.6);
        // From x right, y down, z forward to x right, y forward, z up, and turned to the house.
        let level = DQuat::from_rotation_z(angle) * DQuat::from_rotation_x(-0.5 * PI);
        let tilt = DQuat::from_rotation_x(8_f64.to_radians());
        let roll = DQuat::from_rotation_z(0.03 * (index as f64).sin());
        Pose { position_m, rotation: level * tilt * roll }
    };
    (0..11).map(pose).collect()
}

#[test]
fn the_ground_before_a_house_is_below_its_photographs() {
    let turned = Pose {
        position_m: DVec3::new(-2.0, 0.5, 4.0),
        rotation: DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 1.9),
    };
    let mut gaussians = house();
    gaussians.transform(&turned);
    gaussians.scale(0.25);
    let in_capture = |pose: Pose| {
        let mut pose = turned * pose;
        pose.position_m *= 0.25;
        pose
    };
    let poses: Vec<Pose> = photographs().into_iter().map(in_capture).collect();
    let cameras = CaptureCameras::new(&poses).unwrap();
    let search = GroundSearch::default();
    let alone = find_ground(&gaussians, &search);
    let up = turned.rotation * DVec3::Z;
    let off_degrees = cameras.ups()[0].angle_between(up).to_degrees();
    assert!(off_degrees < 2.0, "the tilt does not matter: {off_degrees}");
    let straight = CaptureCameras::new(&vec![poses[5]; 4]).unwrap();
    let off_degrees = straight.ups()[0].angle_between(up).to_degrees();
    assert!((off_degrees - 8.0).abs() < 2.0, "one direction has its own up: {off_degrees}");
    let is_ground = |up_found: DVec3| up_found.angle_between(up).to_degrees() < 1.0;
    assert!(!alone.is_ok_and(|plane| is_ground(plane.up)), "the cameras are not needed");
    // One camera that was placed wrongly, far below.
    let mut wrong = poses.clone();
    wrong[3].position_m -= 20.0 * up;
    let with_wrong = CaptureCameras::new(&wrong).unwrap();
    let found = find_ground_below(&gaussians, &with_wrong, &search).unwrap();
    assert!(is_ground(found.up), "{:?} of {up:?}", found.up);
    // Up that is known wrongly.
    let sideways = CaptureCameras::with_up(&poses, turned.rotation * DVec3::X).unwrap();
    let refused = find_ground_below(&gaussians, &sideways, &search);
    assert!(!refused.is_ok_and(|plane| is_ground(plane.up)));
    // Wide, and upright in files that are turned to the left or to the right.
    for quarters in [0.0, 1.0, -1.0] {
        let file = DQuat::from_rotation_z(0.5 * PI * quarters);
        let turned = poses.iter().map(|pose| Pose { rotation: pose.rotation * file, ..*pose });
        let cameras = CaptureCameras::new(&turned.collect::<Vec<_>>()).unwrap();
        let found = find_ground_below(&gaussians, &cameras, &search).unwrap();
        assert!(is_ground(found.up), "{quarters}: {:?} of {up:?}", found.up);
        let height_m = cameras.height_above(&found) / 0.25;
        assert!((height_m - 1.6).abs() < 0.03, "{quarters}: {height_m}");
    }
}

/// Rows of photographs that are rolled more than they are turned are not level, and photographs
/// that are tilted more than they are turned are no portraits.
#[test]
fn up_is_that_of_most_photographs() {
    let mut random = Random::new(43, "cameras", 0);
    let mut camera = |roll_degrees: f64, yaw_degrees: f64, tilt_degrees: [f64; 2]| {
        let mut angle =
            |degrees: [f64; 2]| random.range(degrees[0] - 1e-9, degrees[1]).to_radians();
        let rotation = DQuat::from_rotation_z(angle([-yaw_degrees, yaw_degrees]))
            * DQuat::from_rotation_x(-0.5 * PI + angle(tilt_degrees))
            * DQuat::from_rotation_z(angle([-roll_degrees, roll_degrees]));
        // A walk along a house, at the height of the eyes.
        Pose {
            position_m: DVec3::new(random.range(0.0, 9.0), random.range(0.0, 2.0), 1.6),
            rotation,
        }
    };
    for (case, [roll, yaw], tilt) in [
        ("rolled", [16.0, 5.0], [-2.0, 2.0]),
        ("tilted", [1.0, 2.0], [0.0, 50.0]),
        ("turned", [2.0, 40.0], [10.0, 20.0]),
    ] {
        let poses: Vec<Pose> = (0..20).map(|_| camera(roll, yaw, tilt)).collect();
        let cameras = CaptureCameras::new(&poses).unwrap();
        let off = cameras.ups()[0].angle_between(DVec3::Z).to_degrees();
        assert!(cameras.ups().len() == 1 && off < 28.0, "{case}: {off} degrees");
    }
}

#[test]
fn cameras_in_all_directions_have_no_up() {
    let pose = |index: usize| Pose {
        position_m: DVec3::ZERO,
        rotation: DQuat::from_rotation_z(0.5 * PI * index as f64),
    };
    let refused = CaptureCameras::new(&(0..4).map(pose).collect::<Vec<_>>());
    assert_eq!(refused, Err(CamerasError::NoCommonUp { count: 4 }));
    assert_eq!(CaptureCameras::new(&[]), Err(CamerasError::NoCommonUp { count: 0 }));
}
