//! Packages that a user of the client compiles.

use std::collections::BTreeSet;
use std::process::Command;

/// Largest number of crates that the client brings, itself included.
const CRATES: usize = 120;

#[test]
fn the_client_has_few_dependencies() {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--offline", "--locked", "--package", "wildcity-client"])
        .args(["--edges", "normal", "--prefix", "none", "--format", "{p}"])
        .current_dir(crate::root::root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    // A crate that was listed before is marked with `(*)`.
    let crates: BTreeSet<&str> = text.lines().map(|line| line.trim_end_matches(" (*)")).collect();
    assert!(crates.len() > 50, "{text}");
    assert!(crates.len() < CRATES, "{} crates: {crates:#?}", crates.len());
    for unwanted in ["axum", "image", "object_store", "wgpu", "wildcity-scene"] {
        let found = crates.iter().find(|name| name.split(' ').next() == Some(unwanted));
        assert_eq!(found, None);
    }
}
