//! A file system, as an interface.
//!
//! The store writes to disks through it, and so does the server's spool of uploads, so that a
//! simulation can take the disk's place: one that loses what was not synced, fails, or stops the
//! process between any two operations.

use std::any::Any;
use std::fmt::Debug;
use std::io::{self, Read, Seek, Write};
use std::path::Path;

/// A file system.
pub trait Disk: Debug + Send + Sync {
    /// The names in a directory that are UTF-8, in any order. The store writes no others.
    ///
    /// # Errors
    /// As [`std::fs::read_dir`].
    fn list(&self, dir: &Path) -> io::Result<Vec<String>>;

    /// The kind of the entry at a path; links to files are not followed.
    ///
    /// # Errors
    /// As [`std::fs::symlink_metadata`].
    fn info(&self, path: &Path) -> io::Result<FileInfo>;

    /// Opens a regular file for reading.
    ///
    /// # Errors
    /// The path does not exist, or is something else, such as a link or a pipe.
    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>>;

    /// Creates an empty file, in place of an older one.
    ///
    /// # Errors
    /// As [`std::fs::File::create`].
    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;

    /// Opens a regular file to write at its end.
    ///
    /// # Errors
    /// As [`Disk::open`].
    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;

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

    /// Locks a file until the lock is dropped, or the process ends, however it ends. `None` if
    /// another lock is held and `wait` is [`Wait::No`].
    ///
    /// # Errors
    /// The file cannot be opened or locked. It is created if need be, unless `wait` is
    /// [`Wait::NoAndExisting`].
    fn lock(&self, path: &Path, wait: Wait) -> io::Result<Option<Lock>>;
}

/// The kind of the entry at a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileInfo {
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
    fn size_bytes(&self) -> io::Result<u64>;
}

/// A file that is written.
pub trait WriteFile: Write + Debug + Send {
    /// Discards all bytes from an offset on.
    ///
    /// # Errors
    /// As [`std::fs::File::set_len`]; [`io::ErrorKind::UnexpectedEof`] if the file has fewer bytes,
    /// to which none are added.
    fn truncate(&mut self, bytes: u64) -> io::Result<()>;

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

/// An object that holds a lock until it is dropped.
pub trait Held: Any + Debug + Send + Sync {}

impl<T: Any + Debug + Send + Sync> Held for T {}

/// Refuses to truncate a file of `found` bytes to more of them.
///
/// # Errors
/// [`io::ErrorKind::UnexpectedEof`], with both numbers.
pub fn check_truncation(found: u64, bytes: u64) -> io::Result<()> {
    if found >= bytes {
        return Ok(());
    }
    let reason = format!("the file has {found} bytes, and must have at least {bytes}");
    Err(io::Error::new(io::ErrorKind::UnexpectedEof, reason))
}

impl Lock {
    /// A lock that is held as long as something is.
    pub fn held_by(held: impl Held) -> Self {
        Self { _held: Box::new(held) }
    }
}
