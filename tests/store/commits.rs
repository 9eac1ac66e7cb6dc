//! Commits: put part by part, published at once, rebased, refused, rolled back.

use std::collections::BTreeSet;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use wildcity_scene::geo::{GeoAnchor, ProjectedOrigin};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, Manifest, RecordFormat, RenderProfile, Trajectory};
use wildcity_twin::store::disk::{Disk, Wait};
use wildcity_twin::store::{
    Catalog, CellDiff, CellSize, Commit, CommitKind, NewVersion, RealDisk, StorageOptions,
    StoreError, Version, VersionChange, VersionSettings,
};

use crate::scene_files::gaussians;
use crate::versions::{commit, files, street, turn};

const EXACT: StorageOptions = StorageOptions { record: RecordFormat::F32, levels: false };

/// The settings of `street`.
fn settings() -> VersionSettings {
    let NewVersion { profile, rig, trajectories, sky, geo, provenance, .. } = street(&EMPTY);
    let twin_from_capture = None;
    VersionSettings { profile, rig, trajectories, sky, geo, twin_from_capture, provenance }
}

static EMPTY: Gaussians = Gaussians {
    sh_degree: 0,
    means_m: Vec::new(),
    quats_wxyz: Vec::new(),
    ln_scales: Vec::new(),
    logit_opacities: Vec::new(),
    sh: Vec::new(),
    classes: None,
};

fn from(source: &str) -> Provenance {
    Provenance { source: source.to_owned(), ..settings().provenance }
}

/// A change of only cells, with `source` as its provenance.
fn change(source: &str) -> VersionChange {
    VersionChange::new(from(source))
}

/// 200 Gaussians of SH degree 0 around the middle of a cell, 20 m wide.
fn cell(cell: [i32; 2], seed: u64) -> Gaussians {
    let mut scene = gaussians(200, 0, 10.0, seed);
    for mean_m in &mut scene.means_m {
        for axis in 0..2 {
            mean_m[axis] += 64.0 * f64::from(cell[axis]);
        }
    }
    scene
}

fn put(commit: &mut Commit, scene: &Gaussians) {
    commit.put(scene, None, &mut |_, _| {}).unwrap();
}

/// A twin of cells (0, 0), (1, 0) and (2, 0).
fn three(dir: &tempfile::TempDir) -> (Catalog, Version) {
    let catalog = Catalog::open(dir.path()).unwrap();
    let mut commit = catalog.begin("street", CommitKind::Import, EXACT).unwrap();
    for x in 0..3 {
        put(&mut commit, &cell([x, 0], 1));
    }
    let version = commit.replace(None, settings()).unwrap();
    (catalog, version)
}

fn changed(catalog: &Catalog, cells: &[[i32; 2]], seed: u64) -> Commit {
    let mut commit = catalog.begin("street", CommitKind::Push, EXACT).unwrap();
    for &at in cells {
        put(&mut commit, &cell(at, seed));
    }
    commit
}

fn object(manifest: &Manifest, cell: [i32; 2]) -> &str {
    &manifest.chunks.iter().find(|chunk| chunk.cell == cell).unwrap().object
}

#[test]
fn part_by_part_is_the_same_version_as_at_once() {
    let one = tempfile::tempdir().unwrap();
    let two = tempfile::tempdir().unwrap();
    let scene = gaussians(5_000, 1, 150.0, 3);
    let storage = StorageOptions::default();
    let whole = commit(one.path(), NewVersion { storage, ..street(&scene) }).unwrap();

    let catalog = Catalog::open(two.path()).unwrap();
    let mut parts = catalog.begin("street", CommitKind::Import, storage).unwrap();
    let cells: Vec<_> = whole.manifest.chunks.iter().map(|chunk| chunk.cell).collect();
    assert!(cells.len() > 9);
    let mut left_out = 0;
    // Cells are out of order, and each part is selected from the whole scene.
    for cells in cells.chunks(4).rev() {
        let only: BTreeSet<_> = cells.iter().copied().collect();
        let mut seen = (0, 0);
        let stored =
            parts.put(&scene, Some(&only), &mut |done, total| seen = (done, total)).unwrap();
        assert_eq!(stored.chunks.iter().map(|chunk| chunk.cell).collect::<Vec<_>>(), cells);
        let count: u64 = stored.chunks.iter().map(|chunk| chunk.count).sum();
        assert_eq!((count + stored.left_out, seen), (5_000, (count, count)));
        left_out += stored.left_out;
    }
    assert_eq!(left_out, 5_000 * (cells.len().div_ceil(4) as u64 - 1));
    let version = parts.replace(None, settings()).unwrap();
    assert_eq!((version.hash, version.manifest), (whole.hash, whole.manifest));
}

