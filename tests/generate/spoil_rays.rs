//! Effects of a spoil on single Gaussians next to a straight drive: along the rays of the drive,
//! and unseen from it.

use glam::{DQuat, DVec3};
use wildcity_generate::Spoil;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Gaussians, Trajectory};

/// Height of the cameras, in metres.
const EYE_M: f64 = 1.6;
const COUNT: usize = 6_000;

/// Along x from 0 to 400 m.
fn drive() -> Trajectory {
    let keyframe = |at: i64| Keyframe {
        time_us: 50_000 * at,
        world_from_rig: Pose {
            position_m: DVec3::new(0.5 * at as f64, 0.0, 0.0),
            ..Pose::IDENTITY
        },
    };
    Trajectory { name: "log".to_owned(), keyframes: (0..=800).map(keyframe).collect() }
}

/// Grey Gaussians of 4 x 6 x 5 cm to the left of the drive, with no cell's border near.
fn street() -> Gaussians {
    let mut gaussians = Gaussians::with_capacity(0, COUNT);
    for at in 0..COUNT {
        let share = |step: f64| (at as f64 * step).fract();
        let mean_m =
            [140.0 + 40.0 * share(0.618_034), 4.0 + 14.0 * share(0.754_878), 6.0 * share(0.569_84)];
        gaussians.means_m.push(mean_m);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([0.04_f32.ln(), 0.06_f32.ln(), 0.05_f32.ln()]);
        gaussians.logit_opacities.push(2.0);
        gaussians.sh.extend([0.2; 3]);
    }
    gaussians
}

/// A Gaussian before and after.
struct Changed {
    mean_m: DVec3,
    /// With degree 1; one or two, or none.
    after: Gaussians,
}

fn changed(amount: f64, seed: u64) -> Vec<Changed> {
    let spoil = Spoil::new(amount, seed, &drive()).unwrap();
    let street = street();
    (0..COUNT)
        .map(|at| {
            let after = spoil.apply(&street.select(at..at + 1));
            Changed { mean_m: DVec3::from_array(street.means_m[at]), after }
        })
        .collect()
}

impl Changed {
    fn moved_m(&self) -> Option<DVec3> {
        let mean_m = self.after.means_m.first()?;
        Some(DVec3::from_array(*mean_m) - self.mean_m)
    }

    /// How the first channel changes with the direction of a view: the colour's slope along x, y
    /// and z, without C1.
    fn slope(&self) -> Option<DVec3> {
        if self.after.is_empty() {
            return None;
        }
        // Three channels of the mean colour, then three of each coefficient of -y, z and -x.
        let of = |coefficient: usize| f64::from(self.after.sh[3 * coefficient]);
        Some(DVec3::new(-of(3), -of(1), of(2)))
    }

    fn is_needle(&self) -> bool {
        self.after.quats_wxyz.first().is_some_and(|quat| *quat != [1.0, 0.0, 0.0, 0.0])
    }

    fn axes(&self, at: usize) -> [DVec3; 3] {
        let [w, x, y, z] = self.after.quats_wxyz[at].map(f64::from);
        let turn = DQuat::from_xyzw(x, y, z, w);
        [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| turn * axis)
    }
}

/// Where the line from a Gaussian in a direction is as high as the cameras; `None` if it is level.
fn eye_m(mean_m: DVec3, direction: DVec3) -> Option<DVec3> {
    (direction.z.abs() > 0.02).then(|| mean_m + direction * ((EYE_M - mean_m.z) / direction.z))
}

/// Whether a place is one that the cameras saw a Gaussian from: the side cameras are 0.3 m beside
/// the middle, and they were behind it by 4 m and 0.8 times its distance from the drive: at the
/// next keyframe after that, from the keyframe that is nearest to it, 0.5 m from the next.
fn saw(eye_m: DVec3, mean_m: DVec3, within_m: f64) -> bool {
    let distance_m = DVec3::new(0.0, mean_m.y, mean_m.z - EYE_M).length();
    let before_m = 4.0 + 0.8 * distance_m;
    let off_m = eye_m - DVec3::new(mean_m.x - before_m, 0.3, EYE_M);
    off_m.x.abs() <= 0.75 + within_m && off_m.y.abs() <= within_m
}

