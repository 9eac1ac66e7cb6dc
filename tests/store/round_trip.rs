use glam::DVec3;
use wildcity_scene::chunk::columns;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Chunk, Scene, Trajectory};
use wildcity_twin::residency::{Cache, Viewpoint};
use wildcity_twin::store::{Catalog, NewVersion, StoreError, TwinListing};

use crate::scene_files::gaussians;
use crate::versions::{commit, files, street};

#[test]
fn what_is_committed_is_read_back_bit_by_bit() {
    for sh_degree in 0..=3 {
        let dir = tempfile::tempdir().unwrap();
        let mut scene = gaussians(5_000, sh_degree, 150.0, 1);
        for mean in &mut scene.means_m {
            // Far from the origin, where f32 would lose 7.8 mm.
            mean[0] += 4.5e6;
        }
        let version = commit(dir.path(), street(&scene)).unwrap();
        let catalog = Catalog::open(dir.path()).unwrap();
        assert_eq!(catalog.version("street", None).unwrap(), version);
        assert_eq!(version.manifest.gaussians(), 5_000);

        let wanted = Scene::from_gaussians(&scene);
        assert!(wanted.chunks.len() > 9, "the scene has several cells");
        assert_eq!(wanted.chunks.len(), version.manifest.chunks.len());
        for (wanted, entry) in wanted.chunks.iter().zip(&version.manifest.chunks) {
            // The cells of a scene in memory are in the same order as the blocks of a twin.
            let mut place = 0;
            for section in &entry.sections {
                let read = catalog.section(&version, entry, section).unwrap();
                assert_eq!((read.cell(), read.origin_m()), (wanted.cell(), wanted.origin_m()));
                assert_eq!((read.len(), read.sh_degree()), (section.count as usize, sh_degree));
                for index in 0..read.len() {
                    let bits = |chunk: &Chunk, index| -> Vec<u32> {
                        let values = (0..columns(sh_degree)).map(|k| chunk.value(index, k));
                        values.map(f32::to_bits).collect()
                    };
                    assert_eq!(bits(&read, index), bits(wanted, place));
                    place += 1;
                }
            }
            assert_eq!(place, wanted.len());
        }
    }
}

#[test]
fn the_same_content_is_the_same_version() {
    let one = tempfile::tempdir().unwrap();
    let two = tempfile::tempdir().unwrap();
    let scene = gaussians(2_000, 1, 100.0, 1);
    let first = commit(one.path(), street(&scene)).unwrap();
    let elsewhere = commit(two.path(), street(&scene)).unwrap();
    assert_eq!(first.hash, elsewhere.hash);
    let before = files(one.path());
    let again = commit(one.path(), street(&scene)).unwrap();
    assert_eq!(again, first, "no new version, and its time is the first one's");
    assert_eq!(files(one.path()), before);

    let mut profile = street(&scene).profile;
    profile.set("near=0.2").unwrap();
    let other = commit(one.path(), NewVersion { profile, ..street(&scene) }).unwrap();
    assert_ne!(other.hash, first.hash);
    assert_eq!((first.number, other.number), (1, 2));
    assert_eq!(
        files(one.path()).len(),
        before.len() + 2,
        "a manifest and a record: chunks are shared"
    );
    let catalog = Catalog::open(one.path()).unwrap();
    assert_eq!(catalog.version("street", Some(1)).unwrap(), first);
    assert_eq!(catalog.version("street", None).unwrap(), other);
    let listing = TwinListing { name: "street".into(), number: 2, hash: other.hash };
    assert_eq!(catalog.twins().unwrap().twins, [listing]);

    let back = commit(one.path(), street(&scene)).unwrap();
    assert_eq!((back.number, back.hash), (3, first.hash), "an old map under a new number");
}

#[test]
fn bounding_boxes_hold_three_sigma_and_chunks_their_cells() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = gaussians(1, 0, 1.0, 1);
    scene.means_m = vec![[70.0, -130.0, 5.0]];
    // A quarter turn around z: own x is the world's y.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    scene.quats_wxyz = vec![[3.0 * half, 0.0, 0.0, 3.0 * half]];
    scene.ln_scales = vec![[2.0_f32.ln(), 0.5_f32.ln(), 0.1_f32.ln()]];
    let version = commit(dir.path(), street(&scene)).unwrap();
    let entry = &version.manifest.chunks[0];
    assert_eq!(entry.cell, [1, -2]);
    let low = DVec3::new(70.0 - 1.5, -130.0 - 6.0, 5.0 - 0.3);
    let high = DVec3::new(70.0 + 1.5, -130.0 + 6.0, 5.0 + 0.3);
    assert!((entry.bounds.min_m - low).length() < 1e-5, "{:?}", entry.bounds);
    assert!((entry.bounds.max_m - high).length() < 1e-5, "{:?}", entry.bounds);
}

