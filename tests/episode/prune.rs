//! Removing old records.

use std::fs::{self, OpenOptions};
use std::path::Path;
use std::time::{Duration, SystemTime};

use wildcity_episode::{Keep, Pruned, prune};

const DAY_S: u64 = 24 * 3600;

/// A record of so many bytes that was last written to so many seconds ago, and its MCAP file.
fn record(dir: &Path, name: &str, bytes: usize, age_s: u64, has_end: bool) {
    let last =
        if has_end { r#"{"kind":"end","outcome":"completed"}"# } else { r#"{"kind":"frame"}"# };
    let path = dir.join(format!("{name}.jsonl"));
    fs::write(&path, format!("{}\n{last}\n", "x".repeat(bytes - last.len() - 2))).unwrap();
    fs::write(path.with_extension("mcap"), vec![0; bytes]).unwrap();
    let file = OpenOptions::new().append(true).open(&path).unwrap();
    file.set_modified(SystemTime::now() - Duration::from_secs(age_s)).unwrap();
}

fn names(dir: &Path) -> Vec<String> {
    let entries = fs::read_dir(dir).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Four records, from new to old: `a` of an hour ago to `d` of four days ago, of 1,000 bytes and as
/// many of MCAP.
fn pruned(keep: Keep, is_dry: bool) -> (Pruned, Vec<String>) {
    let dir = tempfile::tempdir().unwrap();
    for (name, age_s) in [("a", 3600), ("b", 2 * DAY_S), ("c", 3 * DAY_S), ("d", 4 * DAY_S)] {
        record(dir.path(), name, 1000, age_s, true);
    }
    fs::write(dir.path().join("notes.txt"), "").unwrap();
    let pruned = prune(dir.path(), keep, SystemTime::now(), is_dry).unwrap();
    (pruned, names(dir.path()))
}

#[test]
fn each_limit_keeps_the_newest() {
    let none = Keep::default();
    for (keep, removed) in [
        (none, &[][..]),
        (Keep { records: Some(3), ..none }, &["d"]),
        (Keep { records: Some(0), ..none }, &["a", "b", "c", "d"]),
        (Keep { age: Some(Duration::from_secs(5 * DAY_S / 2)), ..none }, &["c", "d"]),
        (Keep { bytes: Some(4000), ..none }, &["c", "d"]),
        (Keep { bytes: Some(3999), ..none }, &["b", "c", "d"]),
        (Keep { records: Some(3), bytes: Some(2000), ..none }, &["b", "c", "d"]),
    ] {
        let (found, left) = pruned(keep, false);
        assert_eq!(found.removed, removed, "{keep:?}");
        assert_eq!((found.bytes, found.kept), (2000 * removed.len() as u64, 4 - removed.len()));
        assert!(found.failed.is_empty() && found.unfinished == 0);
        let stays = |name: &str| !removed.contains(&name);
        let expected = ["a", "b", "c", "d"].into_iter().filter(|name| stays(name));
        let mut expected: Vec<String> = expected
            .flat_map(|name| ["jsonl", "mcap"].map(|kind| format!("{name}.{kind}")))
            .collect();
        expected.push("notes.txt".to_owned());
        assert_eq!(left, expected, "{keep:?}");
    }
    let (found, left) = pruned(Keep { records: Some(1), ..none }, true);
    assert_eq!((found.removed.len(), left.len()), (3, 9), "nothing is removed");
}

#[test]
fn what_may_be_in_use_stays() {
    let dir = tempfile::tempdir().unwrap();
    // Ended a moment ago: its export may run.
    record(dir.path(), "fresh", 100, 10, true);
    record(dir.path(), "ended", 100, 120, true);
    record(dir.path(), "driven", 100, DAY_S / 2, false);
    record(dir.path(), "killed", 100, 2 * DAY_S, false);
    let keep = Keep { records: Some(0), ..Keep::default() };
    let found = prune(dir.path(), keep, SystemTime::now(), false).unwrap();
    assert_eq!(found.removed, ["ended", "killed"]);
    assert_eq!((found.kept, found.unfinished), (2, 2));
}

#[test]
fn a_file_that_cannot_be_removed_is_named() {
    let dir = tempfile::tempdir().unwrap();
    record(dir.path(), "a", 100, 120, true);
    let mcap = dir.path().join("a.mcap");
    fs::remove_file(&mcap).unwrap();
    fs::create_dir(&mcap).unwrap();
    let keep = Keep { records: Some(0), ..Keep::default() };
    let found = prune(dir.path(), keep, SystemTime::now(), false).unwrap();
    assert!(found.removed.is_empty() && found.kept == 1);
    let [(path, _)] = &found.failed[..] else { panic!("{found:?}") };
    assert_eq!(path, &mcap);
    // Its record is still there, so that another attempt finds both.
    assert!(dir.path().join("a.jsonl").exists());
    let nowhere = prune(&dir.path().join("none"), keep, SystemTime::now(), false).unwrap();
    assert_eq!(nowhere.kept, 0);
}
