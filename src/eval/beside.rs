//! Views beside the drive of a twin with reconstruction errors, as rendered and repaired, against
//! a twin without them: `wildcity demo --off-trajectory`.

use std::collections::BTreeMap;

use anyhow::Context;
use glam::DVec3;
use image::RgbImage;
use image::imageops;

use wildcity_client::protocol::message::{Encoding, ImagePart, Outputs, Repair};
use wildcity_client::{Client, Observation, Open, Pose};
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_scene::views::RecordedView;
use wildcity_scene::{Trajectory, geometry};
use wildcity_twin::store::{Catalog, CommitKind, StorageOptions, VersionChange};

/// Cameras that are drawn: those that the demo's model was trained with, at the same size.
const CAMERAS: [&str; 3] = ["front_left", "front", "front_right"];
/// Width and height of the images, in pixels.
const SIZE_PX: [u32; 2] = [360, 232];
/// Distance of two recorded images along the drive, in metres, and the quality of their JPEGs.
const RECORDED_M: f64 = 2.0;
const JPEG_QUALITY: u8 = 95;
/// Stations of the views, in metres along the drive.
const STATIONS_M: [f64; 4] = [40.0, 90.0, 190.0, 240.0];

/// The twins, and the server that draws them.
#[derive(Clone, Copy, Debug)]
pub struct Beside<'a> {
    /// The URL of the server.
    pub url: &'a str,
    /// The twins of the server.
    pub catalog: &'a Catalog,
    /// Name of the twin without errors.
    pub truth: &'a str,
    /// Name of the twin with errors. If a model repairs, it gets recorded images of the truth.
    pub spoiled: &'a str,
    /// The drive of both.
    pub drive: &'a Trajectory,
    /// Distance from the drive to the left, in metres.
    pub offset_m: f64,
    /// Name of the model that repairs, at any trust; `None` for no repair.
    pub model: Option<&'a str>,
}

