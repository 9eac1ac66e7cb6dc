//! Cities: every cell once, no seam in the road, and nothing that grows with the length.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use wildcity_generate::{Cell, CitySettings, GenerateError, city, city_drive};
use wildcity_scene::chunk;

use super::digest;

/// Three streets, thin.
const FEW: CitySettings =
    CitySettings { seed: 7, length_m: 520.0, millions_per_km: 1.0, speed_m_s: 30.0 };

fn cells(settings: &CitySettings, threads: usize) -> Vec<Cell> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| city(settings).unwrap().collect())
}

#[test]
fn every_cell_comes_once_with_all_that_is_in_it_on_any_number_of_threads() {
    let one = cells(&FEW, 1);
    let named: BTreeSet<[i32; 2]> = one.iter().map(|cell| cell.cell).collect();
    assert_eq!(named.len(), one.len(), "a cell came twice");
    for Cell { cell, gaussians } in &one {
        assert!(gaussians.means_m.iter().all(|mean_m| chunk::cell_at(mean_m) == *cell));
    }
    // The streets beyond both ends come on top.
    let count: usize = one.iter().map(|cell| cell.gaussians.len()).sum();
    let expected = FEW.gaussians() as f64;
    assert!((0.9..1.4).contains(&(count as f64 / expected)), "{count} of {expected}");

    let three = cells(&FEW, 3);
    let of = |cells: &[Cell]| -> BTreeMap<[i32; 2], blake3::Hash> {
        cells.iter().map(|cell| (cell.cell, digest(&cell.gaussians))).collect()
    };
    assert_eq!(of(&one), of(&three));
    assert_ne!(of(&one), of(&cells(&CitySettings { seed: 8, ..FEW }, 1)));
}

#[test]
fn the_road_has_no_hole_where_streets_meet() {
    let drive = city_drive(&FEW).unwrap();
    let mut means_m: Vec<DVec3> = cells(&FEW, 2)
        .iter()
        .flat_map(|cell| &cell.gaussians.means_m)
        .map(|m| (*m).into())
        .collect();
    means_m.retain(|mean_m| mean_m.z.abs() < 0.02);
    means_m.sort_by(|a, b| a.x.total_cmp(&b.x));
    for keyframe in &drive.keyframes {
        let at_m = keyframe.world_from_rig.position_m;
        let [from, to] = [-0.5, 0.5].map(|d_m| means_m.partition_point(|m| m.x < at_m.x + d_m));
        let near = means_m[from..to].iter().filter(|mean_m| mean_m.distance(at_m) < 0.5).count();
        assert!(near >= 2, "{near} surfels around {at_m}");
    }
}

#[test]
fn the_drive_is_even_at_any_distance_and_never_comes_back() {
    let settings = CitySettings { length_m: 100_000.0, ..FEW };
    let drive = city_drive(&settings).unwrap();
    assert_eq!(drive.check(), Ok(()));
    let length_m = drive.length_m();
    assert!((length_m - (settings.length_m - 16.0)).abs() < 60.0, "{length_m} m");
    for (index, pair) in drive.keyframes.windows(2).enumerate() {
        let [from, to] = [pair[0].world_from_rig, pair[1].world_from_rig];
        let step_m = to.position_m - from.position_m;
        assert!((step_m.length() - 0.5).abs() < 1e-3, "{step_m} at keyframe {index}");
        assert!((from.rotation * DVec3::X).angle_between(step_m) < 0.005, "keyframe {index}");
        // Always to the east: the cosine of 0.82 rad is 0.68.
        assert!(step_m.x > 0.67 * 0.5, "{step_m} at keyframe {index}");
    }
    // 0.5 m at 30 m/s, without a rounding that adds up.
    let last = drive.keyframes.len() - 1;
    assert_eq!(drive.keyframes[last].time_us, (last as f64 * 5e5 / 30.0).round() as i64);
}

#[test]
fn settings_out_of_range_are_named() {
    let refused = |settings: CitySettings| match (city(&settings), city_drive(&settings)) {
        (Err(GenerateError::Setting { field, .. }), Err(_)) => field,
        _ => "none",
    };
    assert_eq!(refused(CitySettings { length_m: 99.0, ..FEW }), "length_m");
    assert_eq!(refused(CitySettings { length_m: 500.5, ..FEW }), "length_m");
    assert_eq!(refused(CitySettings { length_m: f64::NAN, ..FEW }), "length_m");
    assert_eq!(refused(CitySettings { millions_per_km: 0.0, ..FEW }), "millions_per_km");
    assert_eq!(refused(CitySettings { speed_m_s: f64::INFINITY, ..FEW }), "speed_m_s");
    assert_eq!(refused(FEW), "none");
}