#[test]
fn a_dropped_commit_leaves_nothing_and_does_not_affect_others() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    let before = files(dir.path());
    let one = changed(&catalog, &[[0, 0]], 2);
    let two = changed(&catalog, &[[0, 0]], 3);
    assert_ne!(one.id(), two.id());
    // Another start removes what was abandoned, and nothing else.
    assert_eq!(Catalog::open(dir.path()).unwrap().version("street", None).unwrap(), first);
    assert!(files(dir.path()).len() > before.len());
    drop(one);
    let mut provenance = settings().provenance;
    provenance.source = "two".into();
    let second = two.change(1, VersionChange::new(provenance)).unwrap();
    assert_eq!(second.number, 2);
    let objects = ["the chunk", "the table", "the manifest", "the record"].len();
    assert_eq!(files(dir.path()).len(), before.len() + objects);
}

#[test]
fn a_change_keeps_every_other_cell() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    let second = changed(&catalog, &[[1, 0], [5, -2]], 2).change(1, change("push")).unwrap();
    assert_eq!(catalog.version("street", None).unwrap(), second);
    for cell in [[0, 0], [2, 0]] {
        assert_eq!(object(&first.manifest, cell), object(&second.manifest, cell));
    }
    assert_ne!(object(&first.manifest, [1, 0]), object(&second.manifest, [1, 0]));
    let cells: Vec<_> = second.manifest.chunks.iter().map(|chunk| chunk.cell).collect();
    assert_eq!(cells, [[5, -2], [0, 0], [1, 0], [2, 0]], "in order of (y, x)");
    // The same twin, put whole.
    let other = tempfile::tempdir().unwrap();
    let mut whole =
        Catalog::open(other.path()).unwrap().begin("street", CommitKind::Import, EXACT).unwrap();
    for (at, seed) in [([0, 0], 1), ([1, 0], 2), ([2, 0], 1), ([5, -2], 2)] {
        put(&mut whole, &cell(at, seed));
    }
    let provenance = from("push");
    assert_eq!(
        whole.replace(None, VersionSettings { provenance, ..settings() }).unwrap().hash,
        second.hash
    );

    let mut profile = RenderProfile::default();
    profile.set("near=0.3").unwrap();
    let change = VersionChange { profile: Some(profile), ..change("profile") };
    let third = changed(&catalog, &[], 0).change(2, change).unwrap();
    assert_eq!(third.manifest.profile, profile);
    assert_eq!(third.manifest.chunks, second.manifest.chunks);
}

/// A twin that others made meanwhile is not replaced by a commit that would make it.
#[test]
fn a_new_twin_replaces_none() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let [mut early, mut late] =
        [(); 2].map(|()| catalog.begin("street", CommitKind::Push, EXACT).unwrap());
    put(&mut early, &cell([0, 0], 1));
    put(&mut late, &cell([1, 0], 2));
    let first = early.create(settings()).unwrap();
    let error = late.create(settings()).unwrap_err();
    assert!(matches!(&error, StoreError::TwinExists { latest: 1, .. }), "{error}");
    assert_eq!(catalog.version("street", None).unwrap(), first);
}

/// The note of a push is not that of an edit, and an edit that changes nothing is no version.
#[test]
fn an_edit_has_no_note() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    let mut pushed = from("block");
    pushed.set_note("epoch 30");
    let pushed = VersionChange::new(pushed);
    let second = changed(&catalog, &[[0, 0]], 2).change(1, pushed).unwrap();
    assert_eq!(second.manifest.provenance.note(), Some("epoch 30"));
    let edited = || VersionChange::edit();
    assert_eq!(changed(&catalog, &[], 0).change(2, edited()).unwrap(), second);
    let mut profile = RenderProfile::default();
    profile.set("near=0.3").unwrap();
    let other = VersionChange { profile: Some(profile), ..edited() };
    let third = changed(&catalog, &[], 0).change(2, other).unwrap();
    assert_eq!((third.number, third.manifest.provenance.note()), (3, None));
    assert_eq!(third.manifest.provenance.source, second.manifest.provenance.source);
}

