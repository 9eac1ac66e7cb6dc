use glam::DVec3;
use wildcity_scene::{Manifest, RenderProfile};
use wildcity_twin::residency::{BlockIndex, SectionRef, Viewpoint};
use wildcity_twin::store::StorageOptions;

use crate::{commit, streets, tau};

fn manifest() -> Manifest {
    let dir = tempfile::tempdir().unwrap();
    let (scene, _) = streets::demo_street();
    commit(dir.path(), &scene, StorageOptions::default()).unwrap().manifest
}

fn demand(
    manifest: &Manifest,
    viewpoints: &[Viewpoint],
    profile: &RenderProfile,
) -> Vec<SectionRef> {
    BlockIndex::new(manifest).demand(manifest, viewpoints, profile)
}

fn eye(x: f64, focal_px: f64) -> Viewpoint {
    Viewpoint { position_m: DVec3::new(x, 0.0, 1.6), focal_px }
}

fn gaussians(manifest: &Manifest, needed: &[SectionRef]) -> u64 {
    let count = |n: &SectionRef| u64::from(manifest.chunks[n.chunk].sections[n.section].count);
    needed.iter().map(count).sum()
}

fn levels(manifest: &Manifest, needed: &[SectionRef]) -> Vec<u8> {
    needed.iter().map(|n| manifest.chunks[n.chunk].sections[n.section].level).collect()
}

#[test]
fn every_view_has_one_level_of_every_block_of_its_own() {
    let manifest = manifest();
    let blocks: usize = manifest
        .chunks
        .iter()
        .map(|chunk| chunk.sections.iter().filter(|section| section.level == 0).count())
        .sum();
    let index = BlockIndex::new(&manifest);
    let all = index.demand(&manifest, &[eye(60.0, 1800.0)], &tau(0.0));
    assert_eq!(all.len(), blocks);
    assert!(all.is_sorted());
    assert!(levels(&manifest, &all).iter().all(|&level| level == 0));
    assert_eq!(gaussians(&manifest, &all), manifest.gaussians());

    for tau_px in [0.5, 1.0, 4.0, 16.0] {
        let eyes = [eye(60.0, 1800.0), eye(70.0, 900.0)];
        let selected = index.select(&manifest, &eyes, &tau(tau_px)).unwrap();
        assert_eq!(selected.sections, index.demand(&manifest, &eyes, &tau(tau_px)));
        assert!(selected.sections.is_sorted());
        for (view, eye) in eyes.into_iter().enumerate() {
            let own = selected.iter().filter(|(_, views)| views.contains(view));
            let own: Vec<SectionRef> = own.map(|(section, _)| section).collect();
            assert_eq!(own, index.demand(&manifest, &[eye], &tau(tau_px)), "as if it were alone");
            assert_eq!(own.len(), blocks);
            // The rule again, section by section.
            for n in &own {
                let chunk = &manifest.chunks[n.chunk];
                let section = &chunk.sections[n.section];
                let mine = chunk.sections.iter().filter(|other| other.block == section.block);
                let full = mine.clone().find(|other| other.level == 0).unwrap();
                let distance = chunk.section_bounds(full).distance_m(eye.position_m);
                let size_px = |error_m: f32| eye.focal_px * f64::from(error_m) / distance;
                assert!(section.level == 0 || size_px(section.error_m) <= tau_px);
                let coarser = mine.clone().find(|other| other.level == section.level + 1);
                assert!(coarser.is_none_or(|coarser| size_px(coarser.error_m) > tau_px));
            }
        }
    }
    let many = vec![eye(60.0, 1800.0); Viewpoint::MAX + 1];
    let refused = index.select(&manifest, &many, &tau(1.0)).unwrap_err().to_string();
    assert_eq!(refused, "a frame has at most 16 views, not 17");
}

#[test]
fn nearer_viewpoints_longer_focal_lengths_and_smaller_errors_need_more() {
    let manifest = manifest();
    let count =
        |eyes: &[Viewpoint], tau_px| gaussians(&manifest, &demand(&manifest, eyes, &tau(tau_px)));
    let here = count(&[eye(60.0, 1800.0)], 4.0);
    assert!(count(&[eye(-5_000.0, 1800.0)], 4.0) < here / 4, "far away");
    assert!(count(&[eye(60.0, 18_000.0)], 4.0) > here, "a longer lens");
    assert!(count(&[eye(60.0, 1800.0)], 2.0) > here, "a smaller error");
    assert!(count(&[eye(60.0, 1800.0), eye(250.0, 1800.0)], 4.0) > here, "eyes at both ends");
}

#[test]
fn what_is_out_of_reach_is_not_drawn() {
    let manifest = manifest();
    let eyes = [eye(60.0, 1800.0)];
    let near = RenderProfile { reach_m: Some(50.0), ..tau(0.0) };
    let needed = demand(&manifest, &eyes, &near);
    assert!(needed.len() > 5 && needed.len() < demand(&manifest, &eyes, &tau(0.0)).len() / 2);
    for n in &needed {
        let chunk = &manifest.chunks[n.chunk];
        let bounds = chunk.section_bounds(&chunk.sections[n.section]);
        assert!(bounds.distance_m(eyes[0].position_m) <= 50.0);
    }
    assert_eq!(demand(&manifest, &[], &near), [], "without a viewpoint, nothing is drawn");
}
