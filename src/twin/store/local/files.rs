//! Files and directories, synced so that they survive a power cut.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use rustix::fs::OFlags;

use crate::store::StoreError;

/// Bytes read or written at once.
pub(super) const BUFFER_BYTES: usize = 256 << 10;
/// First character of the name of a file that is being written.
pub(super) const WRITING: char = '~';

/// A file, and the hash of what was read from it or written to it.
#[derive(Debug)]
pub(super) struct HashingFile {
    pub(super) inner: File,
    pub(super) hasher: blake3::Hasher,
}

impl HashingFile {
    pub(super) fn new(inner: File) -> Self {
        Self { inner, hasher: blake3::Hasher::new() }
    }
}

impl Read for HashingFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        Ok(read)
    }
}

impl Write for HashingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Opens a regular file for reading; see [`open_regular_with`].
pub(super) fn open_regular(path: &Path) -> io::Result<File> {
    open_regular_with(File::options().read(true), path)
}

/// Opens a regular file. The store writes nothing but regular files, so that anything else is damage or an attack:
/// opening a pipe would wait for ever, and a link could lead out of the twin.
pub(super) fn open_regular_with(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    // NONBLOCK concerns pipes and devices only; regular files ignore it.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let opened = options.custom_flags(flags.bits().cast_signed()).open(path);
    match opened {
        Ok(file) if file.metadata()?.is_file() => Ok(file),
        Ok(_) => Err(io::Error::other("it is not a regular file")),
        // The error of the system does not say what a link or a pipe is.
        Err(error) => Err(match fs::symlink_metadata(path) {
            Ok(found) if found.is_symlink() => io::Error::other("it is a symbolic link"),
            Ok(found) if !found.is_file() => io::Error::other("it is not a regular file"),
            _ => error,
        }),
    }
}

/// Names in a directory, sorted; none if it does not exist.
pub(super) fn entries(dir: &Path) -> Result<Vec<String>, StoreError> {
    let failed = || StoreError::io("list", dir);
    let listing = match fs::read_dir(dir) {
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        listing => listing.map_err(failed())?,
    };
    let mut names = Vec::new();
    for entry in listing {
        // The store writes only UTF-8 names, so any other is skipped.
        names.extend(entry.map_err(failed())?.file_name().into_string());
    }
    names.sort_unstable();
    Ok(names)
}

/// Creates the directory of a file, as [`create_dirs`].
pub(super) fn create_parent(path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), create_dirs)
}

/// Creates a directory and the missing ones above it, and syncs each: what is written into a
/// directory is lost in a power cut if the directory's own entry is.
pub(super) fn create_dirs(dir: &Path) -> Result<(), StoreError> {
    // The parent of "twins" is "", which is the current directory.
    if dir.as_os_str().is_empty() || dir.is_dir() {
        return Ok(());
    }
    create_parent(dir)?;
    match fs::create_dir(dir) {
        // Another process may have created it in between.
        Err(error) if error.kind() != ErrorKind::AlreadyExists || !dir.is_dir() => {
            Err(StoreError::io("create", dir)(error))
        }
        _ => sync_parent(dir),
    }
}

/// Makes a new name durable by syncing its directory.
pub(super) fn sync_parent(path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), sync)
}

/// Syncs a directory.
pub(super) fn sync(dir: &Path) -> Result<(), StoreError> {
    let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
    File::open(dir).and_then(|dir| dir.sync_all()).map_err(StoreError::io("sync", dir))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directories_are_created_with_those_above_them() {
        let dir = tempfile::tempdir().unwrap();
        create_dirs(&dir.path().join("a/b/c")).unwrap();
        create_dirs(&dir.path().join("a/b/c")).unwrap();
        assert!(dir.path().join("a/b/c").is_dir());
        fs::write(dir.path().join("file"), "").unwrap();
        let said = create_dirs(&dir.path().join("file/d")).unwrap_err().to_string();
        assert!(said.starts_with("cannot create"), "{said}");
    }
}