/// The place on the earth is set, kept and removed; without one the manifest is as it was.
#[test]
fn a_version_may_say_where_it_lies() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    assert!(!serde_json::to_string(&first.manifest).unwrap().contains("geo"));
    let anchor: GeoAnchor = "52.5162,13.3777,34".parse().unwrap();
    let place = |geo| VersionChange { geo: Some(geo), ..change("geo") };
    let placed = changed(&catalog, &[], 0).change(1, place(Some(anchor.clone()))).unwrap();
    assert_eq!(placed.manifest.geo.as_ref(), Some(&anchor));
    assert_eq!(placed.manifest.chunks, first.manifest.chunks);
    assert_eq!(catalog.version("street", None).unwrap(), placed);
    let pushed = changed(&catalog, &[[1, 0]], 2).change(2, change("push")).unwrap();
    assert_eq!(pushed.manifest.geo, Some(anchor));
    let removed = changed(&catalog, &[], 0).change(3, place(None)).unwrap();
    assert_eq!(removed.manifest.geo, None);
    let zone = GeoAnchor::Projected(ProjectedOrigin {
        projection: "EPSG:3857".to_owned(),
        easting_m: 5e5,
        northing_m: 0.0,
        altitude_m: 0.0,
    });
    let refused = changed(&catalog, &[], 0).change(4, place(Some(zone))).unwrap_err();
    assert!(refused.to_string().contains("geo.projection"), "{refused}");
    assert_eq!(catalog.version("street", None).unwrap().number, 4);
}

#[test]
fn changes_of_other_cells_are_both_in_and_of_the_same_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    let [one, two] = [[[0, 0], [7, 7]], [[1, 0], [1, 1]]].map(|cells| changed(&catalog, &cells, 2));
    let late = changed(&catalog, &[[1, 0], [2, 0]], 3);
    let late_id = late.id().to_owned();
    assert_eq!(one.change(1, change("one")).unwrap().number, 2);
    let both = two.change(1, change("two")).unwrap();
    assert_eq!(both.number, 3);
    assert_eq!(both.manifest.chunks.len(), 5);
    assert_eq!(both.manifest.provenance.source, "two");

    let before = files(dir.path());
    let error = late.change(1, change("late")).unwrap_err();
    let said = error.to_string();
    let StoreError::Overlap { base: 1, latest: 3, cells, settings, .. } = error else {
        panic!("{said}")
    };
    assert_eq!((&cells[..], settings.len()), (&[[1, 0]][..], 0));
    assert!(said.contains("cells (1, 0); make the change from version 3"), "{said}");
    let left: Vec<_> =
        files(dir.path()).into_iter().filter(|path| !before.contains(path)).collect();
    assert_eq!(left, [""; 0].map(std::path::PathBuf::from), "commit {late_id}");
    // Made again from the latest version, it is accepted.
    let fourth = changed(&catalog, &[[1, 0], [2, 0]], 4).change(3, change("late")).unwrap();
    assert_eq!(fourth.number, 4);
}

/// A whole twin in preparation: cells (0, 0) and (1, 0), with another profile if given.
fn whole(catalog: &Catalog, near: Option<&str>) -> (Commit, VersionSettings) {
    let mut commit = catalog.begin("street", CommitKind::Push, EXACT).unwrap();
    for x in 0..2 {
        put(&mut commit, &cell([x, 0], 1));
    }
    let mut settings = settings();
    settings.provenance.source = "whole".to_owned();
    near.iter().for_each(|near| settings.profile.set(near).unwrap());
    (commit, settings)
}

