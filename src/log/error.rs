//! Why a log was refused.

use std::path::{Path, PathBuf};

use wildcity_scene::rig::RigError;
use wildcity_sim::scenario::FileError;

/// Why a log, or a row of it, was refused.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// A file cannot be read or written.
    #[error("{}: {reason}", .path.display())]
    File { path: PathBuf, reason: String },
    /// The folder has no `log.json`.
    #[error(
        "{} is no log: it has no log.json; `python -m wildcity.logs` makes a log of a data set or a bag, and \
         `wildcity log generate` one of a twin",
        .folder.display()
    )]
    NoLog { folder: PathBuf },
    /// A table that the caller needs is missing.
    #[error("{} has no {table}: {needed_for}", .folder.display())]
    NoTable {
        folder: PathBuf,
        /// Name of the file.
        table: &'static str,
        /// What cannot be done without it, as the end of the message.
        needed_for: &'static str,
    },
    /// A field of `log.json` is wrong.
    #[error("{}: {field}: {reason}", .path.display())]
    Field { path: PathBuf, field: String, reason: String },
    /// A row of a table is wrong.
    #[error("{} line {line}: {field}{reason}", .path.display())]
    Row {
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// The field and a colon; empty if the line is not of the table's form.
        field: String,
        /// What is wrong with it, and what would be right.
        reason: String,
    },
    /// The rig cannot be used.
    #[error("{}: {cause}", .path.display())]
    Rig { path: PathBuf, cause: RigError },
    /// The map cannot be used.
    #[error("{}: {cause}", .path.display())]
    Map { path: PathBuf, cause: FileError },
    /// A tensor of a sweep is wrong.
    #[error("{}: {tensor}: {reason}", .path.display())]
    Sweep { path: PathBuf, tensor: &'static str, reason: String },
    /// A new log would replace something.
    #[error("{} exists: give another folder, or remove it", .path.display())]
    Exists { path: PathBuf },
}

impl LogError {
    /// A file that cannot be read or written, with the reason of the operating system.
    pub(crate) fn file(path: &Path, error: &std::io::Error) -> Self {
        Self::File { path: path.to_owned(), reason: error.to_string() }
    }

    /// A file that is not of its form.
    pub(crate) fn malformed(path: &Path, reason: impl ToString) -> Self {
        Self::File { path: path.to_owned(), reason: reason.to_string() }
    }
}

/// A field of a row or of the header, and what is wrong with it.
#[derive(Debug)]
pub struct FieldError {
    pub(crate) field: String,
    pub(crate) reason: String,
}

impl FieldError {
    /// A field with the value that it has and the values that it may have.
    pub(crate) fn new(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self { field: field.into(), reason: reason.into() }
    }
}
