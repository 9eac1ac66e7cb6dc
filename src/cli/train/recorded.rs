//! The options of the images that a twin was recorded with.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::ensure;
use wildcity_eval::images::ImageList;
use wildcity_log::Log;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_twin::store::{Catalog, Version};

use super::images::ListedImages;
use super::log_images::LogImages;
use super::options::OpenedImages;
use crate::cli::{Options, file_notes, placement};

/// Recorded images in the axes of a twin.
pub(super) struct Recording {
    pub(super) images: OpenedImages,
    /// The recorded pose of each image.
    pub(super) world_from_camera: Vec<Pose>,
    /// A text by which a checkpoint knows the images.
    pub(super) inputs: String,
}

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

    /// Opens the images of a twin at a fraction of their size, with its trained poses if it has
    /// such. One of `held_out_every` is held out.
    pub(super) fn open(
        &self,
        catalog: &Catalog,
        base: &Version,
        size: f64,
        held_out_every: usize,
    ) -> anyhow::Result<Recording> {
        let Self { images, image_dir, masks, axes, .. } = self;
        if !Log::is_log(images) {
            let list = ImageList::read(images, image_dir.as_deref(), masks.as_deref())?;
            file_notes::print_warnings(images, &list.warnings)?;
            let mut listed = ListedImages::new(size, held_out_every);
            listed.add(&list, &self.alignment(catalog, base, &list)?)?;
            let world_from_camera = listed.poses();
            let inputs = listed.inputs();
            let images = OpenedImages::Listed(listed);
            return Ok(Recording { images, world_from_camera, inputs });
        }
        ensure!(
            image_dir.is_none() && masks.is_none() && axes.is_none(),
            "{} is a log, which names files and axes: leave --image-dir, --masks and --axes out",
            images.display()
        );
        let mut logged = LogImages::new(Log::open(images)?, size, held_out_every)?;
        // A scene fits the poses with which it was trained, not those that were recorded.
        if !logged.take_refined(&base.manifest) {
            writeln!(
                io::stderr(),
                "note: the twin has no trained poses of the log: those of the log are used"
            )?;
        }
        let world_from_camera = logged.world_from_camera();
        let inputs = logged.inputs()?;
        let images = OpenedImages::Logged(Box::new(logged));
        Ok(Recording { images, world_from_camera, inputs })
    }

    /// The transform from the axes of the recorded poses to those of the twin.
    fn alignment(
        &self,
        catalog: &Catalog,
        base: &Version,
        list: &ImageList,
    ) -> anyhow::Result<Alignment> {
        match &self.axes {
            Some(axes) => placement::imported(axes, self.scale.unwrap_or(1.0)),
            None if list.is_in_scene_axes => Ok(Alignment::IDENTITY),
            None => placement::from_version(catalog, base),
        }
    }
}
