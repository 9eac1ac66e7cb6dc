use wildcity_render::View;
use wildcity_scene::chunk::{CellRun, Partition, column, columns};
use wildcity_scene::record::Clamped;
use wildcity_scene::{Chunk, Gaussians, LanePages, RecordFormat, Scene};
use wildcity_twin::store::{StorageOptions, StoreError};

use crate::{commit, data, decibels, eyes, scene_files, stored, streets, tau};

/// Least PSNR of an image with each record, in dB.
const WANTED_DB: [(RecordFormat, f64); 4] = [
    (RecordFormat::F32, f64::INFINITY),
    (RecordFormat::H52, 75.0),
    (RecordFormat::Q32, 60.0),
    (RecordFormat::Q24, 45.0),
];

/// Stores a scene in every record, and compares what these views see of it.
fn every_record_keeps(scene: &Gaussians, views: &[View], what: &str) {
    let truth = Scene::from_gaussians(scene);
    for (record, wanted) in WANTED_DB {
        let resident = stored(scene, record, false);
        let db = decibels(&resident.scene(&eyes(views), &tau(0.0)), &truth, views);
        assert!(db >= wanted, "{record}, {what}: {db:.1} dB");
    }
}

#[test]
fn every_record_keeps_the_image_at_every_degree() {
    let views = streets::street_views();
    for sh_degree in 0..=3 {
        let scene = streets::street(20_000, sh_degree, 1);
        every_record_keeps(&scene, &views, &format!("degree {sh_degree}"));
    }
}

#[test]
fn every_record_keeps_the_demo_street() {
    let (scene, views) = streets::demo_street();
    every_record_keeps(&scene, &views, "the demo street");
}

#[test]
fn every_record_keeps_a_capture() {
    let Some(path) = data::real("scenes/skull/skull.ply") else { return };
    let camera = data::real("reference/skull_front.camera.json").unwrap();
    let camera = wildcity_twin::ingest::cameras::read(&camera).unwrap().remove(0);
    let views = [View::new(camera.camera, camera.world_from_camera)];
    let scene = wildcity_twin::ingest::read(&path, &mut |_, _| {}).unwrap();
    every_record_keeps(&scene, &views, "skull");
}

#[test]
fn records_take_the_bits_of_their_names() {
    for (record, degree_1, degree_3) in [
        (RecordFormat::F32, 8 * 92, 8 * 236),
        (RecordFormat::H52, 8 * 52, 8 * 124),
        (RecordFormat::Q32, 8 * 32 - 1, 543),
        (RecordFormat::Q24, 8 * 24, 372),
    ] {
        assert_eq!((record.bits(1), record.bits(3)), (degree_1, degree_3), "{record}");
        assert_eq!(record.name().parse::<RecordFormat>().unwrap(), record);
    }
    let said = "q16".parse::<RecordFormat>().unwrap_err();
    assert!(said.contains("the records are f32, h52, q32, q24"), "{said}");
}

/// One block that was coded and decoded.
fn coded(scene: &Gaussians, record: RecordFormat) -> (Chunk, Chunk, Clamped) {
    let Partition { cells, order } = Partition::new(&scene.means_m);
    let cell: &CellRun = &cells[0];
    let mut chunk = Chunk::new(cell.cell, cell.origin_m, scene.sh_degree, cell.run.len());
    for &index in &order[cell.run.clone()] {
        chunk.push(&cell.record(scene, index as usize));
    }
    let mut clamped = Clamped::default();
    let part = record.encode(&chunk, 0..chunk.len(), &mut clamped);
    assert_eq!(part.len(), record.part_bytes(scene.sh_degree, chunk.len()));
    let mut lanes = LanePages::new(columns(scene.sh_degree), None);
    record.decode(&part, scene.sh_degree, chunk.len(), &mut lanes).unwrap();
    let again = Chunk::from_lanes(cell.cell, cell.origin_m, scene.sh_degree, chunk.len(), lanes);
    (chunk, again, clamped)
}

