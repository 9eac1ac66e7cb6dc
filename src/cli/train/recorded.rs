//! The options of the images that a twin was recorded with.

use std::ffi::OsString;
use std::path::PathBuf;

use crate::cli::Options;

/// The recorded images of a twin, with their cameras.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct RecordedImages {
    /// The recorded images with their cameras: the log that the twin was made of, or in the form of
    /// `wildcity eval --images`.
    #[arg(long, value_name = "FILE_OR_DIR")]
    pub(super) images: PathBuf,

    /// Folder of the recorded images, as for `wildcity eval`.
    #[arg(long, value_name = "DIR")]
    pub(super) image_dir: Option<PathBuf>,

    /// Folder of masks of the recorded images, as for `wildcity eval`.
    #[arg(long, value_name = "DIR")]
    pub(super) masks: Option<PathBuf>,

    /// Axes of the poses of --images, in the form of `wildcity import --axes` [default: as the twin
    /// was imported and aligned; identity for a list]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    pub(super) axes: Option<String>,

    /// Metres per unit of these poses; only with --axes, and applied after it [default: 1]
    #[arg(long, value_name = "M", requires = "axes")]
    pub(super) scale: Option<f64>,
}

impl RecordedImages {
    /// The same options for another command.
    pub(super) fn options(&self) -> Options {
        let Self { images, image_dir, masks, axes, scale } = self.clone();
        vec![
            ("--images", Some(images.into())),
            ("--image-dir", image_dir.map(OsString::from)),
            ("--masks", masks.map(OsString::from)),
            ("--axes", axes.map(OsString::from)),
            ("--scale", scale.map(|scale| scale.to_string().into())),
        ]
    }
}
