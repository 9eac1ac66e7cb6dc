//! Standard output, and files that a command writes: afterwards each file is complete, or as it was
//! before.

use std::fs;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::Path;
use std::process;

use anyhow::Context;

/// Standard output. What is written after its reader has gone, as with `| head`, is dropped: the
/// command ends as it would otherwise, with the exit code of what it found.
pub fn stdout() -> Stdout {
    Stdout(io::stdout().lock())
}

/// The output of [`stdout`].
pub struct Stdout(io::StdoutLock<'static>);

impl Write for Stdout {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.0.write(bytes) {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(bytes.len()),
            written => written,
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self.0.flush() {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
            flushed => flushed,
        }
    }
}

/// Writes a file under a temporary name in the same directory, and then renames it. A reader finds
/// the old file or the new one, even after a full disk.
pub fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write_by(path, |file| Ok(file.write_all(bytes)?))
}

/// The same for a file that is written part by part.
pub fn write_by(
    path: &Path,
    contents: impl FnOnce(&mut BufWriter<fs::File>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let cannot = || format!("cannot write {}", path.display());
    let name = path.file_name().context("the path has no file name").with_context(cannot)?;
    let mut temporary_name = name.to_owned();
    temporary_name.push(format!(".{}.tmp", process::id()));
    let temporary = path.with_file_name(temporary_name);
    let write = || {
        let mut file = BufWriter::new(fs::File::create(&temporary)?);
        contents(&mut file)?;
        file.flush()?;
        Ok(fs::rename(&temporary, path)?)
    };
    let written: anyhow::Result<()> = write();
    if written.is_err() {
        // The first error is the one to report. A file that cannot be removed was most likely never
        // made.
        let _ = fs::remove_file(&temporary);
    }
    written.with_context(cannot)
}

/// Checks, before a long run, that the folder of a file is there.
pub fn check_folder(option: &str, file: &Path) -> anyhow::Result<()> {
    // The folder of a bare name is the current one.
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    let is_there = folder.is_none_or(Path::is_dir);
    anyhow::ensure!(is_there, "{option} {}: there is no such folder: create it", file.display());
    Ok(())
}

/// A number of things: `1 chunk`, `2 chunks`.
pub fn counted(number: usize, thing: &str) -> String {
    let s = if number == 1 { "" } else { "s" };
    format!("{number} {thing}{s}")
}

/// Creates the directory of `--out`, if it is missing.
pub fn create_dir(dir: &Path) -> anyhow::Result<()> {
    anyhow::ensure!(
        !dir.exists() || dir.is_dir(),
        "--out {} is a file: give a directory",
        dir.display()
    );
    fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_whole_and_a_failure_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let count = || fs::read_dir(dir.path()).unwrap().count();
        let path = dir.path().join("image.png");
        write(&path, b"old").unwrap();
        write(&path, b"new").unwrap();
        assert_eq!((fs::read(&path).unwrap(), count()), (b"new".to_vec(), 1));

        let taken = dir.path().join("taken.png");
        fs::create_dir(&taken).unwrap();
        let message = format!("{:#}", write(&taken, b"new").unwrap_err());
        assert!(message.contains("cannot write") && message.contains("taken.png"), "{message}");
        assert_eq!(count(), 2, "the temporary file is gone");
    }

    #[test]
    fn out_must_be_a_directory() {
        let dir = tempfile::tempdir().unwrap();
        create_dir(&dir.path().join("a/b")).unwrap();
        create_dir(dir.path()).unwrap();
        let file = dir.path().join("file");
        fs::write(&file, b"").unwrap();
        let message = create_dir(&file).unwrap_err().to_string();
        assert!(message.ends_with("file is a file: give a directory"), "{message}");
    }
}