#[test]
fn a_whole_version_replaces_nothing_that_changed_since_its_base() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    let [(late, settings), (unaware, same)] = [(); 2].map(|()| whole(&catalog, None));
    let mut near = RenderProfile::default();
    near.set("near=0.3").unwrap();
    let since = VersionChange { profile: Some(near), ..change("since") };
    changed(&catalog, &[[1, 0], [8, 8]], 2).change(1, since).unwrap();

    let before = files(dir.path());
    let error = late.replace(Some(1), settings).unwrap_err();
    let StoreError::Overlap { base: 1, latest: 2, cells, settings, .. } = &error else {
        panic!("{error}")
    };
    assert_eq!((&cells[..], &settings[..]), (&[[1, 0], [8, 8]][..], &["profile"][..]));
    assert_eq!(files(dir.path()).len(), before.len() - STAGED_OF_ONE);
    // Cells that were changed back equal the base.
    assert_eq!(catalog.rollback("street", 1).unwrap().hash, first.hash);
    assert_eq!(unaware.replace(Some(1), same).unwrap().number, 4);
    // Without a base, the latest version is replaced, whatever it contains; so it is with the
    // latest as base.
    let (commit, settings) = whole(&catalog, Some("near=0.4"));
    assert_eq!(commit.replace(None, settings).unwrap().number, 5);
    let (commit, settings) = whole(&catalog, Some("near=0.5"));
    let sixth = commit.replace(Some(5), settings).unwrap();
    assert_eq!((sixth.number, catalog.versions("street").unwrap()[5].parent), (6, Some(5)));
    let (commit, settings) = whole(&catalog, None);
    let error = commit.replace(Some(9), settings).unwrap_err();
    assert!(matches!(error, StoreError::NoVersion { number: 9, .. }), "{error}");
}

/// Number of files that `whole` has staged: two cells and the lock.
const STAGED_OF_ONE: usize = 3;

#[test]
fn the_same_change_from_the_same_base_makes_no_new_version() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    let mut near = RenderProfile::default();
    near.set("near=0.3").unwrap();
    let again = || VersionChange { profile: Some(near), ..change("one") };
    let second = changed(&catalog, &[[1, 0], [7, 7]], 2).change(1, again()).unwrap();
    assert_eq!(changed(&catalog, &[[1, 0], [7, 7]], 2).change(1, again()).unwrap(), second);
    // Changes of other cells since then are kept; a change of the same cell is refused.
    changed(&catalog, &[[2, 0]], 3).change(2, change("other")).unwrap();
    let fourth = changed(&catalog, &[[1, 0], [7, 7]], 2).change(1, again()).unwrap();
    assert_eq!(catalog.diff("street", 3, 4).unwrap().cells, []);
    assert_eq!(fourth.number, 4);
    let error = changed(&catalog, &[[1, 0], [7, 7]], 3).change(1, again()).unwrap_err();
    let StoreError::Overlap { cells, settings, .. } = &error else { panic!("{error}") };
    assert_eq!((&cells[..], settings.len()), (&[[1, 0], [7, 7]][..], 0));

    let (commit, settings) = whole(&catalog, None);
    let fifth = commit.replace(Some(4), settings).unwrap();
    let (commit, settings) = whole(&catalog, None);
    assert_eq!(commit.replace(Some(4), settings).unwrap(), fifth);
}

#[test]
fn the_latest_number_is_known_even_if_records_are_damaged() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    changed(&catalog, &[[0, 0]], 2).change(1, change("two")).unwrap();
    std::fs::write(dir.path().join("street/log/0000000001"), "{").unwrap();
    assert!(matches!(catalog.versions("street").unwrap_err(), StoreError::Damaged { .. }));
    assert_eq!(catalog.latest("street").unwrap(), 2);
    assert!(matches!(catalog.latest("avenue").unwrap_err(), StoreError::NoTwin { .. }));
    assert!(matches!(catalog.latest("../street").unwrap_err(), StoreError::Name { .. }));
}

#[test]
fn a_rollback_that_waited_for_garbage_collection_does_not_restore_removed_objects() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    changed(&catalog, &[[0, 0]], 2).change(1, change("push")).unwrap();
    let turn = turn(dir.path());
    let lost = object(&first.manifest, [0, 0]);
    let error = std::thread::scope(|scope| {
        let waits = scope.spawn(|| catalog.rollback("street", 1));
        std::thread::sleep(std::time::Duration::from_millis(300));
        let path = dir.path().join("street/objects").join(&lost[..2]).join(lost);
        std::fs::remove_file(path).unwrap();
        drop(turn);
        waits.join().unwrap().unwrap_err()
    });
    assert!(error.to_string().contains(lost), "{error}");
    assert_eq!(catalog.version("street", None).unwrap().number, 2);
}

