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

/// Runs a command on a file of a case; returns its standard error.
fn run(arguments: &[&str], at: &Path, is_accepted: bool) -> String {
    let output = wildcity().args(arguments).current_dir(at).output().unwrap();
    assert_eq!(output.status.success(), is_accepted, "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// A second import without axes used to turn and rescale the twin.
#[test]
fn a_new_version_has_the_axes_and_the_scale_of_the_last() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let Some(plain) = data::real("cases/ply_dialects/base.ply") else { return };
    let import = ["import", plain.to_str().unwrap(), "--twin", "street", "--twins", "twins"];
    let with = |options: &[&str]| run(&[&import[..], options].concat(), at, true);
    let latest = || Catalog::open(&at.join("twins")).unwrap().version("street", None).unwrap();
    let told = with(&[]);
    assert!(told.contains("note: axes=identity; most captures need --axes y-down"), "{told}");
    with(&["--axes", "y-down-z-forward", "--scale", "0.5"]);
    let second = latest();
    let told = with(&[]);
    assert!(told.contains("those of the twin, y-down-z-forward, are used"), "{told}");
    assert!(told.contains("note: ") && !told.contains("warning: "), "{told}");
    assert!(told.contains("that of the twin, 0.5, is used"), "{told}");
    assert_eq!(latest().manifest.chunks, second.manifest.chunks);
    assert_eq!(latest().manifest.provenance.options, second.manifest.provenance.options);
    // Options that are given win.
    let told = with(&["--axes", "y-up-z-back"]);
    assert!(!told.contains("those of the twin, y-"), "{told}");
    assert_eq!(latest().manifest.provenance.options, ["axes=y-up-z-back", "scale=0.5"]);
    with(&["--scale", "1"]);
    assert_eq!(latest().manifest.provenance.options, ["axes=y-up-z-back", "scale=1"]);
}

#[test]
fn what_a_file_says_goes_into_the_twin() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let Some(brush) = data::real("cases/antialiased_tag/brush_mip.ply") else { return };
    let brush = brush.to_str().unwrap();
    let profile_of = |name: &str| {
        let version = Catalog::open(&at.join("twins")).unwrap().version(name, None).unwrap();
        (version.manifest.profile.antialiased, version.manifest.profile.blur)
    };
    let told = run(&["import", brush, "--twin", "mip", "--twins", "twins"], at, true);
    assert!(told.contains("SplatRenderMode: mip") && told.contains("antialiased=true"), "{told}");
    assert_eq!(profile_of("mip"), (true, 0.1));
    let own = ["--set", "antialiased=false", "--set", "blur=0.2"];
    let import = ["import", brush, "--twin", "own", "--twins", "twins"];
    run(&[&import[..], &own[..]].concat(), at, true);
    assert_eq!(profile_of("own"), (false, 0.2));

    let spz = data::real("cases/spz_coordinate_system/v4_rdf_ext.spz").unwrap();
    let import = ["import", spz.to_str().unwrap(), "--twin", "spz", "--twins", "twins"];
    let told = run(&import, at, true);
    assert!(told.contains("6 (RDF): axes y-down-z-forward are used"), "{told}");
    let version = Catalog::open(&at.join("twins")).unwrap().version("spz", None).unwrap();
    assert_eq!(version.manifest.provenance.options[0], "axes=y-down-z-forward");
    let told = run(&[&import[..], &["--axes", "identity"]].concat(), at, true);
    assert!(
        told.contains("says axes y-down-z-forward; the given ones, identity, are used"),
        "{told}"
    );
}

#[test]
fn bad_rows_are_refused_once_and_left_out_on_request() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let Some(nan) = data::real("cases/bad_rows/nan1.ply") else { return };
    let import = ["import", nan.to_str().unwrap(), "--twin", "nan", "--twins", "twins"];
    let told = run(&import, at, false);
    assert!(told.contains("--drop-bad") && told.matches("Gaussian 3").count() == 1, "{told}");
    let told = run(&[&import[..], &["--drop-bad"]].concat(), at, true);
    assert!(told.contains("1 Gaussian left out"), "{told}");
    let version = Catalog::open(&at.join("twins")).unwrap().version("nan", None).unwrap();
    assert_eq!(version.manifest.gaussians(), 59);
}
