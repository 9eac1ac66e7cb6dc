//! Bytes that changed on disk are found and named, and importing the same scene again repairs them.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use wildcity_scene::Gaussians;
use wildcity_scene::RenderProfile;
use wildcity_twin::residency::{Cache, PinnedScene, ResidencyError, Viewpoint};
use wildcity_twin::store::{Catalog, StoreError, Version};

use crate::scene_files::gaussians;
use crate::versions::{commit, street, street_named};

struct Twin {
    dir: tempfile::TempDir,
    scene: Gaussians,
    version: Version,
}

fn twin() -> Twin {
    let dir = tempfile::tempdir().unwrap();
    let scene = gaussians(2_000, 1, 100.0, 1);
    let version = commit(dir.path(), street(&scene)).unwrap();
    Twin { dir, scene, version }
}

impl Twin {
    fn object(&self, hash: &str) -> PathBuf {
        self.dir.path().join("street/objects").join(&hash[..2]).join(hash)
    }

    /// The errors of each way of reading a changed object.
    fn assert_found(&self, hash: &str, wanted: &str) {
        self.assert_verify_finds(hash);
        let catalog = Catalog::open(self.dir.path()).unwrap();
        let text = everything(catalog).unwrap_err().to_string();
        assert!(text.contains(hash) && text.contains(wanted), "{text}");
    }

    fn assert_verify_finds(&self, hash: &str) {
        let catalog = Catalog::open(self.dir.path()).unwrap();
        let verified = catalog.verify("street", &mut |_, _| {}).unwrap();
        let named: Vec<_> = verified.damaged.iter().map(|damage| damage.object.as_str()).collect();
        assert_eq!(named, [hash]);
    }

    fn assert_healed_by_import(&self) {
        let again = commit(self.dir.path(), street(&self.scene)).unwrap();
        assert_eq!(again.hash, self.version.hash);
        let catalog = Catalog::open(self.dir.path()).unwrap();
        let verified = catalog.verify("street", &mut |_, _| {}).unwrap();
        assert_eq!(verified.damaged.len(), 0);
        assert_eq!(verified.objects, self.version.manifest.chunks.len() + 2);
        everything(catalog).unwrap();
    }
}

/// Reads all of the twin but its coarse levels.
fn everything(catalog: Catalog) -> Result<PinnedScene, ResidencyError> {
    let resident = Cache::new(catalog).open("street", None)?;
    let eye = Viewpoint { position_m: DVec3::ZERO, focal_px: 1000.0 };
    resident.scene(&[eye], &RenderProfile { tau_px: 0.0, ..RenderProfile::default() })
}

fn flip(path: &Path, byte: usize) {
    let mut bytes = fs::read(path).unwrap();
    bytes[byte] ^= 0x10;
    fs::write(path, bytes).unwrap();
}

#[test]
fn one_flipped_bit_anywhere_in_a_chunk_is_found() {
    let twin = twin();
    let hash = twin.version.manifest.chunks[2].object.clone();
    let path = twin.object(&hash);
    let size = fs::metadata(&path).unwrap().len() as usize;
    // Magic, format, the table's length, hash, and padding, and the table itself: drawing does not
    // need them.
    for byte in [0, 8, 12, 17, 4000, 4096, 4500] {
        flip(&path, byte);
        twin.assert_verify_finds(&hash);
        flip(&path, byte);
    }
    // The first and the last byte of sections.
    for byte in [8192, size - 1] {
        flip(&path, byte);
        twin.assert_found(&hash, "its bytes hash to");
        flip(&path, byte);
    }
    flip(&path, 4500);
    twin.assert_healed_by_import();
}

#[test]
fn a_short_or_lost_chunk_is_found() {
    let twin = twin();
    let hash = twin.version.manifest.chunks[0].object.clone();
    let path = twin.object(&hash);
    let whole = fs::read(&path).unwrap();
    for length in [0, 100, 4096, whole.len() - 92] {
        fs::write(&path, &whole[..length]).unwrap();
        twin.assert_found(&hash, &format!("it has {length} bytes"));
    }
    fs::remove_file(&path).unwrap();
    twin.assert_found(&hash, "cannot open");
    twin.assert_healed_by_import();
}

#[test]
fn a_changed_manifest_or_table_is_found() {
    let twin = twin();
    for hash in [twin.version.hash.clone(), twin.version.manifest.table.object.clone()] {
        flip(&twin.object(&hash), 40);
        twin.assert_found(&hash, "its bytes hash to");
        twin.assert_healed_by_import();
    }
}

#[test]
fn a_changed_log_record_cannot_name_a_path_outside_the_twin() {
    let twin = twin();
    let record = twin.dir.path().join("street/log/0000000001");
    for text in ["", "{}", r#"{"manifest":"../../../etc/passwd","created_us":0}"#] {
        fs::write(&record, text).unwrap();
        let error = Catalog::open(twin.dir.path()).unwrap().version("street", None).unwrap_err();
        assert!(matches!(error, StoreError::Damaged { .. }), "{error}");
    }
    // The next import makes a new version after the damaged record.
    assert_eq!(commit(twin.dir.path(), street(&twin.scene)).unwrap().number, 2);
}