#[test]
fn settings_overlap_too() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    let mut near = RenderProfile::default();
    near.set("near=0.3").unwrap();
    let commits = [(); 2].map(|()| changed(&catalog, &[], 0));
    let [one, two] = commits;
    one.change(1, VersionChange { profile: Some(near), ..change("one") }).unwrap();
    near.set("near=0.4").unwrap();
    let said = two
        .change(1, VersionChange { profile: Some(near), ..change("two") })
        .unwrap_err()
        .to_string();
    assert!(said.contains("version 2 has other profile; make"), "{said}");
}

#[test]
fn many_changes_at_once_are_all_in() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    std::thread::scope(|scope| {
        for x in 0..8 {
            let catalog = &catalog;
            scope.spawn(move || changed(catalog, &[[x, 9]], 5).change(1, change("many")).unwrap());
        }
    });
    let last = catalog.version("street", None).unwrap();
    assert_eq!((last.number, last.manifest.chunks.len()), (9, 11));
    assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);
}

#[test]
fn what_does_not_fit_the_twin_is_refused_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, _) = three(&dir);
    let before = files(dir.path());
    let mut twice = changed(&catalog, &[[1, 0]], 2);
    let error = twice.put(&cell([1, 0], 3), None, &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, StoreError::DuplicateCell { cell: [1, 0], .. }), "{error}");
    let said = twice.put(&gaussians(9, 2, 1.0, 1), None, &mut |_, _| {}).unwrap_err().to_string();
    assert_eq!(
        said,
        "sh_degree is 2, but twin \"street\" has 0: store the Gaussians with 0, or replace \
         the whole twin"
    );
    drop(twice);

    let mut other = catalog.begin("street", CommitKind::Push, StorageOptions::default()).unwrap();
    put(&mut other, &cell([1, 0], 2));
    let said = other.change(1, change("q32")).unwrap_err().to_string();
    assert!(said.starts_with("record is q32, but twin \"street\" has f32"), "{said}");

    let mut other = catalog.begin("street", CommitKind::Push, EXACT).unwrap();
    put(&mut other, &gaussians(9, 1, 1.0, 1));
    let said = other.change(1, change("degree")).unwrap_err().to_string();
    assert!(said.starts_with("sh_degree is 1, but twin \"street\" has 0"), "{said}");

    let error = changed(&catalog, &[[0, 0]], 2).change(9, change("from")).unwrap_err();
    assert!(matches!(error, StoreError::NoVersion { number: 9, latest: 1, .. }), "{error}");
    let log = Trajectory { name: "log".into(), keyframes: Vec::new() };
    let change = VersionChange { trajectories: Some(vec![log]), ..change("empty") };
    let error = changed(&catalog, &[], 2).change(1, change).unwrap_err();
    assert!(matches!(error, StoreError::Trajectory(_)), "{error}");
    assert_eq!(files(dir.path()), before);
    assert!(matches!(
        catalog.begin("a@b", CommitKind::Push, EXACT).unwrap_err(),
        StoreError::Name { .. }
    ));
}

#[test]
fn a_rollback_gives_an_old_version_a_new_number_in_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    let push = changed(&catalog, &[[0, 0]], 2);
    let id = push.id().to_owned();
    let second = push.change(1, change("push")).unwrap();
    let before = files(dir.path()).len();
    let third = catalog.rollback("street", 1).unwrap();
    assert_eq!((third.number, &third.hash, &third.manifest), (3, &first.hash, &first.manifest));
    assert_eq!(files(dir.path()).len(), before + 1, "the record alone");
    assert_eq!(catalog.version("street", None).unwrap(), third);
    // The latest version itself makes no new version.
    assert_eq!(catalog.rollback("street", 1).unwrap(), third);
    assert_eq!(catalog.rollback("street", 2).unwrap().number, 4);

    let log = catalog.versions("street").unwrap();
    let entries: Vec<_> =
        log.iter().map(|entry| (entry.number, entry.kind, entry.parent)).collect();
    assert_eq!(
        entries,
        [
            (1, CommitKind::Import, None),
            (2, CommitKind::Push, Some(1)),
            (3, CommitKind::Rollback, Some(1)),
            (4, CommitKind::Rollback, Some(2))
        ]
    );
    assert_eq!(log[1].commit, Some(id));
    assert_eq!((&log[2].hash, &log[3].hash), (&first.hash, &second.hash));
    assert_eq!(log[0].created_us, first.created_us);
    let error = catalog.rollback("street", 9).unwrap_err();
    assert!(matches!(error, StoreError::NoVersion { number: 9, latest: 4, .. }), "{error}");
}

