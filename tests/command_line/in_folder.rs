//! The program, run in a folder of its own.

use std::fs;
use std::path::Path;
use std::process::Output;

use crate::versions::files;
use crate::wildcity;

fn run(dir: &Path, arguments: &[&str]) -> Output {
    wildcity().args(arguments).current_dir(dir).env("XDG_DATA_HOME", dir).output().unwrap()
}

/// Standard output of a run that must succeed.
pub(crate) fn done(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Standard error of a run that must succeed.
pub(crate) fn warned(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// Standard error of a command whose options are refused.
pub(crate) fn misused(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// Standard error of a run that must fail with exit code 1.
pub(crate) fn refused(dir: &Path, arguments: &[&str]) -> String {
    let output = run(dir, arguments);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// Copies all files of a folder into another one.
pub(crate) fn copy(from: &Path, to: &Path) {
    for file in files(from) {
        let target = to.join(file.strip_prefix(from).unwrap());
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::copy(&file, target).unwrap();
    }
}