#[test]
fn gaussians_move_along_the_rays_of_the_drive_and_keep_their_size_in_the_image() {
    let mut compared = 0;
    for one in changed(1.0, 3) {
        let Some(moved_m) = one.moved_m().filter(|moved_m| moved_m.length() > 0.02) else {
            continue;
        };
        if let Some(eye_m) = eye_m(one.mean_m, moved_m.normalize()) {
            assert!(saw(eye_m, one.mean_m, 0.02), "{} from {eye_m}", one.mean_m);
            let ray_m = one.mean_m - eye_m;
            let growth = 1.0 + moved_m.dot(ray_m.normalize()) / ray_m.length();
            assert!((growth - 1.0).abs() <= 0.0141, "{growth}");
            if !one.is_needle() {
                let ratio = f64::from(one.after.ln_scales[0][0].exp()) / 0.04;
                assert!((ratio - growth).abs() < 1e-4, "{ratio}, not {growth}");
            }
            compared += 1;
        }
    }
    assert!(compared > COUNT / 4, "{compared}");
}

#[test]
fn colours_change_across_the_plane_of_the_drive_and_not_along_its_rays() {
    let mut sum = 0.0;
    let mut count = 0.0;
    for one in changed(0.5, 3) {
        let Some(slope) = one.slope() else { continue };
        // The direction in which the drive saw it, and the drive's own, span the plane.
        let to_drive = DVec3::new(0.0, 0.3 - one.mean_m.y, EYE_M - one.mean_m.z);
        let normal = DVec3::X.cross(to_drive).normalize();
        let along = slope.dot(DVec3::X).abs().max(slope.dot(to_drive.normalize()).abs());
        assert!(along <= 1e-3 * slope.length() + 1e-6, "{slope} at {}", one.mean_m);
        sum += slope.dot(normal).abs();
        count += 1.0;
    }
    // C1 = 0.4886; the slope is up to 4 times the amount.
    let mean = sum / count;
    assert!((0.2..2.0).contains(&mean), "{mean}");
}

#[test]
fn shares_of_lost_gaussians_needles_and_sheets_are_those_of_the_amount() {
    for amount in [0.5, 1.0] {
        let all = changed(amount, 3);
        let share = |of: &dyn Fn(&Changed) -> bool| {
            all.iter().filter(|one| of(one)).count() as f64 / COUNT as f64 / amount
        };
        let lost = share(&|one| one.after.is_empty());
        assert!((0.012..0.028).contains(&lost), "{lost} of 0.02 at {amount}");
        let needles = share(&|one| one.is_needle());
        assert!((0.035..0.065).contains(&needles), "{needles} of 0.05 at {amount}");
        let sheets = share(&|one| one.after.len() == 2);
        assert!((0.042..0.075).contains(&sheets), "{sheets} of 0.06 at {amount}");
    }
}

