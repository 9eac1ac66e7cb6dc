//! kill -9 and a full disk in the middle of an import leave the old version or the new one.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use wildcity_twin::store::{Catalog, ObjectTotals};

use crate::scene_files::{gaussians, inria_columns, ply};
use crate::versions::{commit, files, street};
use crate::wildcity;

/// Writes a PLY of `n` Gaussians in about 50 cells.
fn write_ply(path: &Path, n: usize, seed: u64) {
    fs::write(path, ply(&gaussians(n, 0, 220.0, seed), &inria_columns(0, false))).unwrap();
}

/// Names of the staging directories of commits that run or were killed.
fn unfinished(twins: &Path) -> Vec<String> {
    let entries = fs::read_dir(twins.join(".staging")).into_iter().flatten();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.contains('@')).collect()
}

#[test]
fn a_killed_import_leaves_the_old_version_or_the_new_one() {
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    let source = dir.path().join("new.ply");
    write_ply(&source, 100_000, 1);
    let staging = twins.join(".staging");
    let mut killed_on_the_way = 0;
    // The second round starts from a twin that has a version already.
    for old in 0..=1 {
        if old == 1 {
            commit(&twins, street(&gaussians(1_000, 0, 220.0, 2))).unwrap();
        }
        for staged in [0, 1, 7, 20, 40, 50] {
            let mut import = wildcity()
                .arg("import")
                .arg(&source)
                .args(["--twin", "street", "--twins"])
                .arg(&twins)
                .stdout(Stdio::null())
                .spawn()
                .unwrap();
            let deadline = Instant::now() + Duration::from_secs(30);
            // The staging directory of the twin's commit, and its content other than the lock.
            let seen = || {
                let entries = files(&staging).into_iter();
                entries.filter(|path| path.extension().is_none()).count().saturating_sub(1)
            };
            while seen() <= staged && import.try_wait().unwrap().is_none() {
                assert!(Instant::now() < deadline, "the import hangs");
                std::thread::yield_now();
            }
            let ended = import.try_wait().unwrap().is_some();
            import.kill().unwrap();
            import.wait().unwrap();
            killed_on_the_way += usize::from(!ended);

            let catalog = Catalog::open(&twins).unwrap();
            let counts: Vec<_> = catalog
                .twins()
                .unwrap()
                .twins
                .iter()
                .map(|twin| catalog.version(&twin.name, None).unwrap().manifest.gaussians())
                .collect();
            match (old, &counts[..]) {
                (0, []) | (1, [1_000]) | (_, [100_000]) => {}
                (_, counts) => panic!("after the kill at {staged} objects: {counts:?}"),
            }
            assert!(unfinished(&twins).is_empty(), "staging was cleaned up");
            if counts.is_empty() {
                assert!(
                    !twins.join("street").exists(),
                    "nothing is left of a twin without version"
                );
                continue;
            }
            let verified = catalog.verify("street", &mut |_, _| {}).unwrap();
            assert_eq!(verified.damaged.len(), 0);
            let objects = files(&twins.join("street/objects")).len();
            assert_eq!(objects, verified.objects, "every object belongs to a version");
            if counts == [100_000] {
                fs::remove_dir_all(twins.join("street")).unwrap();
                if old == 1 {
                    commit(&twins, street(&gaussians(1_000, 0, 220.0, 2))).unwrap();
                }
            }
        }
    }
    assert!(
        killed_on_the_way >= 6,
        "only {killed_on_the_way} of 12 imports were killed on the way"
    );
}

/// The points at which the import is killed are spread over the time that it takes.
#[test]
fn an_import_killed_at_a_hundred_points_loses_nothing() {
    const POINTS: u32 = 100;
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    let source = dir.path().join("new.ply");
    write_ply(&source, 3_000, 1);
    let import = || {
        let mut import = wildcity();
        import.arg("import").arg(&source).args(["--twin", "street", "--twins"]).arg(&twins);
        import.stdout(Stdio::null());
        import
    };
    let old = commit(&twins, street(&gaussians(1_000, 0, 220.0, 2))).unwrap();
    let began = Instant::now();
    assert!(import().status().unwrap().success());
    let takes = began.elapsed();
    let new = Catalog::open(&twins).unwrap().version("street", None).unwrap();
    Catalog::open(&twins).unwrap().rollback("street", old.number).unwrap();
    let (mut killed, mut left) = (0, 0);
    for point in 0..POINTS {
        let mut running = import().spawn().unwrap();
        // This does not wait for an event: it sets the time of the kill.
        std::thread::sleep(takes * point / POINTS);
        killed += u32::from(running.try_wait().unwrap().is_none());
        running.kill().unwrap();
        running.wait().unwrap();
        left += unfinished(&twins).len();
        let catalog = Catalog::open(&twins).unwrap();
        let now = catalog.version("street", None).unwrap();
        assert!([&old.hash, &new.hash].contains(&&now.hash), "killed at {point}");
        let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
        assert!(checked.is_sound() && !checked.staging, "killed at {point}: {checked:?}");
        assert_eq!(checked.unreferenced, ObjectTotals::default(), "killed at {point}");
        if now.hash == new.hash {
            catalog.rollback("street", old.number).unwrap();
        }
    }
    assert!(killed > POINTS / 4, "only {killed} of {POINTS} were killed on the way");
    assert!(left > 0, "none was killed while it wrote");
}

#[test]
fn objects_placed_by_a_killed_import_are_removed() {
    let dir = tempfile::tempdir().unwrap();
    let version = commit(dir.path(), street(&gaussians(1_000, 0, 100.0, 1))).unwrap();
    let before = files(&dir.path().join("street"));
    // As if killed between placing an object and writing the record.
    let orphan = dir.path().join("street/objects/ab").join("ab".repeat(32));
    fs::create_dir_all(orphan.parent().unwrap()).unwrap();
    fs::write(&orphan, "placed").unwrap();
    fs::create_dir(dir.path().join(".staging/street@killed")).unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    assert_eq!(files(&dir.path().join("street")), before);
    assert_eq!(catalog.version("street", None).unwrap(), version);
}

/// Without root, a test cannot fill a file system. A limit of the file size makes the same
/// operation fail: a write in the middle of an object.
#[test]
fn a_full_disk_leaves_the_old_version_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    let source = dir.path().join("new.ply");
    write_ply(&source, 100_000, 1);
    let import = |kib: u32| {
        // dash counts in 512 bytes, bash in 1024: either way too small for the last chunks.
        let script = format!("trap '' XFSZ; ulimit -f {kib}; exec \"$@\"");
        let output = Command::new("sh")
            .args(["-c", &script, "sh", env!("CARGO_BIN_EXE_wildcity"), "import"])
            .arg(&source)
            .args(["--twin", "street", "--twins"])
            .arg(&twins)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(said.contains("cannot write") && said.contains("File too large"), "{said}");
    };
    // The first chunk fails; several fit and then one fails.
    for kib in [8, 100] {
        import(kib);
        assert!(!twins.join("street").exists());
        assert_eq!(unfinished(&twins), [""; 0]);
    }
    let version = commit(&twins, street(&gaussians(500, 0, 100.0, 2))).unwrap();
    let before = files(&twins);
    import(100);
    assert_eq!(files(&twins), before);
    assert_eq!(Catalog::open(&twins).unwrap().version("street", None).unwrap(), version);
}