#[test]
fn what_cannot_be_used_is_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let good = gaussians(10, 0, 1.0, 1);
    let mut bad = good.clone();
    bad.ln_scales[3][2] = f32::NAN;
    let still = |name: &str| {
        let pose = Keyframe { time_us: 0, world_from_rig: Pose::IDENTITY };
        Trajectory { name: name.into(), keyframes: vec![pose] }
    };
    let empty = Trajectory { name: "log".into(), keyframes: Vec::new() };
    let mut profile = street(&good).profile;
    profile.blur = f64::NAN;
    let cases = [
        (NewVersion { name: "../etc", ..street(&good) }, "\"../etc\" cannot be the name of a twin"),
        (street(&bad), "Gaussian 3: ln_scales[2] is NaN"),
        (NewVersion { profile, ..street(&good) }, "profile field blur is NaN"),
        (NewVersion { trajectories: vec![empty], ..street(&good) }, "has no keyframes"),
        (
            NewVersion { trajectories: vec![still("a"), still("a")], ..street(&good) },
            "two trajectories are named \"a\"",
        ),
        (
            NewVersion { trajectories: vec![still("A B")], ..street(&good) },
            "\"A B\" is not a name of a trajectory",
        ),
    ];
    for (new, wanted) in cases {
        let text = commit(dir.path(), new).unwrap_err().to_string();
        assert!(text.contains(wanted), "{text}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}

#[test]
fn errors_for_missing_twins_and_versions_name_the_existing_ones() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(&dir.path().join("not/yet")).unwrap();
    assert_eq!(catalog.twins().unwrap().twins, []);
    let text = catalog.version("street", None).unwrap_err().to_string();
    assert!(text.starts_with("there is no twin \"street\" in") && text.ends_with("it holds none"));

    commit(dir.path(), street(&gaussians(10, 0, 1.0, 1))).unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let text = catalog.version("streat", None).unwrap_err().to_string();
    assert!(text.ends_with("it holds street"), "{text}");
    let text = catalog.version("street", Some(7)).unwrap_err().to_string();
    assert_eq!(text, "twin \"street\" has no version 7; the latest is 1");
    let error = catalog.version("../street", None).unwrap_err();
    assert!(matches!(error, StoreError::Name { .. }), "{error}");
}

#[test]
fn commits_at_once_get_numbers_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let scenes: Vec<_> = (0..4).map(|seed| gaussians(3_000, 0, 100.0, seed)).collect();
    let mut numbers: Vec<_> = std::thread::scope(|scope| {
        let commits = scenes
            .iter()
            .map(|scene| scope.spawn(|| commit(dir.path(), street(scene)).unwrap().number));
        commits.collect::<Vec<_>>().into_iter().map(|commit| commit.join().unwrap()).collect()
    });
    numbers.sort_unstable();
    assert_eq!(numbers, [1, 2, 3, 4]);
    let verified = Catalog::open(dir.path()).unwrap().verify("street", &mut |_, _| {}).unwrap();
    assert_eq!(verified.damaged.len(), 0);
}

#[test]
fn a_twin_may_be_empty() {
    let dir = tempfile::tempdir().unwrap();
    let version = commit(dir.path(), street(&gaussians(0, 1, 1.0, 1))).unwrap();
    assert_eq!(version.manifest.chunks, []);
    let catalog = Catalog::open(dir.path()).unwrap();
    assert_eq!(catalog.version("street", None).unwrap(), version);
    let resident = Cache::new(catalog).open("street", None).unwrap();
    assert_eq!(resident.total_bytes(), 0);
    let eye = Viewpoint { position_m: DVec3::ZERO, focal_px: 1000.0 };
    assert!(resident.scene(&[eye], &version.manifest.profile).unwrap().chunks.is_empty());
}
