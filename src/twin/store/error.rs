//! Why a twin could not be read or written.

use std::io;
use std::path::{Path, PathBuf};

use crate::ingest::IngestError;
use crate::limits;
use wildcity_scene::RecordFormat;
use wildcity_scene::align::AlignmentError;
use wildcity_scene::geo::GeoError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::RigError;
use wildcity_scene::trajectory::TrajectoryError;

/// Why a twin could not be read or written. A failed commit leaves nothing behind, except after
/// [`StoreError::NotSynced`] and [`StoreError::OutcomeUnknown`].
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// An I/O operation failed.
    #[error("cannot {action} {}: {cause}", path.display())]
    Io {
        /// The operation, such as `write`.
        action: &'static str,
        /// The file, directory, or URL.
        path: PathBuf,
        cause: io::Error,
    },
    /// A text cannot be a twin's name.
    #[error(
        "{name:?} cannot be the name of a twin: names have 1 to 64 of a-z 0-9 . _ - and do not start with ."
    )]
    Name { name: String },
    /// No version of such a twin was ever committed.
    #[error("there is no twin {name:?} in {}; {}", dir.display(), known_twins(known))]
    NoTwin {
        name: String,
        /// The directory or URL of twins.
        dir: PathBuf,
        /// The twins that exist.
        known: Vec<String>,
    },
    /// The twin has no version of this number.
    #[error("twin {name:?} has no version {number}; the latest is {latest}")]
    NoVersion { name: String, number: u64, latest: u64 },
    /// Garbage collection removed the version's objects.
    #[error("version {number} of twin {name:?} was removed by `wildcity twin gc`: use a later one")]
    GarbageCollected { name: String, number: u64 },
    /// A version is leased that garbage collection was about to remove, or whose twin is to go.
    #[error(
        "version {number} of twin {name:?} is in use: nothing was removed; try again when it is not"
    )]
    Leased { name: String, number: u64 },
    /// Stored bytes differ from what was committed.
    #[error("{} is damaged: {reason}; import the twin again", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// Written by another version of this program.
    #[error(
        "{} has format {found}; this build reads format {supported}: import the twin again",
        path.display()
    )]
    Format {
        path: PathBuf,
        /// The format that the file states.
        found: u32,
        /// The format that can be read.
        supported: u32,
    },
    /// No asset of an actor has this name or hash, or several have it.
    #[error(
        "{} actor of name or hash {text:?}; {}",
        if *found == 0 { "there is no" } else { "there is more than one" },
        known_actors(*found, known)
    )]
    NoActor {
        /// The requested name or hash.
        text: String,
        /// Number of assets that have it.
        found: usize,
        /// The assets that have it, or else all that exist.
        known: Vec<String>,
    },
    /// An asset differs from what was stored, or cannot be read.
    #[error("{}", damaged_actor(hash, name.as_deref(), reason))]
    ActorDamaged {
        /// Its hash, 64 lower-case hex digits; only the first two if their folder of hashes is not
        /// a folder.
        hash: String,
        /// The name that it states, if that can be read. It may be damaged, too.
        name: Option<String>,
        reason: String,
    },
    /// An asset of another content has the name.
    #[error(
        "there is an actor {name:?} of another content already ({}): choose another name, since a name of two assets \
         stands for neither",
        hash.get(..12).unwrap_or(hash)
    )]
    ActorExists {
        name: String,
        /// The hash of the asset that has it.
        hash: String,
    },
    /// A box contains no Gaussian of the twin, or all of a cell's.
    #[error(
        "{}",
        match cell {
            None => "no Gaussian lies in the box, from 5 cm above its bottom on: check its place with `wildcity \
                     inspect`".to_owned(),
            Some([x, y]) => format!("no Gaussian would stay in cell ({x}, {y}): choose a smaller box"),
        }
    )]
    NothingToCut {
        /// Grid cell (x, y) of which none would stay.
        cell: Option<[i32; 2]>,
    },
    /// There is nothing to give a class.
    #[error(
        "no Gaussian has its centre in one of the boxes or on the ground: check the axes and the unit"
    )]
    NothingToLabel,
    /// Another commit took the same number first.
    #[error("version {number} of twin {name:?} was committed by another import; try again")]
    Conflict {
        name: String,
        /// The number that was taken.
        number: u64,
    },
    /// A cell was put twice into a commit.
    #[error(
        "cell {cell:?} of twin {name:?} was put before: put all its Gaussians at once, or only \
         cells that are new"
    )]
    DuplicateCell {
        name: String,
        /// Grid cell (x, y).
        cell: [i32; 2],
    },
    /// Gaussians are scattered over many cells.
    #[error(
        "{gaussians} Gaussians lie in {cells} cells of 64 m, fewer than {} in each: is the unit of the file metres? \
         Give its length with --scale, or remove Gaussians that are far from the scene",
        limits::GAUSSIANS_PER_CELL
    )]
    Scattered {
        gaussians: u64,
        /// Number of cells that they lie in.
        cells: usize,
    },
    /// Gaussians were stored in a different way from the rest of the twin.
    #[error(
        "{field} is {stored}, but twin {name:?} has {needed}: store the Gaussians with {needed}, or replace \
         the whole twin"
    )]
    FieldMismatch {
        name: String,
        /// `sh_degree` or `record`.
        field: &'static str,
        /// The value of what was put.
        stored: String,
        /// The value of the twin.
        needed: String,
    },
    /// The twin that a commit would make exists, perhaps since others made it meanwhile.
    #[error(
        "twin {name:?} exists already: give another name, or make the change from its version {latest}"
    )]
    TwinExists { name: String, latest: u64 },
    /// Other commits changed the same cells or settings since the base of a change.
    #[error(
        "twin {name:?} changed since version {base}, in the same place: version {latest} has other \
         {}; make the change from version {latest}",
        overlap(cells, settings)
    )]
    Overlap {
        name: String,
        /// The version that the change was made from.
        base: u64,
        latest: u64,
        /// Grid cells (x, y) that both changed, in order of (y, x).
        cells: Vec<[i32; 2]>,
        /// The fields of [`Diff::settings`](super::Diff::settings) that both changed. `alignment`
        /// is listed even if only others changed it.
        settings: Vec<&'static str>,
    },
    /// A side file (a lease, or the state of garbage collection) is too large to be read again.
    #[error(
        "{} would take {bytes} bytes; at most {limit} are read: give a lease a shorter holder, or \
         import a twin of so many versions anew",
        path.display()
    )]
    SideFileSize {
        /// The file that would be written.
        path: PathBuf,
        bytes: u64,
        /// The largest size that is read.
        limit: u64,
    },
    /// A version is committed and visible, but syncing it to the disk failed.
    #[error(
        "version {number} of twin {name:?} is in place, but might be lost in a power cut \
         ({cause}); import the same again"
    )]
    NotSynced { name: String, number: u64, cause: Box<StoreError> },
    /// The answer to the last request of a commit was lost, and the log cannot be read.
    #[error(
        "it is unknown whether version {number} of twin {name:?} was committed ({cause}): look with \
         `wildcity twin log`, and try again if it was not"
    )]
    OutcomeUnknown { name: String, number: u64, cause: io::Error },
    /// A URL of twins cannot be used.
    #[error("cannot use {url} for twins: {reason}")]
    Url {
        url: String,
        /// The error in it, or in the credentials.
        reason: String,
    },
    /// The Gaussians of a commit cannot be used.
    #[error(transparent)]
    Gaussians(#[from] IngestError),
    /// The record format cannot hold the values of the scene.
    #[error(
        "record {record} cannot hold {count} values of {field} in {gaussians} Gaussians; at most {} % \
         of as many as there are Gaussians may be clamped: store it with --record h52 or f32",
        100.0 * limits::CLAMPED_SHARE
    )]
    Clamped {
        record: RecordFormat,
        /// The field with the most such values.
        field: &'static str,
        /// Number of such values.
        count: u64,
        gaussians: u64,
    },
    /// The render profile of a commit cannot be used.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The rig of a commit cannot be used.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The place of the world on the earth is invalid.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// The alignment of a version cannot be used.
    #[error("the alignment of the twin with its capture: {0}")]
    Alignment(AlignmentError),
    /// A trajectory of a commit cannot be used.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// Two trajectories share a name.
    #[error("two trajectories are named {name:?}: rename one")]
    DuplicateTrajectory { name: String },
    /// The manifest or the table of a twin is too large.
    #[error(
        "the {what} would take {bytes} bytes; at most {limit} are read: shorten trajectories, or \
         split the scene"
    )]
    ManifestSize {
        /// `manifest`, or `table` for the table of its chunks' sections.
        what: &'static str,
        bytes: u64,
        /// The largest size that is read.
        limit: u64,
    },
    /// A recorded image or the table of them is too large.
    #[error(
        "the {what} of recorded images would take {bytes} bytes; at most {limit} are read: store fewer or smaller \
         images"
    )]
    ViewSize {
        /// `image` or `table`.
        what: &'static str,
        bytes: u64,
        /// The largest size that is read.
        limit: u64,
    },
}

