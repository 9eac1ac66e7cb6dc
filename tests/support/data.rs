//! The real data: `$WILDCITY_DATA`, or `../shared/data` next to the project.

use std::io::Write;
use std::path::PathBuf;

/// A file of the real data; `None`, with a note on standard error, where the data is absent.
///
/// # Panics
/// If the data is absent and `$WILDCITY_DATA_REQUIRED` is 1, as in CI on a machine that has the
/// data; or if the data exists without this file, which is a mistake in the test.
pub(crate) fn real(file: &str) -> Option<PathBuf> {
    let beside = crate::root::root().join("../shared/data");
    let root = std::env::var_os("WILDCITY_DATA").unwrap_or_else(|| beside.into());
    let root = PathBuf::from(root);
    if !root.is_dir() {
        let required = std::env::var_os("WILDCITY_DATA_REQUIRED").is_some_and(|set| set == "1");
        assert!(!required, "no real data at {}, and WILDCITY_DATA_REQUIRED=1", root.display());
        // Not eprintln: the test harness would swallow it.
        let test = std::thread::current().name().unwrap_or("a test").to_owned();
        let line = format!("NOT RUN: {test}: no real data at {}\n", root.display());
        std::io::stderr().write_all(line.as_bytes()).unwrap();
        return None;
    }
    let path = root.join(file);
    assert!(path.is_file(), "{} is missing from the real data", path.display());
    Some(path)
}
