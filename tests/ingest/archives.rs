//! Archives with several scenes: all are read, or the others are refused or named.

use wildcity_twin::ingest::{self, IngestError, ReadLimits, ReadScene};

use crate::format_files::{Files, gzip, nurec_plain, sog, zip};
use crate::scene_files::gaussians;

fn read(files: &[(String, Vec<u8>)]) -> Result<ReadScene, IngestError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene");
    std::fs::write(&path, zip(files, false)).unwrap();
    ingest::read_limited(&path, &ReadLimits::for_own_file(), &mut |_, _| {})
}

/// Partitions as 3dgrut names them, in another order.
fn partitions(with_cars: bool) -> Files {
    let parts = [(1, 5, 2), (0, 7, 1)];
    let parts = parts.map(|(number, count, seed)| {
        let payload = nurec_plain(&gaussians(count, 1, 5.0, seed), with_cars);
        (format!("street_partition_{number:03}.nurec"), gzip(&payload))
    });
    parts.into()
}

#[test]
fn partitions_of_nurec_are_one_scene() {
    let both = read(&partitions(false)).unwrap();
    assert_eq!(both.gaussians.len(), 12);
    let first = read(&partitions(false)[1..]).unwrap().gaussians;
    assert_eq!(both.gaussians.select(0..7), first);
    assert!(both.notes.warnings.is_empty(), "{:?}", both.notes);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.usdz");
    std::fs::write(&path, zip(&partitions(true), false)).unwrap();
    let (objects, _) = ingest::read_tracked(&path, &mut |_, _| {}).unwrap();
    let found: Vec<(&str, usize)> =
        objects.iter().map(|object| (&object.track[..], object.gaussians.len())).collect();
    assert_eq!(found, [("car 7", 4 + 3), ("car 9", 3 + 2)]);
}

#[test]
fn transforms_of_usd_layers_are_named() {
    let with = |name: &str, layer: &str| {
        let layer = (name.to_owned(), layer.as_bytes().to_vec());
        read(&[&[layer], &partitions(false)[1..]].concat()).unwrap().notes.warnings.join("; ")
    };
    assert_eq!(with("default.usda", "#usda 1.0\n"), "");
    let moved = "#usda 1.0\ndef Xform \"World\" { double3 xformOp:translate=(100, 0, 0) }";
    for (name, layer) in [("default.usda", moved), ("gauss.usdc", "PXR-USDC")] {
        let told = with(name, layer);
        assert!(told.starts_with("transforms of USD layers") && told.ends_with(name), "{told}");
    }
}

#[test]
fn several_scenes_of_sog_are_refused_or_named() {
    let below = |folder: &str| {
        let files = sog(&gaussians(6, 0, 5.0, 3), 2).into_iter();
        files.map(|(name, bytes)| (format!("{folder}{name}"), bytes)).collect::<Files>()
    };
    let text = read(&[below("a/"), below("b/")].concat()).unwrap_err().to_string();
    assert!(text.contains("several scenes: a/meta.json, b/meta.json"), "{text}");
    let nested = read(&[below("a/"), below("a/old/")].concat()).unwrap();
    let wanted = ["further scenes in the archive not read: a/old/meta.json"];
    assert_eq!(
        (nested.gaussians.len(), &nested.notes.warnings[..]),
        (6, &wanted.map(String::from)[..])
    );
}
