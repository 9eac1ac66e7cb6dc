//! The file system under a directory of twins, as an interface.
//!
//! The store writes to disks through it, so that a simulation can take the disk's place: one that loses what was not
//! synced, fails, or stops the process between any two operations.

use std::any::Any;
use std::fmt::Debug;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::time::UNIX_EPOCH;

use rustix::fs::OFlags;

/// A file system.
pub trait Disk: Debug + Send + Sync {
    /// The names in a directory that are UTF-8, in any order. The store writes no others.
    ///
    /// # Errors
    /// As [`std::fs::read_dir`].
    fn list(&self, dir: &Path) -> io::Result<Vec<String>>;

    /// What is at a path; links to files are not followed.
    ///
    /// # Errors
    /// As [`std::fs::symlink_metadata`].
    fn info(&self, path: &Path) -> io::Result<FileInfo>;

    /// Opens a regular file for reading.
    ///
    /// # Errors
    /// There is none, or what is there is something else, such as a link or a pipe.
    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>>;

    /// Creates an empty file, in place of an older one.
    ///
    /// # Errors
    /// As [`std::fs::File::create`].
    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;

    /// Creates a directory in an existing one.
    ///
    /// # Errors
    /// As [`std::fs::create_dir`].
    fn create_dir(&self, dir: &Path) -> io::Result<()>;

    /// Renames a file, in place of an older one of the new name.
    ///
    /// # Errors
    /// As [`std::fs::rename`].
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Gives a file a second name.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] if the name is taken, which is decided atomically.
    fn link(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    /// As [`std::fs::remove_file`].
    fn remove_file(&self, path: &Path) -> io::Result<()>;

    /// Removes an empty directory.
    ///
    /// # Errors
    /// As [`std::fs::remove_dir`].
    fn remove_dir(&self, dir: &Path) -> io::Result<()>;

    /// Removes a directory with all that it holds.
    ///
    /// # Errors
    /// As [`std::fs::remove_dir_all`].
    fn remove_all(&self, dir: &Path) -> io::Result<()>;

    /// Makes the names in a directory durable.
    ///
    /// # Errors
    /// As [`std::fs::File::sync_all`].
    fn sync_dir(&self, dir: &Path) -> io::Result<()>;

    /// Locks a file until the lock is dropped, or the process ends, however it ends. `None` if another lock
    /// is held and `wait` is [`Wait::No`].
    ///
    /// # Errors
    /// The file cannot be opened or locked. It is created if need be, unless `wait` is [`Wait::NoAndExisting`].
    fn lock(&self, path: &Path, wait: Wait) -> io::Result<Option<Lock>>;
}

/// What is at a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileInfo {
    /// Size in bytes.
    pub bytes: u64,
    /// When it was last written, in microseconds since 1970.
    pub modified_us: i64,
    /// Whether it is a regular file.
    pub is_file: bool,
    /// Whether it is a directory.
    pub is_dir: bool,
}

/// A file that is read.
pub trait ReadFile: Read + Seek + Debug + Send {
    /// Its size in bytes.
    ///
    /// # Errors
    /// The file system fails.
    fn bytes(&self) -> io::Result<u64>;
}

/// A file that is written.
pub trait WriteFile: Write + Debug + Send {
    /// Makes what was written durable.
    ///
    /// # Errors
    /// As [`std::fs::File::sync_all`].
    fn sync(&mut self) -> io::Result<()>;
}

/// How [`Disk::lock`] takes a lock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wait {
    /// It waits until no one else holds it.
    Yes,
    /// It does not wait.
    No,
    /// It does not wait, and does not create the file.
    NoAndExisting,
}

/// A lock, until it is dropped.
#[derive(Debug)]
pub struct Lock {
    _held: Box<dyn Held>,
}

/// What keeps a lock.
pub trait Held: Any + Debug + Send + Sync {}

impl<T: Any + Debug + Send + Sync> Held for T {}

impl Lock {
    /// A lock that is held as long as something is.
    pub fn held_by(held: impl Held) -> Self {
        Self { _held: Box::new(held) }
    }
}

/// The file system of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct RealDisk;

impl Disk for RealDisk {
    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(dir)? {
            names.extend(entry?.file_name().into_string());
        }
        Ok(names)
    }

    fn info(&self, path: &Path) -> io::Result<FileInfo> {
        let found = fs::symlink_metadata(path)?;
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
        File::open(dir)?.sync_all()
    }

    fn lock(&self, path: &Path, wait: Wait) -> io::Result<Option<Lock>> {
        let create = wait != Wait::NoAndExisting;
        let file = open_regular(File::options().create(create).append(true), path)?;
        if wait == Wait::Yes {
            file.lock()?;
            return Ok(Some(Lock::held_by(file)));
        }
        match file.try_lock() {
            Ok(()) => Ok(Some(Lock::held_by(file))),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }
}

impl ReadFile for File {
    fn bytes(&self) -> io::Result<u64> {
        Ok(self.metadata()?.len())
    }
}

impl WriteFile for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// Opens a regular file. The store writes nothing but regular files, so that anything else is damage or an attack:
/// opening a pipe would wait for ever, and a link could lead out of the twin.
fn open_regular(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    // NONBLOCK concerns pipes and devices only; regular files ignore it.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    match options.custom_flags(flags.bits().cast_signed()).open(path) {
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
