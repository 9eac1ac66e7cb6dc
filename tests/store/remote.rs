//! An object store that fails: time-outs, retries, and the difference between a failing store and a
//! lost object.

use std::time::{Duration, Instant};

use wildcity_scene::Gaussians;
use wildcity_twin::store::{
    Catalog, DiskCacheSettings, NewVersion, RetryPolicy, StorageOptions, StoreError, Version,
};

use crate::places::{cells_alone, change};
use crate::s3::{Fault, S3, quick};
use crate::scene_files::gaussians;
use crate::versions::street;

fn commit(catalog: &Catalog, scene: &Gaussians) -> Result<Version, StoreError> {
    let new = NewVersion { storage: StorageOptions::default(), ..street(scene) };
    catalog.commit(new, &mut |_, _| {})
}

fn numbers(catalog: &Catalog) -> Vec<u64> {
    catalog.versions("street").unwrap().iter().map(|entry| entry.number).collect()
}

#[test]
fn a_commit_with_a_lost_answer_is_committed_once() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    commit(&catalog, &gaussians(200, 0, 20.0, 1)).unwrap();
    // The answer is lost in several ways: the connection breaks, or a proxy answers with an error.
    // A change of cells that another commit changed since would be refused; here, the other commit
    // is this one's first attempt.
    let faults = [Fault::AnswerLost, Fault::Denied(500), Fault::Denied(409), Fault::Denied(412)];
    for (base, fault) in (1..).zip(faults) {
        s3.fail("PUT", "street/log/", 1, fault);
        let version = change(&catalog, [3, 3], base).change(base, cells_alone()).unwrap();
        assert_eq!((version.number, s3.to_fail()), (base + 1, 0), "{fault:?}");
    }
    assert_eq!(numbers(&catalog), [1, 2, 3, 4, 5]);
}

#[test]
fn a_failed_put_of_a_record_is_retried() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    // 409: another client writes the same key at this moment. It is unknown which one wins; here,
    // neither does.
    for (number, status) in (1..).zip([500, 503, 409, 412]) {
        s3.fail("PUT", "street/log/", 2, Fault::Status(status));
        let version = commit(&catalog, &gaussians(200, 0, 20.0, number)).unwrap();
        assert_eq!((version.number, s3.to_fail()), (number, 0), "{status}");
    }
    s3.fail("PUT", "street/log/", 1, Fault::Silence);
    assert_eq!(commit(&catalog, &gaussians(200, 0, 20.0, 9)).unwrap().number, 5);
    assert_eq!(numbers(&catalog), [1, 2, 3, 4, 5]);
}

#[test]
fn the_outcome_is_unknown_if_the_record_cannot_be_read() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    commit(&catalog, &gaussians(200, 0, 20.0, 1)).unwrap();
    s3.fail("PUT", "street/log/", 1, Fault::AnswerLost);
    s3.fail("GET", "street/log/0000000002", 3, Fault::Status(500));
    let error = commit(&catalog, &gaussians(200, 0, 20.0, 2)).unwrap_err();
    assert!(matches!(error, StoreError::OutcomeUnknown { number: 2, .. }), "{error}");
    // In fact it was committed, so the same import makes no new version.
    assert_eq!(commit(&catalog, &gaussians(200, 0, 20.0, 2)).unwrap().number, 2);
}

#[test]
fn an_object_that_cannot_be_put_fails_the_commit_without_a_trace() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    let first = commit(&catalog, &gaussians(2_000, 0, 150.0, 1)).unwrap();
    s3.fail("PUT", "/objects/", 2, Fault::Status(500));
    s3.fail("PUT", "/objects/", 1, Fault::AnswerLost);
    let second = commit(&catalog, &gaussians(2_000, 0, 150.0, 2)).unwrap();
    assert_eq!((second.number, s3.to_fail()), (2, 0), "failed, put again, and all are there");
    assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);

    s3.fail("PUT", "/objects/", 1_000, Fault::Status(500));
    let error = commit(&catalog, &gaussians(2_000, 0, 150.0, 3)).unwrap_err();
    let said = error.to_string();
    assert!(said.starts_with("cannot write s3://bucket/twins/street/objects/"), "{said}");
    assert!(s3.to_fail() > 900, "not for ever");
    assert_eq!(numbers(&catalog), [1, 2]);
    assert_eq!(catalog.version("street", Some(1)).unwrap(), first);
    assert!(catalog.traffic().unwrap().failures > 0);
}

