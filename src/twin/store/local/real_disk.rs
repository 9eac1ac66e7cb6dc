//! The file system of this machine.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::Path;
use std::time::UNIX_EPOCH;

use rustix::fs::OFlags;

use crate::store::disk::{Disk, FileInfo, Lock, ReadFile, Wait, WriteFile, check_truncation};

/// The file system of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct RealDisk;

impl Disk for RealDisk {
    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(dir)? {
            // Names that are not UTF-8 are none of the store's, and are left out.
            names.extend(entry?.file_name().into_string());
        }
        Ok(names)
    }

    fn info(&self, path: &Path) -> io::Result<FileInfo> {
        let found = fs::symlink_metadata(path)?;
        // A time before 1970 counts as 1970.
        let since = found.modified()?.duration_since(UNIX_EPOCH).unwrap_or_default();
        Ok(FileInfo {
            bytes: found.len(),
            modified_us: i64::try_from(since.as_micros()).unwrap_or(i64::MAX),
            is_file: found.is_file(),
            // The directory of twins, or of one twin, may be a link to another disk.
            is_dir: fs::metadata(path).is_ok_and(|found| found.is_dir()),
        })
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        Ok(Box::new(open_regular(File::options().read(true), path)?))
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(File::create(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        Ok(Box::new(open_regular(File::options().append(true), path)?))
    }

    fn create_dir(&self, dir: &Path) -> io::Result<()> {
        fs::create_dir(dir)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::hard_link(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        fs::remove_dir(dir)
    }

    fn remove_all(&self, dir: &Path) -> io::Result<()> {
        fs::remove_dir_all(dir)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        // The parent of "twins" is "", which is the current directory.
        let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
        // An entry that is not a directory, such as a pipe, is an error, and must not block.
        let flags = OFlags::DIRECTORY.bits().cast_signed();
        File::options().read(true).custom_flags(flags).open(dir)?.sync_all()
    }

    fn lock(&self, path: &Path, wait: Wait) -> io::Result<Option<Lock>> {
        let create = wait != Wait::NoAndExisting;
        loop {
            let file = open_regular(File::options().create(create).append(true), path)?;
            if wait == Wait::Yes {
                file.lock()?;
            } else {
                match file.try_lock() {
                    Ok(()) => {}
                    Err(TryLockError::WouldBlock) => return Ok(None),
                    Err(TryLockError::Error(error)) => return Err(error),
                }
            }
            let locked = LockedFile(file);
            // The process that held it may have removed the file before it let go.
            if is_at(&locked.0, path)? {
                return Ok(Some(Lock::held_by(locked)));
            }
        }
    }
}

/// Whether an open file is the one at a path.
fn is_at(file: &File, path: &Path) -> io::Result<bool> {
    let own = file.metadata()?;
    match fs::symlink_metadata(path) {
        Ok(found) => Ok((found.dev(), found.ino()) == (own.dev(), own.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// A locked file, until it is dropped.
#[derive(Debug)]
pub(super) struct LockedFile(pub(super) File);

impl Drop for LockedFile {
    /// Closing the file is not enough: a process that another thread starts at this moment has a
    /// copy of it until its program begins, and a lock ends with the last copy.
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

impl ReadFile for File {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.metadata()?.len())
    }
}

impl WriteFile for File {
    fn truncate(&mut self, bytes: u64) -> io::Result<()> {
        check_truncation(self.metadata()?.len(), bytes)?;
        self.set_len(bytes)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// Opens a regular file. The store writes nothing but regular files, so that anything else is
/// damage or an attack: opening a pipe would wait for ever, and a link could lead out of the twin.
fn open_regular(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    // NONBLOCK concerns pipes and devices only; regular files ignore it.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    match options.custom_flags(flags.bits().cast_signed()).open(path) {
        Ok(file) if file.metadata()?.is_file() => Ok(file),
        Ok(_) => Err(io::Error::other("it is not a regular file")),
        // The error of the system does not name the kind of the entry, such as a link or a pipe.
        Err(error) => Err(match fs::symlink_metadata(path) {
            Ok(found) if found.is_symlink() => io::Error::other("it is a symbolic link"),
            Ok(found) if !found.is_file() => io::Error::other("it is not a regular file"),
            _ => error,
        }),
    }
}
