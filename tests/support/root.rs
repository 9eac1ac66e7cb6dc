//! Where the repository is, whichever package runs the test.

use std::path::{Path, PathBuf};

/// The repository: the first folder above the package that has the lock file.
pub(crate) fn root() -> PathBuf {
    let mut above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    above
        .find(|dir| dir.join("Cargo.lock").is_file())
        .expect("a repository above the package")
        .to_owned()
}
