use std::fs;
use std::sync::Arc;

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::View;
use wildcity_scene::chunk::{Partition, column};
use wildcity_scene::geometry::Camera;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_scene::{Chunk, Gaussians, RecordFormat, Scene, lod};
use wildcity_twin::store::{Catalog, StorageOptions};

use crate::images::view_along;
use crate::{commit, decibels, eyes, stored, streets, tau};

/// Blocks of a scene at full detail.
fn blocks(scene: &Gaussians) -> Vec<Chunk> {
    let Partition { cells, order } = Partition::new(&scene.means_m);
    let block = |(cell, run): (&wildcity_scene::chunk::CellRun, std::ops::Range<usize>)| {
        let mut chunk = Chunk::new(cell.cell, cell.origin_m, scene.sh_degree, run.len());
        for &index in &order[run] {
            chunk.push(&cell.record(scene, index as usize));
        }
        chunk
    };
    let runs = cells.iter().flat_map(|cell| cell.blocks.iter().map(move |b| (cell, b.1.clone())));
    runs.map(block).collect()
}

/// Centre, largest standard deviation, and opacity x area.
fn moments(chunk: &Chunk) -> Vec<(DVec3, f64, f64)> {
    let moment = |index: usize| {
        let value = |column| f64::from(chunk.value(index, column));
        let mean = DVec3::new(value(0), value(1), value(2));
        let [a, b, c] = [0, 1, 2].map(|axis| value(column::SCALE + axis));
        let weight = value(column::LOG2_OPACITY).exp2() * (a * b + b * c + c * a);
        (mean, a.max(b).max(c), weight)
    };
    (0..chunk.len()).map(moment).collect()
}

#[test]
fn tau_zero_is_level_zero_everywhere() {
    let (scene, views) = streets::demo_street();
    let resident = stored(&scene, RecordFormat::F32, true);
    let drawn = resident.scene(&eyes(&views), &tau(0.0));
    assert_eq!(drawn.gaussians(), scene.len());
    let db = decibels(&drawn, &Scene::from_gaussians(&scene), &views);
    assert_eq!(db, f64::INFINITY, "the same bits as the scene in memory");
}

#[test]
fn a_pixel_of_error_is_hardly_seen_on_the_street() {
    // All six cameras at a quarter of their size: at their full size, a pixel is so small that
    // hardly anything of a street of 300 m is merged.
    let (scene, _) = streets::demo_street();
    let views = quarter_rig();
    let truth = Scene::from_gaussians(&scene);
    let resident = stored(&scene, RecordFormat::F32, true);
    let mut before = scene.len();
    for (tau_px, wanted_db) in [(1.0, 45.0), (2.0, 41.0), (4.0, 37.0), (8.0, 33.0)] {
        let drawn = resident.scene(&eyes(&views), &tau(tau_px));
        let db = decibels(&drawn, &truth, &views);
        eprintln!("tau {tau_px}: {db:.2} dB, {} drawn", drawn.gaussians());
        assert!(db >= wanted_db, "tau {tau_px}: {db:.1} dB");
        assert!(drawn.gaussians() < before, "tau {tau_px}: {} drawn", drawn.gaussians());
        before = drawn.gaussians();
    }
    assert!(before < scene.len() / 2, "{before} of {}", scene.len());
}

/// The demo's six cameras, 60 m along its street, at a quarter of their size.
fn quarter_rig() -> Vec<View> {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let world_from_rig = street.trajectory.at_station(60.0);
    let view = |mounted: &RigCamera| {
        let Camera { width_px, height_px, .. } = mounted.camera;
        let quarter = mounted.camera.scaled((width_px / 4).into(), (height_px / 4).into());
        View::new(quarter.unwrap(), world_from_rig * mounted.rig_from_camera)
    };
    Rig::preset("vehicle6").unwrap().cameras.iter().map(view).collect()
}

#[test]
fn every_level_keeps_its_error_bound() {
    let (scene, _) = streets::demo_street();
    let mut checked = 0;
    for block in blocks(&scene).iter().filter(|block| block.len() > 500).step_by(9) {
        let leaves = moments(block);
        let whole: f64 = leaves.iter().map(|leaf| leaf.2).sum();
        let mut error_m = 0.0;
        let mut count = block.len();
        for level in lod::levels(block) {
            assert!(level.error_m >= error_m && level.chunk.len() < count);
            error_m = level.error_m;
            count = level.chunk.len();
            let nodes = moments(&level.chunk);
            // Opacity times area is conserved.
            let now: f64 = nodes.iter().map(|node| node.2).sum();
            assert!((now / whole - 1.0).abs() < 1e-4, "{now} of {whole}");
            // Each Gaussian has a near and wide enough one that represents it.
            for (mean, sigma, _) in &leaves {
                let nearest = nodes.iter().map(|(node, node_sigma, _)| {
                    node.distance(*mean) + 3.0 * (sigma - node_sigma).max(0.0)
                });
                let nearest = nearest.fold(f64::INFINITY, f64::min);
                assert!(nearest <= f64::from(error_m) + 1e-5, "{nearest} m, not {error_m} m");
            }
            checked += 1;
        }
    }
    assert!(checked > 20, "{checked} levels");
}

