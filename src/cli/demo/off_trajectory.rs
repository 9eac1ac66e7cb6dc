//! `wildcity demo --off-trajectory`: views off the drive from a degraded copy of the street, as
//! rendered and repaired.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

use anyhow::Context;
use glam::DVec3;
use image::RgbImage;
use image::imageops;

use wildcity_client::protocol::message::{Encoding, ImagePart, Outputs, Repair};
use wildcity_client::{Client, Observation, Open, Pose};
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_repair::{LoadOptions, Models};
use wildcity_scene::views::RecordedView;
use wildcity_scene::{Trajectory, geometry};
use wildcity_twin::store::{Catalog, CommitKind, StorageOptions, VersionChange};

use crate::cli::output;

/// The model that comes with the program, and its manifest.
const MODEL: [(&str, &[u8]); 2] = [
    ("repair.json", include_bytes!("../../../scenes/repair.json")),
    ("repair.onnx", include_bytes!("../../../scenes/repair.onnx")),
];
/// Name of the model in its manifest.
const MODEL_NAME: &str = "street-repair";
/// Cameras that are drawn: those that the model was trained with, at the same size.
const CAMERAS: [&str; 3] = ["front_left", "front", "front_right"];
/// Width and height of the images, in pixels.
const SIZE_PX: [u32; 2] = [360, 232];
/// Distance of two recorded images along the drive, in metres, and the quality of their JPEGs.
const RECORDED_M: f64 = 2.0;
const JPEG_QUALITY: u8 = 95;
/// Stations of the views, in metres along the drive.
const STATIONS_M: [f64; 4] = [40.0, 90.0, 190.0, 240.0];

/// Writes the files of the model to a directory, and reads its manifest. Loads nothing.
pub(super) fn model(dir: &Path, options: LoadOptions) -> anyhow::Result<Models> {
    output::create_dir(dir)?;
    for (name, bytes) in MODEL {
        output::write(&dir.join(name), bytes)?;
    }
    Ok(Models::read(&[dir.join(MODEL[0].0)], options)?)
}

/// Stores recorded images in the degraded twin, unless it has some. They show the street without
/// errors.
///
/// Their stations are those that the repair of the views searches: from 8 m behind a view to 2 m
/// ahead of it.
async fn record_images(
    url: &str,
    catalog: &Catalog,
    [true_twin, spoiled_twin]: [&str; 2],
    drive: &Trajectory,
) -> anyhow::Result<()> {
    let base = catalog.version(spoiled_twin, None)?;
    if base.manifest.views.is_some() {
        return Ok(());
    }
    let rig = base.manifest.rig.as_ref().context("the demo twin has a rig")?;
    let around = |view_m: f64| (-5..=2).map(move |k| view_m + RECORDED_M * f64::from(k));
    let stations_m: Vec<f64> = STATIONS_M.into_iter().flat_map(around).collect();
    let mut commit = catalog.begin(spoiled_twin, CommitKind::Import, StorageOptions::default())?;
    let mut views = Vec::new();
    for some_m in stations_m.chunks(8) {
        let poses: Vec<geometry::Pose> =
            some_m.iter().map(|at_m| drive.at_station(*at_m)).collect();
        let wire_poses: Vec<Pose> = poses.iter().map(super::wire_pose).collect();
        let drawn = drawn(url, true_twin, false, &wire_poses).await?;
        for ((station_m, world_from_rig), images) in some_m.iter().zip(&poses).zip(drawn) {
            for (name, image) in CAMERAS.iter().zip(images) {
                let mounted = rig.cameras.iter().find(|camera| camera.name == *name);
                let mounted = mounted.context("the demo rig has the camera")?;
                let [width, height] = SIZE_PX;
                let mut camera = mounted.camera.scaled(width.into(), height.into())?;
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

/// Views off the drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Views<'a> {
    /// Distance from the drive to the left, in metres.
    pub(super) offset_m: f64,
    /// Whether the views are also repaired.
    pub(super) repair: bool,
    /// Folder of the pictures.
    pub(super) out: &'a Path,
}

impl Views<'_> {
    /// Draws the views, writes one picture per station with a row for each kind of image, and
    /// prints a table.
    pub(super) async fn show(
        self,
        url: &str,
        catalog: &Catalog,
        twins: [&str; 2],
        drive: &Trajectory,
    ) -> anyhow::Result<()> {
        let [true_twin, spoiled_twin] = twins;
        let position_m = self.offset_m * DVec3::Y;
        let beside = geometry::Pose { position_m, ..geometry::Pose::IDENTITY };
        let pose = |station_m: &f64| super::wire_pose(&(drive.at_station(*station_m) * beside));
        let poses: Vec<Pose> = STATIONS_M.iter().map(pose).collect();
        let mut kinds = vec![("rendered", drawn(url, spoiled_twin, false, &poses).await?)];
        if self.repair {
            record_images(url, catalog, twins, drive).await?;
            kinds.push(("repaired", drawn(url, spoiled_twin, true, &poses).await?));
        }
        kinds.push(("true", drawn(url, true_twin, false, &poses).await?));

        let mut table = io::stdout().lock();
        let names = CAMERAS.map(|name| format!("{name:>12}")).join("");
        writeln!(table, "{:<10} {names}", "PSNR in dB")?;
        let (_, truth) = &kinds[kinds.len() - 1];
        for (kind, images) in &kinds[..kinds.len() - 1] {
            let row = (0..CAMERAS.len()).map(|at| format!("{:>12.2}", mean_db(images, truth, at)));
            writeln!(table, "{kind:<10} {}", row.collect::<String>())?;
        }
        let order: Vec<&str> = kinds.iter().map(|(kind, _)| *kind).collect();
        writeln!(table, "rows of the pictures: {}", order.join(", "))?;
        for (at, station_m) in STATIONS_M.iter().enumerate() {
            let rows: Vec<&[RgbImage]> = kinds.iter().map(|(_, images)| &*images[at]).collect();
            let picture = side_by_side(&rows);
            let path = self.out.join(format!("beside_{station_m:03.0}.png"));
            let png = wildcity_session::png(&picture, picture.width(), picture.height());
            output::write(&path, &png.map_err(anyhow::Error::msg)?)?;
            writeln!(table, "look at    {}", path.display())?;
        }
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
    repair: bool,
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
    // At any trust.
    let always = Repair {
        model: MODEL_NAME.to_owned(),
        below: Some(1.0),
        above: Some(1.0),
        at_least: Some(0.0),
        per_step: None,
        on_failure: None,
    };
    client.open(Open { outputs, repair: repair.then_some(always), ..Open::twin(twin) }).await?;
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
