//! The program, run in a folder of its own.

use std::path::Path;
use std::process::Output;

use crate::wildcity;

fn run(dir: &Path, arguments: &[&str]) -> Output {
    wildcity().args(arguments).current_dir(dir).env("XDG_DATA_HOME", dir).output().unwrap()
}

/// What it prints when it succeeds.
pub(crate) fn done(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// What it says when it refuses.
pub(crate) fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}
