//! Files that a command leaves behind: whole, or as they were before.

use std::fs;
use std::path::Path;
use std::process;

use anyhow::Context;

/// Writes a file under another name in its directory, and then gives it its own: whoever looks,
/// even after a full disk, finds the old file or the new one.
pub(super) fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let cannot = || format!("cannot write {}", path.display());
    let name = path.file_name().context("no file name").with_context(cannot)?;
    let mut unfinished = name.to_owned();
    unfinished.push(format!(".{}.tmp", process::id()));
    let unfinished = path.with_file_name(unfinished);
    let written = fs::write(&unfinished, bytes).and_then(|()| fs::rename(&unfinished, path));
    if written.is_err() {
        // The first error is the one to tell; what cannot be removed was most likely never made.
        let _ = fs::remove_file(&unfinished);
    }
    written.with_context(cannot)
}

/// Makes the directory of `--out`, if it is not there.
pub(super) fn make_dir(dir: &Path) -> anyhow::Result<()> {
    anyhow::ensure!(
        !dir.exists() || dir.is_dir(),
        "--out {} is a file: give a directory",
        dir.display()
    );
    fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_whole_and_a_failure_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let names = || fs::read_dir(dir.path()).unwrap().count();
        let path = dir.path().join("image.png");
        write(&path, b"old").unwrap();
        write(&path, b"new").unwrap();
        assert_eq!((fs::read(&path).unwrap(), names()), (b"new".to_vec(), 1));

        let taken = dir.path().join("taken.png");
        fs::create_dir(&taken).unwrap();
        let said = format!("{:#}", write(&taken, b"new").unwrap_err());
        assert!(said.contains("cannot write") && said.contains("taken.png"), "{said}");
        assert_eq!(names(), 2, "the unfinished file is gone");
    }

    #[test]
    fn out_must_be_a_directory() {
        let dir = tempfile::tempdir().unwrap();
        make_dir(&dir.path().join("a/b")).unwrap();
        make_dir(dir.path()).unwrap();
        let file = dir.path().join("file");
        fs::write(&file, b"").unwrap();
        let said = make_dir(&file).unwrap_err().to_string();
        assert!(said.ends_with("file is a file: give a directory"), "{said}");
    }
}