#[test]
fn zero_stays_zero_and_flat_stays_flat() {
    let mut scene = scene_files::gaussians(1_000, 3, 20.0, 1);
    scene.means_m.iter_mut().for_each(|mean| mean[2] = 0.0);
    scene.means_m[17][2] = 6.7;
    for (index, sh) in scene.sh.iter_mut().enumerate() {
        if index % 3 != 0 {
            *sh = 0.0;
        }
    }
    for record in RecordFormat::ALL {
        let (chunk, again, clamped) = coded(&scene, record);
        assert_eq!(clamped.worst().map_or(0, |(_, count)| count), 0);
        let mut zeros = 0;
        for index in 0..chunk.len() {
            for column in (column::MEAN..column::SCALE).chain(column::SH..columns(3)) {
                if chunk.value(index, column) == 0.0 {
                    assert_eq!(again.value(index, column), 0.0, "{record}, column {column}");
                    zeros += 1;
                }
            }
        }
        assert!(zeros > 30_000, "{zeros}");
    }
}

#[test]
fn values_are_off_by_half_a_step_at_most() {
    let scene = scene_files::gaussians(1_000, 1, 6.0, 1);
    let (chunk, again, _) = coded(&scene, RecordFormat::Q32);
    let off = |column: usize, measure: fn(f32) -> f32| {
        let of = |index: usize| {
            measure(chunk.value(index, column)) - measure(again.value(index, column))
        };
        (0..chunk.len()).map(|index| of(index).abs()).fold(0.0, f32::max)
    };
    let widest = |column: usize, measure: fn(f32) -> f32| {
        let values = (0..chunk.len()).map(|index| measure(chunk.value(index, column)));
        let (low, high) = values.fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(v), h.max(v)));
        high - low
    };
    // Centres: a power of two at most twice as wide as 2^-23 of 12 m. Scales: 10 bits of the range
    // of all three axes, opacity: 10 bits; 1 % for what the rounding of f32 adds.
    assert!(off(column::MEAN, |m| m) <= 2.0_f32.powi(-20), "{}", off(column::MEAN, |m| m));
    let range = (0..3).map(|axis| widest(column::SCALE + axis, f32::ln)).fold(0.0, f32::max);
    assert!(off(column::SCALE, f32::ln) <= 1.3 * range / 1022.0 / 2.0);
    let range = widest(column::LOG2_OPACITY, f32::exp2);
    assert!(off(column::LOG2_OPACITY, f32::exp2) <= 1.01 * range / 1022.0 / 2.0);
    for index in 0..chunk.len() {
        let quat =
            |chunk: &Chunk| [0, 1, 2, 3].map(|k| f64::from(chunk.value(index, column::QUAT + k)));
        let dot: f64 = quat(&chunk).iter().zip(quat(&again)).map(|(a, b)| a * b).sum();
        // Half the angle between the two: three components off by 0.7e-3, and what follows of it.
        assert!(dot.abs() > 1.0 - 3e-6, "{index}: {dot}");
    }
}

#[test]
fn what_a_record_cannot_hold_is_counted_and_refused_with_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = scene_files::gaussians(20_000, 1, 20.0, 1);
    let storage = StorageOptions { record: RecordFormat::Q32, levels: false };
    // Two of 20,000 are 0.01 %: as many as may be.
    (scene.sh[5], scene.sh[12 + 4]) = (900.0, -900.0);
    commit(dir.path(), &scene, storage).unwrap();
    scene.sh[24 + 7] = 17.0;
    match commit(dir.path(), &scene, storage).unwrap_err() {
        StoreError::Clamped { field, count, gaussians, .. } => {
            assert_eq!((field, count, gaussians), ("SH degree 1", 3, 20_000));
        }
        error => panic!("{error}"),
    }
    assert_eq!(
        wildcity_twin::store::Catalog::open(dir.path()).unwrap().twins().unwrap().twins[0].number,
        1
    );
    commit(dir.path(), &scene, StorageOptions { record: RecordFormat::H52, levels: false })
        .unwrap();
}

#[test]
fn a_part_of_another_size_is_refused() {
    let scene = scene_files::gaussians(100, 1, 6.0, 1);
    let (chunk, ..) = coded(&scene, RecordFormat::Q24);
    let part = RecordFormat::Q24.encode(&chunk, 0..100, &mut Clamped::default());
    let mut lanes = LanePages::new(columns(1), None);
    for wrong in [&part[1..], &[part.as_slice(), &[0]].concat()[..], &[]] {
        let said = RecordFormat::Q24.decode(wrong, 1, 100, &mut lanes).unwrap_err();
        assert!(said.starts_with("100 Gaussians take "), "{said}");
        assert!(lanes.is_empty());
    }
}
