//! Files and directories, synced so that they survive a power cut.

use std::collections::BTreeSet;
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use crate::store::StoreError;
use crate::store::disk::{Disk, ReadFile};

/// Bytes read or written at once.
pub(super) const BUFFER_BYTES: usize = 256 << 10;
/// Errors of syncing a directory that belongs to another user, or whose file system cannot sync
/// directories.
const CANNOT_SYNC: [ErrorKind; 3] =
    [ErrorKind::PermissionDenied, ErrorKind::InvalidInput, ErrorKind::Unsupported];
/// First character of the name of a file that is being written.
pub(super) const WRITING: char = '~';

/// A file, and the hash of what was read from it or written to it.
#[derive(Debug)]
pub(super) struct HashingFile<F> {
    pub(super) inner: F,
    pub(super) hasher: blake3::Hasher,
}

impl<F> HashingFile<F> {
    pub(super) fn new(inner: F) -> Self {
        Self { inner, hasher: blake3::Hasher::new() }
    }
}

impl<F: Read> Read for HashingFile<F> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        Ok(read)
    }
}

impl<F: Write> Write for HashingFile<F> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Reads a file, up to a limit.
///
/// # Errors
/// The file system fails, or returns fewer bytes than the file's size.
pub(super) fn read_all(file: Box<dyn ReadFile>, limit_bytes: u64) -> io::Result<Vec<u8>> {
    // The limit bounds what is allocated, whatever size the file has.
    let size = file.size_bytes()?.min(limit_bytes);
    let mut bytes = Vec::with_capacity(size as usize);
    file.take(limit_bytes).read_to_end(&mut bytes)?;
    if (bytes.len() as u64) < size {
        let said = format!("it ended after {} of {size} bytes", bytes.len());
        return Err(io::Error::new(ErrorKind::UnexpectedEof, said));
    }
    Ok(bytes)
}

/// Names in a directory, sorted; none if it does not exist.
pub(super) fn entries(disk: &dyn Disk, dir: &Path) -> Result<Vec<String>, StoreError> {
    let mut names = match disk.list(dir) {
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        listing => listing.map_err(StoreError::io("list", dir))?,
    };
    names.sort_unstable();
    Ok(names)
}

/// Creates the directory of a file, as [`create_dirs`].
pub(super) fn create_parent(disk: &dyn Disk, path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), |dir| create_dirs(disk, dir))
}

/// Creates a directory and the missing ones above it, and makes their names durable: what is
/// written into a directory is lost in a power cut if the directory's own name is.
///
/// A directory that exists may have been created by a process that was stopped before it synced the
/// name. So that name is synced, too. The names above it are durable, because each is synced before
/// anything is created below it.
///
/// # Errors
/// [`StoreError::Io`] names the directory that cannot be created or synced.
pub fn create_dirs(disk: &dyn Disk, dir: &Path) -> Result<(), StoreError> {
    // The parent of "twins" is "", which is the current directory.
    if dir.as_os_str().is_empty() {
        return Ok(());
    }
    // It exists, but its name may not be durable yet.
    if is_dir(disk, dir) {
        return match dir.parent().map(|parent| disk.sync_dir(parent)) {
            // This process may not read the directory above, so that another user has created this
            // one; or its file system cannot sync directories.
            Some(Err(error)) if CANNOT_SYNC.contains(&error.kind()) => Ok(()),
            Some(synced) => synced.map_err(StoreError::io("sync", dir)),
            None => Ok(()),
        };
    }
    // The recursion ends at the first directory that exists.
    create_parent(disk, dir)?;
    create_dir(disk, dir)?;
    sync_parent(disk, dir)
}

/// Creates directories in an existing one, and makes their names durable, as [`create_dirs`], with
/// a single sync.
pub(super) fn create_dirs_in(
    disk: &dyn Disk,
    parent: &Path,
    dirs: &BTreeSet<PathBuf>,
) -> Result<(), StoreError> {
    for dir in dirs {
        if !is_dir(disk, dir) {
            create_dir(disk, dir)?;
        }
    }
    sync(disk, parent)
}

/// Creates a directory, whose name is not durable yet. Another process may create it at the same
/// time.
fn create_dir(disk: &dyn Disk, dir: &Path) -> Result<(), StoreError> {
    match disk.create_dir(dir) {
        // Another process may have been first, which is as good, if it made a directory.
        Err(error) if error.kind() != ErrorKind::AlreadyExists || !is_dir(disk, dir) => {
            Err(StoreError::io("create", dir)(error))
        }
        _ => Ok(()),
    }
}

fn is_dir(disk: &dyn Disk, dir: &Path) -> bool {
    disk.info(dir).is_ok_and(|found| found.is_dir)
}

/// Makes a new name durable by syncing its directory.
pub(super) fn sync_parent(disk: &dyn Disk, path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), |dir| sync(disk, dir))
}

pub(super) fn sync(disk: &dyn Disk, dir: &Path) -> Result<(), StoreError> {
    disk.sync_dir(dir).map_err(StoreError::io("sync", dir))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::store::local::RealDisk;

    #[test]
    fn directories_are_created_with_those_above_them() {
        let dir = tempfile::tempdir().unwrap();
        create_dirs(&RealDisk, &dir.path().join("a/b/c")).unwrap();
        create_dirs(&RealDisk, &dir.path().join("a/b/c")).unwrap();
        assert!(dir.path().join("a/b/c").is_dir());
        fs::write(dir.path().join("file"), "").unwrap();
        let said = create_dirs(&RealDisk, &dir.path().join("file/d")).unwrap_err().to_string();
        assert!(said.starts_with("cannot create"), "{said}");
    }
}