/// The views of all kinds: rendered, perhaps repaired, and true.
#[derive(Debug)]
pub struct BesideViews {
    /// Names of the cameras, in the order of the figures.
    pub cameras: [&'static str; 3],
    /// For each kind but the true one, the mean PSNR of each camera against that one, in dB.
    pub psnr_db: Vec<(&'static str, [f64; 3])>,
    /// For each station, in metres along the drive, a picture with a row for each kind.
    pub pictures: Vec<(f64, RgbImage)>,
}

impl Beside<'_> {
    /// Draws the views of each kind through the server.
    ///
    /// # Errors
    /// The server refuses, or the twin with errors cannot be changed.
    pub async fn run(&self) -> anyhow::Result<BesideViews> {
        let position_m = self.offset_m * DVec3::Y;
        let beside = geometry::Pose { position_m, ..geometry::Pose::IDENTITY };
        let pose = |station_m: &f64| wire_pose(&(self.drive.at_station(*station_m) * beside));
        let poses: Vec<Pose> = STATIONS_M.iter().map(pose).collect();
        let mut kinds = vec![("rendered", drawn(self.url, self.spoiled, None, &poses).await?)];
        if let Some(model) = self.model {
            self.record_images().await?;
            kinds.push(("repaired", drawn(self.url, self.spoiled, Some(model), &poses).await?));
        }
        let truth = drawn(self.url, self.truth, None, &poses).await?;
        let means = |images: &[Vec<RgbImage>]| [0, 1, 2].map(|at| mean_db(images, &truth, at));
        let psnr_db = kinds.iter().map(|(kind, images)| (*kind, means(images))).collect();
        kinds.push(("true", truth));
        let picture = |(at, station_m): (usize, &f64)| {
            let rows: Vec<&[RgbImage]> = kinds.iter().map(|(_, images)| &*images[at]).collect();
            (*station_m, side_by_side(&rows))
        };
        let pictures = STATIONS_M.iter().enumerate().map(picture).collect();
        Ok(BesideViews { cameras: CAMERAS, psnr_db, pictures })
    }

    /// Stores images of the truth in the degraded twin, unless it has some. Their stations are
    /// those that the repair of the views searches: from 8 m behind a view to 2 m ahead of it.
    async fn record_images(&self) -> anyhow::Result<()> {
        let Self { url, catalog, truth, spoiled, drive, .. } = *self;
        // A twin of an earlier run has the images already.
        let base = catalog.version(spoiled, None)?;
        if base.manifest.views.is_some() {
            return Ok(());
        }
        let rig = base.manifest.rig.as_ref().context("the demo twin has a rig")?;
        // From 10 m behind to 4 m ahead: at each side one image more than the repair searches.
        let around = |view_m: f64| (-5..=2).map(move |k| view_m + RECORDED_M * f64::from(k));
        let stations_m: Vec<f64> = STATIONS_M.into_iter().flat_map(around).collect();
        let mut commit = catalog.begin(spoiled, CommitKind::Import, StorageOptions::default())?;
        let mut views = Vec::new();
        // Few poses at a time: one answer has the images of all of them.
        for some_m in stations_m.chunks(8) {
            let poses: Vec<geometry::Pose> =
                some_m.iter().map(|at_m| drive.at_station(*at_m)).collect();
            let wire_poses: Vec<Pose> = poses.iter().map(wire_pose).collect();
            let drawn = drawn(url, truth, None, &wire_poses).await?;
            for ((station_m, world_from_rig), images) in some_m.iter().zip(&poses).zip(drawn) {
                for (name, image) in CAMERAS.iter().zip(images) {
                    let mounted = rig
                        .cameras
                        .iter()
                        .find(|camera| camera.name == *name)
                        .context("the demo rig has the camera")?;
                    let [width, height] = SIZE_PX;
                    let mut camera = mounted.camera.scaled(width.into(), height.into())?;
                    // The recorded image is drawn at this size: nothing has shrunk it.
                    camera.native_size_px = None;
                    let file = wildcity_session::jpeg(&image, width, height, JPEG_QUALITY);
                    views.push(RecordedView {
                        trajectory: drive.name.clone(),
                        station_m: *station_m,
                        camera_name: (*name).to_owned(),
                        camera,
                        world_from_camera: *world_from_rig * mounted.rig_from_camera,
                        exposure_stops: None,
                        image: commit.put_image(&file.map_err(anyhow::Error::msg)?)?,
                        mask: None,
                    });
                }
            }
        }
        let views = commit.put_views(&views)?;
        commit.set_views(Some(views));
        commit.change(base.number, VersionChange::edit())?;
        Ok(())
    }
}

/// Mean PSNR of a camera's images over the stations.
fn mean_db(images: &[Vec<RgbImage>], truth: &[Vec<RgbImage>], camera: usize) -> f64 {
    let pairs = images.iter().zip(truth);
    let db = |(a, b): (&Vec<RgbImage>, &Vec<RgbImage>)| {
        psnr_db_u8(a[camera].as_raw().iter().zip(b[camera].as_raw()))
    };
    pairs.map(db).sum::<f64>() / images.len() as f64
}

/// Joins rows of images of [`SIZE_PX`] into one image.
fn side_by_side(rows: &[&[RgbImage]]) -> RgbImage {
    let [width, height] = SIZE_PX;
    let mut picture = RgbImage::new(CAMERAS.len() as u32 * width, rows.len() as u32 * height);
    for (y_px, row) in (0..).step_by(height as usize).zip(rows) {
        for (x_px, image) in (0..).step_by(width as usize).zip(*row) {
            imageops::replace(&mut picture, image, x_px, y_px);
        }
    }
    picture
}

/// Renders the images of a twin: for each pose, in the order of the cameras.
async fn drawn(
    url: &str,
    twin: &str,
    model: Option<&str>,
    poses: &[Pose],
) -> anyhow::Result<Vec<Vec<RgbImage>>> {
    let mut client = Client::connect(url, "wildcity demo").await?;
    let part = ImagePart { crop: None, size: Some(SIZE_PX.map(u64::from)) };
    let images = CAMERAS.iter().map(|name| ((*name).to_owned(), part));
    let outputs = Outputs {
        cameras: Some(CAMERAS.map(str::to_owned).to_vec()),
        images: images.collect::<BTreeMap<_, _>>(),
        encoding: Encoding::Raw,
        ..Outputs::default()
    };
    let always = |model: &str| Repair {
        model: model.to_owned(),
        below: Some(1.0),
        above: Some(1.0),
        at_least: Some(0.0),
        per_step: None,
        on_failure: None,
    };
    client.open(Open { outputs, repair: model.map(always), ..Open::twin(twin) }).await?;
    let seen = client.observe(poses).await?;
    client.close().await?;
    let found: Vec<RgbImage> = pixels(&seen)?;
    Ok(found.chunks(CAMERAS.len()).map(<[RgbImage]>::to_vec).collect())
}

fn pixels(seen: &Observation) -> anyhow::Result<Vec<RgbImage>> {
    let [width, height] = SIZE_PX;
    let image = |view: wildcity_client::ImageView<'_>| {
        RgbImage::from_raw(width, height, view.rgb()?.into_owned())
            .context("the image does not have the size that was asked for")
    };
    seen.images().map(image).collect()
}

fn wire_pose(pose: &geometry::Pose) -> Pose {
    Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
}
