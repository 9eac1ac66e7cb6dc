//! The ground of the demo street is found, however the street is turned.

use glam::{DQuat, DVec3};
use wildcity_scene::align::{Alignment, GroundSearch, find_ground};
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;

use crate::DEMO;

/// Ten random rotations, uniform (Shoemake 1992), each with a move.
fn poses() -> impl Iterator<Item = Pose> {
    let mut random = Random::new(10, "rotations", 0);
    (0..10).map(move |_| {
        let share = random.unit();
        let [a, b] =
            [random.range(0.0, std::f64::consts::TAU), random.range(0.0, std::f64::consts::TAU)];
        let (near, far) = ((1.0 - share).sqrt(), share.sqrt());
        let rotation =
            DQuat::from_xyzw(near * a.sin(), near * a.cos(), far * b.sin(), far * b.cos());
        let position_m = DVec3::new(
            random.range(-50.0, 50.0),
            random.range(-50.0, 50.0),
            random.range(-50.0, 50.0),
        );
        Pose { position_m, rotation }
    })
}

#[test]
fn the_ground_of_a_turned_street_is_found() {
    for (index, turned_from_street) in poses().enumerate() {
        let mut turned = DEMO.gaussians.clone();
        turned.transform(&turned_from_street);
        let ground = find_ground(&turned, &GroundSearch::default()).unwrap();
        let alignment = Alignment::onto(&ground);
        let up = alignment.new_from_old.rotation * (turned_from_street.rotation * DVec3::Z);
        let degrees = up.angle_between(DVec3::Z).to_degrees();
        // The street's road is at height 0 along its whole length.
        let height_m = |x: f64| {
            let road_m = turned_from_street.transform_point(DVec3::new(x, 0.0, 0.0));
            alignment.point_m(road_m).z.abs()
        };
        let most_m = (0..=20).map(|i| height_m(10.0 * f64::from(i))).fold(0.0, f64::max);
        eprintln!("{index}: {degrees:.3} degrees, {:.1} mm", 1e3 * most_m);
        assert!(degrees < 0.5, "{index}: {degrees} degrees");
        assert!(most_m < 0.02, "{index}: {most_m} m");
    }
}

#[test]
fn an_aligned_street_has_its_colours_where_they_were() {
    let turned_from_street = poses().next().unwrap();
    let back = Alignment { new_from_old: turned_from_street.inverse(), metres_per_unit: 1.0 };
    let few = DEMO.gaussians.select((0..DEMO.gaussians.len()).step_by(5_000));
    let mut turned = few.clone();
    turned.transform(&turned_from_street);
    assert!(turned.sh.iter().zip(&few.sh).any(|(a, b)| (a - b).abs() > 1e-2), "SH must turn");
    back.apply(&mut turned);
    let pairs = turned.sh.iter().zip(&few.sh);
    let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-5, "{worst}");
}