#[test]
fn bytes_damaged_in_transit_are_read_again() {
    let s3 = S3::start();
    let version = commit(&s3.catalog(), &gaussians(2_000, 0, 100.0, 1)).unwrap();
    let catalog = s3.catalog();
    let chunk = &version.manifest.chunks[0];
    let read = || catalog.section(&version, chunk, &chunk.sections[0]);
    let sound = read().unwrap().len();
    for fault in [
        Fault::Short,
        Fault::Flipped,
        Fault::Status(500),
        Fault::Status(503),
        Fault::AnswerLost,
        Fault::Silence,
    ] {
        let before = catalog.traffic().unwrap();
        s3.fail("GET", "/objects/", 1, fault);
        assert_eq!(read().unwrap().len(), sound, "{fault:?}");
        let after = catalog.traffic().unwrap();
        assert_eq!((after.retries - before.retries, s3.to_fail()), (1, 0), "{fault:?}");
        assert_eq!(after.failures, before.failures, "{fault:?}");
    }
    // Retries are bounded: each kind of failure becomes its error.
    s3.fail("GET", "/objects/", 3, Fault::Flipped);
    let error = read().unwrap_err();
    assert!(matches!(error, StoreError::Damaged { .. }), "{error}");
    assert!(error.to_string().contains("block"), "{error}");
    s3.fail("GET", "/objects/", 3, Fault::Status(500));
    let error = read().unwrap_err();
    assert!(error.to_string().starts_with("cannot read s3://bucket/twins/street/objects/"));
    assert_eq!(s3.to_fail(), 0);
    let began = Instant::now();
    s3.fail("GET", "/objects/", 3, Fault::Silence);
    let error = read().unwrap_err();
    let StoreError::Io { cause, .. } = &error else { panic!("{error}") };
    assert_eq!(cause.kind(), std::io::ErrorKind::TimedOut, "{error}");
    assert!(began.elapsed() < 3 * quick().timeout + Duration::from_secs(5));
    // 403 is not retried.
    let before = catalog.traffic().unwrap().requests;
    s3.fail("GET", "/objects/", 1, Fault::Status(403));
    let error = read().unwrap_err();
    let StoreError::Io { cause, .. } = &error else { panic!("{error}") };
    assert_eq!(cause.kind(), std::io::ErrorKind::PermissionDenied, "{error}");
    assert_eq!(catalog.traffic().unwrap().requests, before + 1);
    // Afterwards, everything works again.
    assert_eq!(read().unwrap().len(), sound);
}

#[test]
fn cached_parts_are_not_requested() {
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let version = commit(&s3.catalog(), &gaussians(2_000, 0, 100.0, 1)).unwrap();
    let cache = DiskCacheSettings { dir: dir.path().join("cache"), limit_bytes: 64 << 20 };
    let read_all = |catalog: &Catalog| {
        let version = catalog.version("street", None).unwrap();
        for chunk in &version.manifest.chunks {
            for section in &chunk.sections {
                catalog.section(&version, chunk, section).unwrap();
            }
        }
        version
    };
    assert_eq!(read_all(&s3.cached(Some(&cache)).unwrap()), version);
    // As another process would: only the log is requested.
    s3.fail("GET", "/objects/", 1_000, Fault::Status(500));
    let again = s3.cached(Some(&cache)).unwrap();
    assert_eq!(read_all(&again), version);
    let traffic = again.traffic().unwrap();
    assert_eq!((traffic.cache_misses, traffic.failures, s3.to_fail()), (0, 0, 1_000));
    assert_eq!(traffic.cache_hits, 2 + sections(&version) as u64);
}

#[test]
fn fsck_finds_objects_that_only_the_cache_has() {
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let cache = DiskCacheSettings { dir: dir.path().join("cache"), limit_bytes: 64 << 20 };
    let catalog = s3.cached(Some(&cache)).unwrap();
    let first = commit(&catalog, &gaussians(500, 0, 50.0, 1)).unwrap();
    commit(&catalog, &gaussians(500, 0, 50.0, 2)).unwrap();
    assert_eq!(catalog.version("street", Some(1)).unwrap(), first);
    let path = |hash: &str| s3.twins().join("street/objects").join(&hash[..2]).join(hash);
    for hash in [&first.manifest.table.object, &first.hash] {
        std::fs::remove_file(path(hash)).unwrap();
        assert_eq!(catalog.version("street", Some(1)).unwrap(), first, "as the disk has it");
        let found = catalog.verify("street", &mut |_, _| {}).unwrap().damaged;
        assert_eq!(found.iter().map(|damage| &damage.object).collect::<Vec<_>>(), [hash]);
        assert!(!catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());
        let error = catalog.rollback("street", 1).unwrap_err();
        assert!(error.to_string().contains(hash), "{error}");
    }
    assert_eq!(numbers(&catalog), [1, 2]);
}

#[test]
fn a_section_has_a_shorter_time_out_than_a_cell() {
    let s3 = S3::start();
    let version = commit(&s3.catalog(), &gaussians(500, 0, 50.0, 1)).unwrap();
    let section_timeout = Duration::from_millis(200);
    let section_tries = 2;
    let retry = RetryPolicy { section_timeout, section_tries, ..RetryPolicy::default() };
    let catalog = Catalog::over(s3.store(), &S3::url(), "twins", None, retry).unwrap();
    let chunk = &version.manifest.chunks[0];
    assert_eq!(catalog.read_and_discard(&version, chunk).unwrap(), chunk.bytes);
    s3.fail("GET", "/objects/", 2, Fault::Silence);
    let began = Instant::now();
    let error = catalog.section(&version, chunk, &chunk.sections[0]).unwrap_err();
    let StoreError::Io { cause, .. } = &error else { panic!("{error}") };
    assert_eq!((cause.kind(), s3.to_fail()), (std::io::ErrorKind::TimedOut, 0), "{error}");
    assert!(began.elapsed() < Duration::from_secs(20), "{:?}", began.elapsed());
}

fn sections(version: &Version) -> usize {
    version.manifest.chunks.iter().map(|chunk| chunk.sections.len()).sum()
}

#[test]
fn requests_work_from_threads_of_another_runtime() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    commit(&catalog, &gaussians(100, 0, 10.0, 1)).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    // The catalog is dropped within the runtime, too.
    let number = runtime.block_on(async move { catalog.version("street", None).unwrap().number });
    assert_eq!(number, 1);
}
