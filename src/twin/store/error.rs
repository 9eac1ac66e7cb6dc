//! What can go wrong with a twin on disk.

use std::io;
use std::path::{Path, PathBuf};

use crate::ingest::IngestError;
use crate::limits;
use wildcity_scene::RecordFormat;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::RigError;
use wildcity_scene::trajectory::TrajectoryError;

/// Why a twin could not be read or written. A failed commit leaves nothing behind, except
/// [`StoreError::NotSynced`] and [`StoreError::OutcomeUnknown`].
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The operating system refused.
    #[error("cannot {action} {}: {cause}", path.display())]
    Io {
        /// What was tried, as `write`.
        action: &'static str,
        /// On which file or directory.
        path: PathBuf,
        /// The reason given.
        cause: io::Error,
    },
    /// A twin's name could be mistaken for a path.
    #[error("{name:?} is not a name of a twin: 1 to 64 of a-z 0-9 . _ - are, not starting with .")]
    Name {
        /// The refused name.
        name: String,
    },
    /// No version of such a twin was ever committed.
    #[error("there is no twin {name:?} in {}; {}", dir.display(), known_twins(known))]
    NoTwin {
        /// The name asked for.
        name: String,
        /// Where it was looked for.
        dir: PathBuf,
        /// The twins that are there.
        known: Vec<String>,
    },
    /// The twin has other versions.
    #[error("twin {name:?} has no version {number}; the latest is {latest}")]
    NoVersion {
        /// The twin.
        name: String,
        /// The version asked for.
        number: u64,
        /// The newest one.
        latest: u64,
    },
    /// The version's objects were removed.
    #[error(
        "version {number} of twin {name:?} was removed by `wildcity twin gc`: take a later one"
    )]
    GarbageCollected {
        /// The twin.
        name: String,
        /// The version asked for.
        number: u64,
    },
    /// A version came into use in the moment in which its objects were to be removed.
    #[error(
        "version {number} of twin {name:?} came into use just now: nothing was removed; try again"
    )]
    Leased {
        /// The twin.
        name: String,
        /// The version.
        number: u64,
    },
    /// Bytes on disk are not what was committed.
    #[error("{} is damaged: {reason}; import the twin again", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What differs.
        reason: String,
    },
    /// Written by another version of this program.
    #[error(
        "{} has format {found}; this build reads format {supported}: import the twin again",
        path.display()
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// The format it says it has.
        found: u32,
        /// The format that can be read.
        supported: u32,
    },
    /// Somebody else committed the same number first.
    #[error("version {number} of twin {name:?} was committed by another import; try again")]
    Conflict {
        /// The twin.
        name: String,
        /// The version that was taken.
        number: u64,
    },
    /// A commit got the same cell twice.
    #[error(
        "cell {cell:?} of twin {name:?} was put before: give all its Gaussians at once, or only \
         the cells that are new"
    )]
    DuplicateCell {
        /// The twin.
        name: String,
        /// Grid cell (x, y).
        cell: [i32; 2],
    },
    /// Gaussians were stored in another way than the rest of the twin.
    #[error(
        "{field} is {stored}, but twin {name:?} has {needed}: store them so, or replace the whole twin"
    )]
    FieldMismatch {
        /// The twin.
        name: String,
        /// `sh_degree` or `record`.
        field: &'static str,
        /// What was put.
        stored: String,
        /// What is there.
        needed: String,
    },
    /// Others changed the same cells or settings since the base of a change.
    #[error(
        "twin {name:?} changed since version {base}, in the same place: version {latest} has other \
         {}; make the change from version {latest}",
        overlap(cells, settings)
    )]
    Overlap {
        /// The twin.
        name: String,
        /// The version that the change was made from.
        base: u64,
        /// The latest version.
        latest: u64,
        /// Grid cells (x, y) that both changed, in order of (y, x).
        cells: Vec<[i32; 2]>,
        /// Of `profile`, `sh_degree`, `record`, `rig`, `trajectories`, `sky`, what both changed.
        settings: Vec<&'static str>,
    },
    /// What is written beside the versions is too large to be read again.
    #[error(
        "{} would take {bytes} bytes; at most {limit} are read: give a lease a shorter holder, or \
         import a twin of so many versions anew",
        path.display()
    )]
    SideFileSize {
        /// Where it would lie.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The largest that is read.
        limit: u64,
    },
    /// A version is committed and visible, but the disk refused to say that it will stay.
    #[error(
        "version {number} of twin {name:?} is in place, but might not last through a power cut \
         ({cause}); import the same again"
    )]
    NotSynced {
        /// The twin.
        name: String,
        /// The version.
        number: u64,
        /// What failed.
        cause: Box<StoreError>,
    },
    /// The answer to the last step of a commit was lost, and cannot be asked for.
    #[error(
        "whether version {number} of twin {name:?} is in place is not known ({cause}): look with \
         `wildcity twin log`, and try again if it is not"
    )]
    OutcomeUnknown {
        /// The twin.
        name: String,
        /// The version.
        number: u64,
        /// What failed.
        cause: io::Error,
    },
    /// A URL of twins cannot be used.
    #[error("cannot use {url} for twins: {reason}")]
    Url {
        /// The URL.
        url: String,
        /// What is wrong with it, or with the credentials.
        reason: String,
    },
    /// The Gaussians of a commit cannot be used.
    #[error(transparent)]
    Gaussians(#[from] IngestError),
    /// The record is too narrow for the scene.
    #[error(
        "{count} of {gaussians} Gaussians have a value of {field} that record {record} cannot hold; \
         at most {} % may: store it with --record h52 or f32",
        100.0 * limits::CLAMPED_SHARE
    )]
    Clamped {
        /// The record.
        record: RecordFormat,
        /// The field with most of them.
        field: &'static str,
        /// How many values.
        count: u64,
        /// How many Gaussians there are.
        gaussians: u64,
    },
    /// The render profile of a commit cannot be used.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The rig of a commit cannot be used.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A trajectory of a commit cannot be used.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// Two trajectories share a name.
    #[error("two trajectories are named {name:?}: rename one")]
    DuplicateTrajectory {
        /// The name.
        name: String,
    },
    /// What describes a twin is too large.
    #[error(
        "the {what} would take {bytes} bytes; at most {limit} are read: shorten trajectories, or \
         split the scene"
    )]
    ManifestSize {
        /// `manifest`, or the `table` of its chunks' contents.
        what: &'static str,
        /// Its size.
        bytes: u64,
        /// The largest that is read.
        limit: u64,
    },
}

impl StoreError {
    /// Turns an I/O error into one that says what was tried on which file.
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |cause| Self::Io { action, path, cause }
    }
}

fn known_twins(known: &[String]) -> String {
    match known {
        [] => "it holds none".to_owned(),
        names => format!("it holds {}", names.join(", ")),
    }
}

/// The first few cells, and the settings.
fn overlap(cells: &[[i32; 2]], settings: &[&str]) -> String {
    const NAMED: usize = 8;
    let named = cells.iter().take(NAMED).map(|[x, y]| format!("({x}, {y})"));
    let mut said: Vec<String> = Vec::new();
    if !cells.is_empty() {
        let more = cells.len().saturating_sub(NAMED);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        said.push(format!("cells {}{more}", named.collect::<Vec<_>>().join(" ")));
    }
    said.extend(settings.iter().map(|&setting| setting.to_owned()));
    said.join(", ")
}
