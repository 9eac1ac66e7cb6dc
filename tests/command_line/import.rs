//! Real captures through the command line.

use std::path::Path;

use wildcity_twin::store::{Catalog, Version};

use crate::{data, wildcity};

fn import(file: &str, name: &str, twins: &Path) -> Option<Version> {
    let source = data::real(file)?;
    let output = wildcity()
        .arg("import")
        .arg(source)
        .args(["--twin", name, "--axes", "y-down-z-forward", "--twins"])
        .arg(twins)
        .output()
        .unwrap();
    assert!(output.status.success(), "{file}: {output:?}");
    Some(Catalog::open(twins).unwrap().version(name, None).unwrap())
}

#[test]
fn the_same_skull_in_two_formats_makes_the_same_objects() {
    let dir = tempfile::tempdir().unwrap();
    let Some(one) = import("conformance/skull_small.ply", "ply", dir.path()) else { return };
    let two = import("conformance/skull_small.safetensors", "tensors", dir.path()).unwrap();
    assert_eq!(one.manifest.gaussians(), 19_300);
    assert_eq!(one.manifest.chunks, two.manifest.chunks);
    assert_ne!(one.hash, two.hash, "they come from different files");
}

#[test]
fn skull_and_biker_stand_upright_and_whole() {
    let dir = tempfile::tempdir().unwrap();
    let Some(skull) = import("scenes/skull/skull.ply", "skull", dir.path()) else { return };
    assert_eq!(skull.manifest.gaussians(), 82_621);
    let again = import("scenes/skull/skull.ply", "skull", dir.path()).unwrap();
    assert_eq!(again, skull, "the same import is the same version");
    let biker = import("scenes/biker/biker.compressed.ply", "biker", dir.path()).unwrap();
    assert_eq!(biker.manifest.gaussians(), 152_746);
    for twin in ["skull", "biker"] {
        let verified = Catalog::open(dir.path()).unwrap().verify(twin, &mut |_, _| {}).unwrap();
        assert_eq!(verified.damaged.len(), 0);
    }
}