/// Stacks of Gaussians: a faint one is only the tip of its bell, and one in place of all of them would
/// show what they cut off. A level is seen at the distance at which its stated error is a pixel.
#[test]
fn stacks_of_faint_gaussians_state_what_their_merger_shows() {
    let stacks: [&[(usize, f64)]; 10] = [
        &[(300, 0.004)],
        &[(300, 0.02)],
        &[(3_000, 0.008)],
        &[(20_000, 0.01)],
        &[(100_000, 0.006)],
        &[(100, 0.14)],
        &[(2_000, 0.5)],
        &[(1, 0.9), (1_000, 0.005)],
        &[(20, 0.6), (300, 0.03), (5_000, 0.004)],
        &[(64, 0.97)],
    ];
    let mut checked = 0;
    for parts in stacks {
        let logit = |opacity: f64| (opacity / (1.0 - opacity)).ln() as f32;
        let logit_opacities: Vec<f32> =
            parts.iter().flat_map(|&(count, opacity)| vec![logit(opacity); count]).collect();
        let count = logit_opacities.len();
        let stack = Gaussians {
            sh_degree: 0,
            means_m: vec![[1.0, 2.0, 3.0]; count],
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; count],
            ln_scales: vec![[0.3_f32.ln(); 3]; count],
            logit_opacities,
            sh: vec![1.0; 3 * count],
            ..Gaussians::default()
        };
        let scene = Scene::from_gaussians(&stack);
        let full = &scene.chunks[0];
        for level in lod::levels(full) {
            // 24 px for the standard deviation at most, so that the image has all of the bell;
            // farther if its error allows no more.
            let focal_px = 160.0;
            let distance_m = (focal_px * f64::from(level.error_m)).max(2.0);
            let at = DVec3::new(1.0, 2.0, 3.0) - distance_m * DVec3::Z;
            let view = view_along([200, 200], focal_px, at, DVec3::Z, DVec3::Y);
            let coarse = Scene { chunks: vec![Arc::new(level.chunk.clone())], ..Scene::default() };
            let db = decibels(&coarse, &scene, &[view]);
            let error_m = level.error_m;
            let left = level.chunk.len();
            eprintln!("{parts:?}: {left} at {error_m} m: {db:.1} dB");
            // 19 dB if the edge of a white disc of 75 px is wrong by the stated pixel.
            assert!(db > 25.0, "{parts:?}, {left} left at {error_m} m: {db:.1} dB");
            checked += 1;
        }
    }
    assert!(checked >= 20, "{checked} levels");
}

#[test]
fn levels_are_the_same_bytes_at_any_thread_count() {
    let scene = streets::street(60_000, 1, 3);
    let hash = |threads: usize| {
        let dir = tempfile::tempdir().unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let version =
            pool.install(|| commit(dir.path(), &scene, StorageOptions::default())).unwrap();
        assert!(version.manifest.chunks.iter().any(|c| c.sections.iter().any(|s| s.level > 2)));
        version.hash
    };
    let wanted = hash(1);
    for threads in [2, 3, 16] {
        assert_eq!(hash(threads), wanted, "{threads} threads");
    }
}

#[test]
fn a_section_is_read_by_itself() {
    let dir = tempfile::tempdir().unwrap();
    let scene = streets::street(30_000, 1, 1);
    let version = commit(dir.path(), &scene, StorageOptions::default()).unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let chunk = version.manifest.chunks.iter().max_by_key(|chunk| chunk.sections.len()).unwrap();
    let path = dir.path().join("street/objects").join(&chunk.object[..2]).join(&chunk.object);
    let mut bytes = fs::read(&path).unwrap();

    // Coarse levels come first, and no section touches a page without need.
    let mut by_place = chunk.sections.clone();
    by_place.sort_by_key(|section| section.offset_bytes);
    assert!(by_place.is_sorted_by_key(|section| std::cmp::Reverse(section.level)));
    for section in &by_place {
        let first = section.offset_bytes / 4096;
        let last = (section.offset_bytes + u64::from(section.bytes) - 1) / 4096;
        assert!(last - first <= u64::from(section.bytes) / 4096, "{section:?}");
        assert!(section.bytes < 4096 || section.offset_bytes % 4096 == 0, "{section:?}");
    }

    // Only the damaged section fails.
    let damaged = by_place[by_place.len() / 2];
    bytes[damaged.offset_bytes as usize + 9] ^= 1;
    fs::write(&path, bytes).unwrap();
    for section in &chunk.sections {
        let read = catalog.section(&version, chunk, section);
        if *section == damaged {
            let said = read.unwrap_err().to_string();
            let place = format!("block {}, level {}: its bytes", section.block, section.level);
            assert!(said.contains(&place), "{said}");
        } else {
            assert_eq!(read.unwrap().len(), section.count as usize);
        }
    }
}
