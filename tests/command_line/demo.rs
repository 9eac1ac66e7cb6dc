//! The demo twin is built once, rebuilt when it is damaged, and never replaces a user's twin of
//! that name.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

use wildcity_twin::store::Catalog;

use crate::in_folder::copy;
use crate::scene_files::gaussians;
use crate::versions::{commit, street};
use crate::wildcity;

fn demo(dir: &Path) -> Output {
    demo_with(dir, &[])
}

fn demo_with(dir: &Path, arguments: &[&str]) -> Output {
    demo_command(dir, arguments).output().unwrap()
}

fn demo_command(dir: &Path, arguments: &[&str]) -> Command {
    let mut command = wildcity();
    command.args(["demo", "--steps", "1"]).args(arguments).arg("--twins").arg(dir.join("twins"));
    command.arg("--out").arg(dir.join("out"));
    command
}

/// The output of the first drive, with the demo twin that it built.
struct Built {
    said: String,
    dir: tempfile::TempDir,
}

/// The demo twin: it takes seconds to build, so it is built once for all tests.
fn built() -> &'static Built {
    static BUILT: OnceLock<Built> = OnceLock::new();
    BUILT.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let output = demo(dir.path());
        assert!(output.status.success(), "{output:?}");
        Built { said: String::from_utf8(output.stderr).unwrap(), dir }
    })
}

/// The first line that a demo prints; then it is killed.
fn first_line(dir: &Path) -> String {
    let mut child = demo_command(dir, &[]).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stderr.take().unwrap()).read_line(&mut line).unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
    line
}

/// Puts the demo twin into a directory of twins.
pub(crate) fn copy_demo_twin(twins: &Path) {
    copy(&built().dir.path().join("twins"), twins);
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
    copy_demo_twin(&dir.path().join("twins"));
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    let mut pictures = Vec::new();
    for scenario in ["cut-in", "traffic"] {
        let output = demo_with(dir.path(), &["--scenario", scenario]);
        assert!(output.status.success(), "{output:?}");
        pictures.push(fs::read(dir.path().join("out/step_0000.png")).unwrap());
        let list = catalog.actors().unwrap();
        let names: Vec<&str> = list.actors.iter().map(|actor| &*actor.description.name).collect();
        let all = ["bicycle", "bus", "crate", "hatchback", "pedestrian", "sedan", "truck", "van"];
        assert_eq!(names, all, "{scenario}");
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
    // A device that does not exist is refused before anything is drawn, but after the twin was
    // built.
    let rebuild = || {
        let output = demo_with(dir.path(), &["--backend", "gpu", "--device", "no such card"]);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(built().said.contains("building the twin demo in "));
    copy_demo_twin(&dir.path().join("twins"));
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    assert!(!drive().contains("building"), "built once");
    let names = fs::read_dir(dir.path().join("out")).unwrap();
    let names: Vec<String> =
        names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    assert!(names.iter().all(|name| !name.contains("uploads")), "{names:?}");
    let version = catalog.version("demo", None).unwrap();
    let object = |hash: &str| dir.path().join("twins/demo/objects").join(&hash[..2]).join(hash);
    let flip = |path: &Path| {
        let mut bytes = fs::read(path).unwrap();
        bytes[40] ^= 1;
        fs::write(path, bytes).unwrap();
    };
    let remove = |path: &Path| fs::remove_file(path).unwrap();
    let both = [object(&version.manifest.chunks[3].object), object(&version.hash)];
    for damage in [&flip as &dyn Fn(&Path), &remove] {
        // Damage of only one file is detected.
        for path in &both {
            let whole = fs::read(path).unwrap();
            damage(path);
            assert!(first_line(dir.path()).contains("(its files are damaged)"), "{path:?}");
            fs::write(path, whole).unwrap();
        }
        // Both are repaired by building the twin again.
        both.iter().for_each(|path| damage(path));
        assert!(rebuild().contains("(its files are damaged)"));
        assert_eq!(catalog.version("demo", None).unwrap(), version);
        assert_eq!(catalog.verify("demo", &mut |_, _| {}).unwrap().damaged.len(), 0);
    }
    assert!(!drive().contains("building"), "it can be driven");
}