#[test]
fn a_version_that_lost_an_object_is_not_restored() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    changed(&catalog, &[[0, 0]], 2).change(1, change("push")).unwrap();
    let lost = object(&first.manifest, [0, 0]);
    let path = dir.path().join("street/objects").join(&lost[..2]).join(lost);
    std::fs::remove_file(&path).unwrap();
    let said = catalog.rollback("street", 1).unwrap_err().to_string();
    assert!(said.contains("cannot open") && said.contains(lost), "{said}");
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, "short").unwrap();
    let error = catalog.rollback("street", 1).unwrap_err();
    assert!(matches!(error, StoreError::Damaged { .. }), "{error}");
    assert_eq!(catalog.version("street", None).unwrap().number, 2);
}

#[test]
fn a_diff_names_cells_and_sizes() {
    let dir = tempfile::tempdir().unwrap();
    let (catalog, first) = three(&dir);
    let mut whole = catalog.begin("street", CommitKind::Import, EXACT).unwrap();
    put(&mut whole, &cell([1, 0], 1));
    put(&mut whole, &cell([2, 0], 9));
    put(&mut whole, &cell([3, 0], 1));
    let mut settings = settings();
    settings.profile.set("near=0.3").unwrap();
    let second = whole.replace(None, settings).unwrap();
    let size = |version: &Version, cell| {
        let chunk = version.manifest.chunks.iter().find(|chunk| chunk.cell == cell)?;
        assert_eq!(chunk.count, 200);
        Some(CellSize { gaussians: 200, bytes: chunk.bytes })
    };
    let wanted = [[0, 0], [2, 0], [3, 0]].map(|cell| CellDiff {
        cell,
        before: size(&first, cell),
        after: size(&second, cell),
    });
    let diff = catalog.diff("street", 1, 2).unwrap();
    assert_eq!((&diff.cells[..], diff.kept), (&wanted[..], 1));
    assert_eq!((wanted[0].after, wanted[2].before), (None, None));
    assert_eq!(diff.settings, ["profile"]);
    assert_eq!(catalog.diff("street", 2, 2).unwrap().cells, []);
}

/// A small file must not become a gigabyte: a Gaussian in each of many cells is refused before
/// anything is written.
#[test]
fn scattered_gaussians_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let mut scene = gaussians(5000, 0, 10.0, 1);
    for (index, mean_m) in scene.means_m.iter_mut().enumerate() {
        mean_m[0] = 64.0 * index as f64;
    }
    let mut commit = catalog.begin("street", CommitKind::Import, EXACT).unwrap();
    let error = commit.put(&scene, None, &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, StoreError::Scattered { gaussians: 5000, cells: 5000 }), "{error}");
    // 4096 such cells may be: a scene with many strays is still a scene.
    let few = scene.select(0..4096);
    commit.put(&few, None, &mut |_, _| {}).unwrap();
    drop(commit);
    assert!(catalog.twins().unwrap().twins.is_empty());
}

/// A process that begins while a lock is held has a copy of the locked file until its program runs.
#[test]
fn a_lock_ends_with_its_holder_while_other_processes_begin() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("lock");
    let ended = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            for _ in 0..500 {
                assert!(Command::new("true").status().unwrap().success());
            }
            ended.store(true, Ordering::Relaxed);
        });
        while !ended.load(Ordering::Relaxed) {
            drop(RealDisk.lock(&path, Wait::Yes).unwrap());
            let lock = RealDisk.lock(&path, Wait::No).unwrap();
            assert!(lock.is_some(), "the lock outlived its holder");
        }
    });
}