impl From<AlignmentError> for StoreError {
    fn from(cause: AlignmentError) -> Self {
        Self::Alignment(cause)
    }
}

impl StoreError {
    /// Turns an I/O error into one that names the operation and the file.
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |cause| Self::Io { action, path, cause }
    }
}

fn damaged_actor(hash: &str, name: Option<&str>, reason: &str) -> String {
    // Of a folder only two digits are known.
    let Some(digits) = hash.get(..12) else {
        return format!(
            "no actor whose hash begins with {hash} can be read: {reason}; mend it in the store"
        );
    };
    let name = name.map(|name| format!(" ({name:?})")).unwrap_or_default();
    format!(
        "the actor {digits}{name} is damaged: {reason}; store it again, or remove it with \
         `wildcity actor remove {digits}`"
    )
}

fn known_twins(known: &[String]) -> String {
    match known {
        [] => "it holds none".to_owned(),
        names => format!("it holds {}", names.join(", ")),
    }
}

fn known_actors(found: usize, known: &[String]) -> String {
    const NAMED: usize = 20;
    let mut names = known.iter().take(NAMED).cloned().collect::<Vec<_>>().join(", ");
    if known.len() > NAMED {
        names += &format!(" and {} more", known.len() - NAMED);
    }
    match known {
        [] => "there are no actors: make one with `wildcity actor import`".to_owned(),
        _ if found > 0 => format!("give the hash of one: {names}"),
        _ => format!("`wildcity actor list` shows {names}"),
    }
}

/// Names the first few cells, and the settings.
fn overlap(cells: &[[i32; 2]], settings: &[&str]) -> String {
    const NAMED: usize = 8;
    let named = cells.iter().take(NAMED).map(|[x, y]| format!("({x}, {y})"));
    let mut said: Vec<String> = Vec::new();
    if !cells.is_empty() {
        let unnamed = cells.len().saturating_sub(NAMED);
        let more = if unnamed > 0 { format!(" and {unnamed} more") } else { String::new() };
        said.push(format!("cells {}{more}", named.collect::<Vec<_>>().join(" ")));
    }
    said.extend(settings.iter().map(|&setting| setting.to_owned()));
    said.join(", ")
}
