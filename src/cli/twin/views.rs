//! `wildcity twin views`.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use image::RgbImage;
use image::imageops::{self, FilterType};

use wildcity_augment::mask_png;
use wildcity_eval::images::{ImageList, RealImage, camera_names, own_vehicle, picture};
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Camera;
use wildcity_scene::manifest::ObjectRef;
use wildcity_scene::trajectory::NearestPlace;
use wildcity_scene::views::{RecordedView, reduced_mask};
use wildcity_scene::{Manifest, Trajectory};
use wildcity_twin::store::{Commit, CommitKind, StorageOptions, VersionChange};

#[cfg(feature = "log")]
use crate::cli::directories::TwinVersion;
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::{file_notes, placement, progress};

use super::change;

/// Give a twin the images of its recorded drive, or remove them: makes a new version with the same
/// Gaussians.
///
/// A repair model can compare a rendered image with recorded ones (docs/repair.md). The images are
/// stored as JPEG in the size that --side says, with their cameras. Each belongs to the place of
/// the drive that is nearest to its camera. Masks are stored with the images. Masked pixels are not
/// warped into views, and neither are pixels under the overlay of the rig's camera of the same
/// name. Open sessions keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("action").args(["images", "remove"]).required(true))]
pub(in crate::cli) struct Views {
    #[command(flatten)]
    edited: EditedTwin,

    /// The images with their cameras: a transforms.json, a COLMAP model, a camera list, or a log,
    /// in the format of `wildcity eval --images`.
    #[arg(long, value_name = "FILE_OR_DIR")]
    images: Option<PathBuf>,

    /// Folder of the images, as for `wildcity eval`.
    #[arg(long, value_name = "DIR", requires = "images")]
    image_dir: Option<PathBuf>,

    /// Axes of the poses, in the form of `wildcity import --axes` [default: as the twin was
    /// imported and aligned; identity for a list]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true, requires = "images")]
    axes: Option<String>,

    /// Metres per unit of the poses; only with --axes, and applied after it [default: 1]
    #[arg(long, value_name = "M", requires = "axes")]
    scale: Option<f64>,

    /// Smallest distance between two images of a camera along the drive, in metres: 2 or 2m. Images
    /// up to a tenth nearer are kept.
    #[arg(long, value_name = "M", default_value_t = EVERY_M, value_parser = metres)]
    every: f64,

    /// Longest side of a stored image, in pixels. Larger images are scaled down. Six cameras with
    /// an image every 2 m take 0.4 GB per km.
    #[arg(long, value_name = "PX", default_value_t = SIDE_PX, value_parser = clap::value_parser!(u32).range(16..=8192))]
    side: u32,

    /// Quality of the JPEGs.
    #[arg(long, value_name = "Q", default_value_t = QUALITY, value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: u8,

    /// Remove the images.
    #[arg(long)]
    remove: bool,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin views street --images capture/transforms.json
  wildcity twin views street --images capture --image-dir capture/images_2 --every 4m --side 480
  wildcity twin views street --remove";

/// The default of --every, in metres.
const EVERY_M: f64 = 2.0;

/// The default of --side, in pixels.
const SIDE_PX: u32 = 720;

/// The default of --quality.
const QUALITY: u8 = 90;

/// Tolerance of --every: an image is kept if its distance is at most this share below it. In a
/// bend, a camera travels another distance than the drive; without the tolerance, images that were
/// recorded every 2 m would be kept every 4 m.
const SLACK: f64 = 0.1;

/// Largest median distance of the images from the drives, in metres. A larger one means that the
/// poses have other axes or another unit: cameras of a vehicle are within some metres, and another
/// lane is within 20 m.
const MOST_MEDIAN_M: f64 = 20.0;

/// An image of the list with its place on the drive.
struct Placed<'a> {
    image: &'a RealImage,
    camera_name: String,
    trajectory: &'a Trajectory,
    place: NearestPlace,
    alignment: &'a Alignment,
}

