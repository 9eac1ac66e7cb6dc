//! Files that are generated from the code.

use std::fs;

#[path = "root.rs"]
pub(crate) mod root;

/// Compares a file of the repository with the text that the code has for it. With
/// `WILDCITY_BLESS=1` writes it instead; `test` are the arguments of `cargo test` that do.
pub(crate) fn check(file: &str, text: &str, test: &str) {
    let path = root::root().join(file);
    if std::env::var_os("WILDCITY_BLESS").is_some_and(|value| value == "1") {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
        return;
    }
    let found = fs::read_to_string(path).unwrap_or_default();
    assert!(found == text, "write {file} again: WILDCITY_BLESS=1 cargo test {test}");
}
