//! The demo twin is built once, rebuilt when it is damaged, and never replaces a user's twin of that name.

use std::fs;
use std::path::Path;
use std::process::Output;

use wildcity_twin::store::Catalog;

use crate::scene_files::gaussians;
use crate::versions::{commit, street};
use crate::wildcity;

fn demo(dir: &Path) -> Output {
    demo_with(dir, &[])
}

fn demo_with(dir: &Path, arguments: &[&str]) -> Output {
    let mut command = wildcity();
    command.args(["demo", "--steps", "1"]).args(arguments).arg("--twins").arg(dir.join("twins"));
    command.arg("--out").arg(dir.join("out")).output().unwrap()
}

#[test]
fn a_twin_of_the_same_name_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let twins = dir.path().join("twins");
    let scene = gaussians(100, 0, 10.0, 1);
    let mine = commit(&twins, wildcity_twin::store::NewVersion { name: "demo", ..street(&scene) });
    let output = demo(dir.path());
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        said.contains("twin \"demo\" in ") && said.contains("is not the demo street"),
        "{said}"
    );
    assert!(said.contains("give another directory with --twins"), "{said}");
    assert_eq!(Catalog::open(&twins).unwrap().version("demo", None).unwrap(), mine.unwrap());
}

#[test]
fn a_demo_with_traffic_makes_its_assets_and_mends_them() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    let mut pictures = Vec::new();
    for scenario in ["cut-in", "traffic"] {
        let output = demo_with(dir.path(), &["--scenario", scenario]);
        assert!(output.status.success(), "{output:?}");
        pictures.push(fs::read(dir.path().join("out/step_0000.png")).unwrap());
        let list = catalog.actors().unwrap();
        let names: Vec<&str> = list.actors.iter().map(|actor| &*actor.description.name).collect();
        assert_eq!(names, ["hatchback", "pedestrian", "sedan", "van"], "{scenario}");
        assert_eq!(list.damaged, []);
        // The next one finds a damaged asset.
        let hash = &list.actors[0].hash;
        let path = dir.path().join("twins/.actors/objects").join(&hash[..2]).join(hash);
        fs::write(path, "damaged").unwrap();
    }
    assert!(demo(dir.path()).status.success());
    pictures.push(fs::read(dir.path().join("out/step_0000.png")).unwrap());
    assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2] && pictures[0] != pictures[2]);
}

#[test]
fn a_damaged_demo_twin_is_built_again() {
    let dir = tempfile::tempdir().unwrap();
    let drive = || {
        let output = demo(dir.path());
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    assert!(drive().contains("building the demo twin in "));
    assert!(!drive().contains("building"), "built once");
    let names = fs::read_dir(dir.path().join("out")).unwrap();
    let names: Vec<String> =
        names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    assert!(names.iter().all(|name| !name.contains("uploads")), "{names:?}");
    let version = catalog.version("demo", None).unwrap();
    let object = |hash: &str| dir.path().join("twins/demo/objects").join(&hash[..2]).join(hash);
    for hash in [&version.manifest.chunks[3].object, &version.hash] {
        let mut bytes = fs::read(object(hash)).unwrap();
        bytes[40] ^= 1;
        fs::write(object(hash), bytes).unwrap();
        assert!(drive().contains("(its files are damaged)"));
        fs::remove_file(object(hash)).unwrap();
        assert!(drive().contains("(its files are damaged)"));
        assert_eq!(catalog.version("demo", None).unwrap(), version);
        assert_eq!(catalog.verify("demo", &mut |_, _| {}).unwrap().damaged.len(), 0);
    }
}