impl Views {
    /// The images of a log for the twin that was just imported with it: one of each camera every
    /// 2 m.
    #[cfg(feature = "log")]
    pub(in crate::cli) fn from_log(twin: &str, log: PathBuf, twins: Twins) -> Self {
        Self {
            edited: EditedTwin { twin: TwinVersion { name: twin.to_owned(), number: None } },
            images: Some(log),
            image_dir: None,
            axes: None,
            scale: None,
            every: EVERY_M,
            side: SIDE_PX,
            quality: QUALITY,
            remove: false,
            twins,
        }
    }

    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let manifest = &base.manifest;
        let storage = StorageOptions { record: manifest.record, ..StorageOptions::default() };
        let mut commit = catalog.begin(&self.edited.twin.name, CommitKind::Import, storage)?;
        let mut listed = 0;
        match &self.images {
            None => commit.set_views(None),
            Some(images) => {
                ensure!(
                    !manifest.trajectories.is_empty(),
                    "twin {} has no recorded drive that images could belong to: `wildcity twin drive` adds one",
                    self.edited.twin.name
                );
                let list = ImageList::read(images, self.image_dir.as_deref(), None)?;
                file_notes::print_warnings(images, &list.warnings)?;
                let alignment = match &self.axes {
                    Some(axes) => placement::imported(axes, self.scale.unwrap_or(1.0))?,
                    None if list.is_in_scene_axes => Alignment::IDENTITY,
                    None => placement::from_version(&catalog, &base)?,
                };
                listed = list.every(1).len();
                let stored = self.put(&mut commit, manifest, &list, &alignment)?;
                let views = commit.put_views(&stored)?;
                commit.set_views(Some(views));
            }
        }
        let change = VersionChange::edit();
        let version = commit.change(base.number, change)?;
        let what =
            version.manifest.views.as_ref().map_or("no recorded images".to_owned(), |views| {
                let mb = views.image_bytes as f64 * 1e-6;
                let of = match listed {
                    listed if listed as u64 == views.images => String::new(),
                    listed => format!("; the list has {listed}, others are nearer than --every"),
                };
                format!("{} recorded images of {mb:.1} MB{of}", views.images)
            });
        change::print(&version, &what)
    }

    /// Stores the images that are kept. Returns their table, camera by camera along the drives.
    fn put(
        &self,
        commit: &mut Commit,
        manifest: &Manifest,
        list: &ImageList,
        alignment: &Alignment,
    ) -> anyhow::Result<Vec<RecordedView>> {
        let images = list.every(1);
        let names = camera_names(&images);
        let mut placed: Vec<Placed<'_>> = Vec::with_capacity(images.len());
        for (image, camera_name) in images.into_iter().zip(names) {
            let at_m = alignment.pose(&image.world_from_camera).position_m;
            let drives = manifest.trajectories.iter().map(|drive| (drive, drive.nearest(at_m)));
            let nearest = drives.min_by(|(_, a), (_, b)| a.distance_m.total_cmp(&b.distance_m));
            let (trajectory, place) = nearest.context("the twin has no recorded drive")?;
            placed.push(Placed { image, camera_name, trajectory, place, alignment });
        }
        let mut distances_m: Vec<f64> = placed.iter().map(|one| one.place.distance_m).collect();
        // The median: a few images beside the drives, such as those of a crossing, are no mistake.
        distances_m.sort_by(f64::total_cmp);
        let median_m = distances_m.get(distances_m.len() / 2).copied().unwrap_or(0.0);
        ensure!(
            median_m <= MOST_MEDIAN_M,
            "half of the images are {median_m:.0} m or more from the drives of the twin, and at most {MOST_MEDIAN_M} m are possible: \
             the poses have other axes or another unit; see --axes and --scale"
        );
        let order = |one: &Placed<'_>| (one.trajectory.name.clone(), one.camera_name.clone());
        // Images of one camera along one drive follow one another, so that each needs to be
        // compared only with the one that was kept last.
        placed.sort_by(|a, b| {
            order(a).cmp(&order(b)).then(a.place.station_m.total_cmp(&b.place.station_m))
        });
        let mut kept: Vec<Placed<'_>> = Vec::new();
        for one in placed {
            let is_near = kept.last().is_some_and(|last| {
                order(last) == order(&one)
                    && one.place.station_m - last.place.station_m < (1.0 - SLACK) * self.every
            });
            if !is_near {
                kept.push(one);
            }
        }
        let bar = progress::count("storing");
        bar.set_length(kept.len() as u64);
        let mut views = Vec::with_capacity(kept.len());
        for one in kept {
            let about = || format!("image {}", one.image.name);
            let stored = self.store(commit, manifest, &one).with_context(about)?;
            let (camera, image, mask) = stored;
            views.push(RecordedView {
                trajectory: one.trajectory.name.clone(),
                station_m: one.place.station_m,
                camera_name: one.camera_name,
                camera,
                world_from_camera: one.alignment.pose(&one.image.world_from_camera),
                exposure_stops: one.image.exposure_stops,
                image,
                mask,
            });
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(views)
    }

    /// Stores an image, scaled down to `side`, and its mask if not all pixels count. Returns the
    /// camera of the stored image.
    fn store(
        &self,
        commit: &mut Commit,
        manifest: &Manifest,
        Placed { image, camera_name, .. }: &Placed<'_>,
    ) -> anyhow::Result<(Camera, ObjectRef, Option<ObjectRef>)> {
        let background = manifest.profile.background;
        // What is transparent gets the background that the renderer draws there as well.
        let (mut rgb8, mut camera) = picture::real(&image.file, &image.camera, background)?;
        let width = camera.width_px;
        let height = camera.height_px;
        let mask =
            image.mask.as_deref().map(|file| picture::mask(file, [width, height])).transpose()?;
        let outside = own_vehicle::outside(manifest.rig.as_ref(), camera_name, [width, height]);
        let mut counts = own_vehicle::both(mask, outside);
        let longest = width.max(height);
        if longest > self.side {
            let scaled = |side: u32| {
                let side = f64::from(side) * f64::from(self.side) / f64::from(longest);
                (side.round() as u32).max(1)
            };
            let small = [scaled(width), scaled(height)];
            camera = camera.scaled(small[0].into(), small[1].into())?;
            camera.native_size_px = None;
            let large = RgbImage::from_raw(width, height, rgb8)
                .context("an image has 3 bytes per pixel")?;
            // Lanczos keeps fine edges, which a box filter would blur.
            rgb8 = imageops::resize(&large, small[0], small[1], FilterType::Lanczos3).into_raw();
            counts = counts.map(|counts| reduced_mask(&counts, [width, height], small));
        }
        let width = camera.width_px;
        let height = camera.height_px;
        let file = wildcity_session::jpeg(&rgb8, width, height, self.quality);
        let stored = commit.put_image(&file.map_err(anyhow::Error::msg)?)?;
        // A mask in which every pixel counts says nothing, and is not stored.
        let Some(counts) = counts.filter(|counts| counts.contains(&false)) else {
            return Ok((camera, stored, None));
        };
        let mask = mask_png(&counts, [width, height])?;
        Ok((camera, stored, Some(commit.put_image(&mask)?)))
    }
}

/// A distance in metres, with or without its unit.
fn metres(text: &str) -> Result<f64, String> {
    let number: f64 = text
        .strip_suffix('m')
        .unwrap_or(text)
        .trim()
        .parse()
        .map_err(|_| "expected metres, such as 2 or 2m".to_owned())?;
    if (0.0..=1000.0).contains(&number) {
        Ok(number)
    } else {
        Err("expected 0 to 1000 m".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_have_an_optional_unit() {
        assert_eq!(metres("2m"), Ok(2.0));
        assert_eq!(metres("0.5"), Ok(0.5));
        assert!(metres("-1").is_err() && metres("two").is_err());
    }
}