#[test]
fn a_later_format_is_named_as_such() {
    let twin = twin();
    let manifest = fs::read_to_string(twin.object(&twin.version.hash)).unwrap();
    let later = manifest.replacen("\"format\":1", "\"format\":9,\"new\":1", 1);
    let hash = blake3::hash(later.as_bytes()).to_hex().to_string();
    let path = twin.object(&hash);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, later).unwrap();
    let record = format!(r#"{{"manifest":"{hash}","created_us":0}}"#);
    fs::write(twin.dir.path().join("street/log/0000000002"), record).unwrap();
    let error = Catalog::open(twin.dir.path()).unwrap().version("street", None).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("has format 9; this build reads format 1: import the twin again"),
        "{error}"
    );
}

/// Ways in which the newest record of a twin cannot be read.
const DAMAGE: [(&str, &str); 5] = [
    ("an empty file", "is damaged: EOF while parsing"),
    ("a link to itself", "it is a symbolic link"),
    ("a link to another record", "it is a symbolic link"),
    ("a pipe", "it is not a regular file"),
    ("a directory", "it is not a regular file"),
];

/// Puts something that cannot be read in the place of a record.
fn damage(how: &str, record: &Path, other: &Path) {
    fs::remove_file(record).ok();
    match how {
        "an empty file" => fs::write(record, "").unwrap(),
        "a link to itself" => std::os::unix::fs::symlink(record, record).unwrap(),
        "a link to another record" => std::os::unix::fs::symlink(other, record).unwrap(),
        "a pipe" => {
            let made = std::process::Command::new("mkfifo").arg(record).status().unwrap();
            assert!(made.success());
        }
        _ => fs::create_dir(record).unwrap(),
    }
}

#[test]
fn the_damage_of_one_twin_is_not_that_of_others() {
    for (how, wanted) in DAMAGE {
        let dir = tempfile::tempdir().unwrap();
        let scene = gaussians(100, 0, 20.0, 1);
        for name in ["avenue", "broken", "street"] {
            commit(dir.path(), street_named(name, &scene)).unwrap();
        }
        let record = |name: &str, number: u64| dir.path().join(format!("{name}/log/{number:010}"));
        damage(how, &record("broken", 2), &record("street", 1));
        // What a killed commit left of the same twin cannot be looked at either.
        let staging = dir.path().join(".staging/broken@killed");
        fs::create_dir(&staging).unwrap();
        damage(how, &staging.join("lock"), &record("street", 1));

        let catalog = Catalog::open(dir.path()).unwrap();
        let list = catalog.twins().unwrap();
        let names: Vec<_> = list.twins.iter().map(|twin| twin.name.as_str()).collect();
        assert_eq!(names, ["avenue", "street"], "{how}");
        let damaged: Vec<_> = list.damaged.iter().map(|twin| twin.name.as_str()).collect();
        assert_eq!(damaged, ["broken"], "{how}");
        let reason = list.damaged[0].error.to_string();
        assert!(reason.contains(wanted) && reason.contains("broken/log/0000000002"), "{reason}");
        // The others can be read and written; of the broken one, its older versions.
        catalog.version("street", None).unwrap();
        commit(dir.path(), street_named("avenue", &gaussians(50, 0, 20.0, 2))).unwrap();
        catalog.version("broken", Some(1)).unwrap();
        catalog.version("broken", None).unwrap_err();

        let aside = catalog.repair_log("broken").unwrap();
        assert_eq!((aside.len(), aside[0].number), (1, 2), "{how}");
        assert!(fs::symlink_metadata(&aside[0].path).is_ok(), "{how}: nothing is deleted");
        assert_eq!(catalog.version("broken", None).unwrap().number, 1);
        assert_eq!(catalog.twins().unwrap().damaged.len(), 0);
        fs::remove_dir_all(&staging).ok();
        assert_eq!(
            commit(dir.path(), street_named("broken", &gaussians(50, 0, 20.0, 3))).unwrap().number,
            2
        );
    }
}

/// A manifest, a table or a chunk that is a pipe is an error and no wait.
#[test]
fn a_pipe_in_the_place_of_an_object_is_not_waited_for() {
    let twin = twin();
    let chunk = &twin.version.manifest.chunks[0].object;
    let table = &twin.version.manifest.table.object;
    for hash in [chunk, table, &twin.version.hash] {
        let path = twin.object(hash);
        let bytes = fs::read(&path).unwrap();
        damage("a pipe", &path, &path);
        let error = everything(Catalog::open(twin.dir.path()).unwrap()).unwrap_err().to_string();
        assert!(error.contains("it is not a regular file"), "{error}");
        fs::remove_file(&path).unwrap();
        fs::write(&path, bytes).unwrap();
    }
    let lease = twin.dir.path().join("street/leases/pipe");
    fs::create_dir_all(lease.parent().unwrap()).unwrap();
    damage("a pipe", &lease, &lease);
    let keep = wildcity_twin::store::Retention { versions: 1, grace: std::time::Duration::ZERO };
    let collected = Catalog::open(twin.dir.path()).unwrap().collect("street", keep, false);
    assert!(collected.unwrap_err().to_string().contains("it is not a regular file"));
}
