//! Errors, with their remedies.

use std::io;
use std::path::{Path, PathBuf};

/// Why a data set was not made.
#[derive(Debug, thiserror::Error)]
pub enum AugmentError {
    /// A number of the plan is out of range.
    #[error("{field} is {value}; give {expected}")]
    Number {
        /// The option.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The accepted values.
        expected: String,
    },
    /// The twin has no drive to offset views from.
    #[error("the twin has no recorded drive: `wildcity twin drive` adds one")]
    NoDrive,
    /// More samples than one round may have.
    #[error(
        "the round would have {samples} samples; at most {limit} are made: raise --every, or give fewer --offsets or \
         --cameras"
    )]
    Samples {
        /// Their number.
        samples: usize,
        /// [`crate::limits::MOST_SAMPLES`].
        limit: usize,
    },
    /// A camera's lens has no name in transforms.json and COLMAP.
    #[error(
        "camera {camera:?} has {lens}, which transforms.json and COLMAP cannot describe: leave --lenses away, and \
         pinholes of the lenses' fields are drawn"
    )]
    Lens {
        /// The camera.
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
        /// The camera.
        camera: String,
        /// Its model.
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
        /// The folder.
        dir: PathBuf,
        /// The field that differs, by its name in augment.json.
        field: String,
        /// Its value in augment.json.
        there: String,
        /// The value now.
        here: String,
    },
    /// A folder with files, but without augment.json.
    #[error(
        "{} has files, but no augment.json: give an empty folder as --out, or one that `wildcity augment` made",
        dir.display()
    )]
    NotOurs {
        /// The folder.
        dir: PathBuf,
    },
    /// Another run writes to the folder.
    #[error("another `wildcity augment` writes to {}: wait for it, or give another --out", dir.display())]
    InUse {
        /// The folder.
        dir: PathBuf,
    },
    /// A file that cannot be understood.
    #[error("{}: {reason}. Delete the folder, and it is made anew", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The error.
        reason: String,
    },
    /// An image has another number of values than its camera.
    #[error("{what} has {values} values, but the image has {pixels} pixels")]
    Values {
        /// The map.
        what: &'static str,
        /// Number of values.
        values: usize,
        /// Number of pixels.
        pixels: usize,
    },
    /// A PNG cannot be encoded.
    #[error("cannot encode a PNG: {0}")]
    Png(String),
    /// A file cannot be read or written.
    #[error("{}: {cause}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: io::Error,
    },
}

impl AugmentError {
    /// Names the file of an error.
    pub(crate) fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |cause| Self::File { path, cause }
    }
}