#[test]
fn needles_lie_along_the_ray_and_sheets_stand_on_it_before_the_gaussian() {
    let [mut needles, mut sheets] = [0, 0];
    for one in changed(1.0, 3) {
        if one.is_needle() {
            let [long, ..] = one.axes(0);
            let scales = one.after.ln_scales[0].map(|ln| f64::from(ln.exp()));
            // A Gaussian of 5 cm in the middle becomes up to 4 times as long.
            let is_long = scales[0] >= 0.049 && scales[0] <= 0.21;
            assert!(is_long && scales[1] < 0.036 && scales[2] < 0.036, "{scales:?}");
            if let Some(eye_m) = eye_m(one.mean_m, long) {
                assert!(saw(eye_m, one.mean_m, 0.1), "{} from {eye_m}", one.mean_m);
                needles += 1;
            }
        }
        if one.after.len() == 2 {
            let sheet_m = DVec3::from_array(one.after.means_m[1]);
            let toward = sheet_m - one.mean_m;
            if let Some(eye_m) = eye_m(one.mean_m, toward.normalize()) {
                assert!(saw(eye_m, one.mean_m, 0.05), "{} from {eye_m}", one.mean_m);
                let share = sheet_m.distance(eye_m) / one.mean_m.distance(eye_m);
                assert!((0.49..0.96).contains(&share), "{share}");
                // Thin across the plane of the drive, so that the drive sees its edge.
                let [.., thin] = one.axes(1);
                let ray = (one.mean_m - eye_m).normalize();
                assert!(thin.dot(ray).abs() < 0.01 && thin.x.abs() < 0.01, "{thin}");
                let scales = one.after.ln_scales[1].map(|ln| f64::from(ln.exp()));
                assert!(scales[0] > 0.05 && scales[2] < 0.003, "{scales:?}");
                sheets += 1;
            }
        }
    }
    assert!(needles > 100 && sheets > 100, "{needles} needles, {sheets} sheets");
}

#[test]
fn twice_the_amount_is_twice_the_damage_and_another_seed_another_one() {
    let [half, whole, other] = [(0.5, 3), (1.0, 3), (1.0, 4)].map(|(k, seed)| changed(k, seed));
    let mut compared = 0;
    for ((half, whole), other) in half.iter().zip(&whole).zip(&other) {
        let all = [half, whole, other].map(|one| one.moved_m().zip(one.slope()));
        let [Some((half_m, half_slope)), Some((whole_m, whole_slope)), Some((_, slope))] = all
        else {
            continue;
        };
        // Unless it would have left its cell.
        if half_m.length() < 1e-3 || whole_m.length() < 1e-3 {
            continue;
        }
        assert!((whole_m - 2.0 * half_m).length() < 1e-9, "{half_m} and {whole_m}");
        assert!((whole_slope - 2.0 * half_slope).length() < 1e-4 * whole_slope.length() + 1e-6);
        assert!((slope - whole_slope).length() > 1e-6, "another seed");
        compared += 1;
    }
    assert!(compared > COUNT / 2, "{compared}");
    let is_lost = |one: &Changed| one.after.is_empty();
    let lost_alike = whole.iter().zip(&other).filter(|(a, b)| is_lost(a) && is_lost(b)).count();
    // 2 % of 2 % of them by chance: 2.4.
    assert!(lost_alike < 15, "{lost_alike} are lost with either seed");
    let moved_alike = whole.iter().zip(&other).filter(|(a, b)| {
        let both = a.moved_m().zip(b.moved_m());
        both.is_some_and(|(a, b)| a.distance(b) < 1e-6 && a.length() > 1e-3)
    });
    assert_eq!(moved_alike.count(), 0, "another seed moves all others");
}

#[test]
fn neighbours_move_alike_and_others_do_not() {
    let spoil = Spoil::new(1.0, 3, &drive()).unwrap();
    let growth = |mean_m: [f64; 3]| {
        let mut one = street().select(0..1);
        one.means_m[0] = mean_m;
        let after = spoil.apply(&one);
        let moved = DVec3::from_array(*after.means_m.first()?) - DVec3::from_array(mean_m);
        Some(moved.dot(DVec3::new(1.0, 0.8, 0.0)))
    };
    let [mut near, mut far] = [0.0, 0.0];
    let mut count = 0.0;
    for at in 0..400 {
        let x_m = 141.0 + 0.09 * f64::from(at);
        let all = [[x_m, 9.0, 2.5], [x_m + 0.05, 9.0, 2.5], [x_m + 3.0, 9.0, 2.5]].map(growth);
        let [Some(here), Some(beside), Some(away)] = all else { continue };
        near += (here - beside).abs();
        far += (here - away).abs();
        count += 1.0;
    }
    assert!(count > 300.0 && near < 0.3 * far, "{near} and {far} of {count}");
}
