//! Errors, with their remedies.

use std::io;
use std::path::{Path, PathBuf};

/// Why a data set was not made.
#[derive(Debug, thiserror::Error)]
pub enum AugmentError {
    /// A number of the plan is out of range.
    #[error("{field} is {value}; give {expected}")]
    Number { field: &'static str, value: f64, expected: String },
    /// The twin has no drive to offset views from.
    #[error("the twin has no recorded drive: `wildcity twin drive` adds one")]
    NoDrive,
    /// More samples than one round may have.
    #[error(
        "the round would have {samples} samples; at most {limit} are made: raise --every, or give fewer --offsets or \
         --cameras"
    )]
    Samples {
        samples: usize,
        /// The most samples of a round, [`crate::limits::MOST_SAMPLES`].
        limit: usize,
    },
    /// A camera's lens has no name in transforms.json and COLMAP.
    #[error(
        "camera {camera:?} has {lens}, which transforms.json and COLMAP cannot describe: leave --lenses away, and \
         pinholes of the lenses' fields are drawn"
    )]
    Lens {
        camera: String,
        /// Property of the lens that cannot be described.
        lens: &'static str,
    },
    /// Cameras of different models.
    #[error(
        "camera {camera:?} is {model}, and others are {other}, but a transforms.json has one camera_model: choose \
         cameras by --cameras, or leave --lenses away"
    )]
    MixedLenses {
        camera: String,
        model: &'static str,
        /// Model of the cameras before it.
        other: &'static str,
    },
    /// A folder that was made with something else.
    #[error(
        "{} was made with another {field}: {there} there, {here} here. Give another --out or --round, or delete the \
         folder",
        dir.display()
    )]
    MadeOtherwise {
        dir: PathBuf,
        /// The field that differs, by its name in augment.json.
        field: String,
        /// Its value in augment.json.
        there: String,
        here: String,
    },
    /// A folder with files, but without augment.json.
    #[error(
        "{} has files, but no augment.json: give an empty folder as --out, or one that `wildcity train augment` made",
        dir.display()
    )]
    NotOurs { dir: PathBuf },
    /// Another run writes to the folder.
    #[error("another `wildcity train augment` writes to {}: wait for it, or give another --out", dir.display())]
    InUse { dir: PathBuf },
    /// A file that cannot be understood.
    #[error("{}: {reason}. Delete the folder, and it is made anew", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// An image has another number of values than its camera.
    #[error("{what} has {values} values, but the image has {pixels} pixels")]
    Values { what: &'static str, values: usize, pixels: usize },
    /// A PNG cannot be encoded.
    #[error("cannot encode a PNG: {0}")]
    Png(String),
    /// A file cannot be read or written.
    #[error("{}: {cause}", path.display())]
    File { path: PathBuf, cause: io::Error },
}

impl AugmentError {
    /// Names the file of an error.
    pub(crate) fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |cause| Self::File { path, cause }
    }
}
