//! The demo street, and cities: the same every time, within the bounds of a twin, drivable, and
//! closed.

#[path = "../support/root.rs"]
mod root;

mod align;
mod city;
mod drive;
mod pictures;
mod scenarios;
mod spoil;
mod spoil_rays;

use std::sync::LazyLock;

use wildcity_generate::{GenerateError, Street, StreetSettings, street};
use wildcity_scene::Gaussians;

/// The street of `scenes/demo.json`, made once for all tests.
static DEMO: LazyLock<Street> =
    LazyLock::new(|| street(&StreetSettings::default()).expect("the default settings hold"));

#[test]
fn the_same_settings_give_the_same_bytes() {
    let again = street(&StreetSettings::default()).unwrap();
    assert_eq!(digest(&again.gaussians), digest(&DEMO.gaussians));
    assert_eq!(again.trajectory, DEMO.trajectory);
}

#[test]
fn another_seed_is_another_street() {
    let settings = StreetSettings { seed: 21, density: 0.2, ..StreetSettings::default() };
    let first = street(&settings).unwrap();
    let second = street(&StreetSettings { seed: 22, ..settings }).unwrap();
    assert_ne!(digest(&first.gaussians), digest(&second.gaussians));
    // The drive does not depend on the seed.
    assert_eq!(first.trajectory, second.trajectory);
}

#[test]
fn there_are_enough_gaussians_and_density_scales_them() {
    let count = DEMO.gaussians.len();
    assert!((300_000..600_000).contains(&count), "{count}");
    let sparse = StreetSettings { density: 0.25, ..StreetSettings::default() };
    let fewer = street(&sparse).unwrap().gaussians.len();
    // Leaves and windows do not get fewer, surfaces do.
    assert!(fewer < count * 3 / 4, "{fewer} of {count}");
}

#[test]
fn every_value_is_within_the_bounds_of_a_twin() {
    let Gaussians { sh_degree, means_m, quats_wxyz, ln_scales, logit_opacities, sh, classes } =
        &DEMO.gaussians;
    let count = means_m.len();
    assert_eq!(*sh_degree, 1);
    assert_eq!(
        [quats_wxyz.len(), ln_scales.len(), logit_opacities.len(), sh.len()],
        [count, count, count, 12 * count]
    );
    for index in 0..count {
        assert!(means_m[index].iter().all(|m| m.abs() < 1e3), "mean {index}");
        assert!(ln_scales[index].iter().all(|ln| (-30.0..=10.0).contains(ln)), "scale {index}");
        let length = quats_wxyz[index].iter().map(|q| q * q).sum::<f32>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "quaternion {index} of length {length}");
        assert!((0.0..10.0).contains(&logit_opacities[index]), "opacity {index}");
    }
    assert_eq!(classes.as_ref().map(Vec::len), Some(count));
    assert!(sh.iter().all(|c| c.abs() < 1e3));
    // Glass and asphalt depend on the view.
    let glossy = sh.chunks_exact(12).filter(|sh| sh[3..].iter().any(|&c| c != 0.0)).count();
    assert!(glossy > count / 10, "{glossy}");
}

#[test]
fn settings_out_of_range_are_named() {
    let good = StreetSettings::default();
    let refused = |settings: StreetSettings| match street(&settings) {
        Err(GenerateError::Setting { field, .. }) => field,
        Ok(_) => "none",
    };
    assert_eq!(refused(StreetSettings { length_m: f64::NAN, ..good.clone() }), "length_m");
    assert_eq!(refused(StreetSettings { length_m: 1e6, ..good.clone() }), "length_m");
    assert_eq!(refused(StreetSettings { crossing_m: 290.0, ..good.clone() }), "crossing_m");
    assert_eq!(refused(StreetSettings { density: 0.0, ..good }), "density");
}

fn digest(gaussians: &Gaussians) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(bytemuck::cast_slice(&gaussians.means_m));
    hasher.update(bytemuck::cast_slice(&gaussians.quats_wxyz));
    hasher.update(bytemuck::cast_slice(&gaussians.ln_scales));
    hasher.update(bytemuck::cast_slice(&gaussians.logit_opacities));
    hasher.update(bytemuck::cast_slice(&gaussians.sh));
    let classes = gaussians.classes.iter().flatten();
    hasher.update(&classes.map(|class| class.value()).collect::<Vec<u8>>());
    hasher.finalize()
}
