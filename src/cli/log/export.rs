//! `wildcity log export`.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde_json::{Map, Value, json};

use wildcity_augment::{
    CameraModel, ColmapForm, ColmapModel, Point, TrainingCamera, TrainingImage, posed_frame,
};
use wildcity_log::{Log, PlacedImage, Poses, Tracks, colored_points};
use wildcity_scene::Rig;
use wildcity_scene::geometry::camera::json::Intrinsics;

use crate::cli::output::{self, counted};

/// Write a log in the formats of other programs: for trainers, evaluations and scenarios.
///
/// Writes the drive and the rig as `wildcity import` reads them, the boxes as `wildcity eval
/// --boxes` does, the tracks of scenarios, the map, lists of the cameras of all and of the held-out
/// images as `wildcity eval --images` reads them, and for trainers images/, transforms.json and a
/// COLMAP model in sparse/0 with the coloured points of the LiDAR. Points in boxes that move faster
/// than 1 m/s are left out. images/ has links to the files of the log.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity log export log --out capture
  wildcity log export parts/log-0000 --out capture --points 500000")]
pub(super) struct Export {
    /// Folder of the log.
    #[arg(value_name = "LOG")]
    log: PathBuf,

    /// Folder to write, which must not exist yet.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Most points of the COLMAP model.
    #[arg(long, value_name = "N", default_value_t = 200_000)]
    points: usize,

    /// Images of each camera that give points their colours, spread over the log.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..))]
    colors: u16,
}

impl Export {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = Log::open(&self.log)?;
        ensure!(!self.out.exists(), "--out {} exists: give another folder", self.out.display());
        // The folder of a bare name is the current one.
        let named = self.out.parent().filter(|folder| !folder.as_os_str().is_empty());
        let parent = named.unwrap_or(Path::new("."));
        output::create_dir(parent)?;
        // Renamed when it is complete; removed with what it has if anything fails before.
        let made = tempfile::Builder::new().prefix(".export").tempdir_in(parent);
        let partial = made.with_context(|| format!("cannot write to {}", parent.display()))?;
        let said = self.write(&log, partial.path())?;
        let cannot = || format!("cannot write {}", self.out.display());
        fs::rename(partial.path(), &self.out).with_context(cannot)?;
        let mut out = output::stdout();
        for line in said {
            writeln!(out, "{line}")?;
        }
        writeln!(out, "{}", self.out.display())?;
        Ok(())
    }

    /// Writes all files. Returns what to print.
    fn write(&self, log: &Log, out: &Path) -> anyhow::Result<Vec<String>> {
        let poses = log.poses()?;
        write_json(&out.join("drive.json"), &poses.drive(log.header.name.clone()))?;
        write_json(&out.join("rig.json"), &log.rig)?;
        let mut said = vec![write_tracks(log, out)?];
        if let Some(map) = log.map()? {
            output::write(&out.join("map.json"), map.to_json().as_bytes())?;
        }
        if log.images()?.is_none() {
            said.push(
                "the log has no images: there are no lists, and nothing to train on".to_owned(),
            );
            return Ok(said);
        }
        let images: Vec<PlacedImage> = log.placed_images(&poses)?.collect::<Result<_, _>>()?;
        let held_out = write_lists(log, &images, out)?;
        said.push(format!("{}, {held_out} of them held out", counted(images.len(), "image")));
        said.push(self.write_capture(log, &poses, &images, out)?);
        Ok(said)
    }

    /// Writes what trainers read: of the images, those that are not held out.
    fn write_capture(
        &self,
        log: &Log,
        poses: &Poses,
        images: &[PlacedImage],
        out: &Path,
    ) -> anyhow::Result<String> {
        let cameras = training_cameras(&log.rig);
        // Both files have one lens model for all cameras: some rigs cannot be written so, and still
        // have a drive and lists.
        let model = match CameraModel::from_cameras(&cameras) {
            Ok(model) => model,
            Err(error) => return Ok(format!("no transforms.json and no COLMAP model: {error}")),
        };
        let mut trained = Vec::new();
        // Held-out images are left out of the capture, or a training would see them.
        for image in images.iter().filter(|image| !image.row.held_out) {
            let name = linked(image, &out.join("images"))?;
            trained.push(TrainingImage {
                name,
                camera: image.row.camera.clone(),
                world_from_camera: image.world_from_camera,
            });
        }
        let frame = |image: &TrainingImage| {
            let camera = cameras.iter().find(|camera| camera.name == image.camera)?;
            Some(posed_frame(model, camera, image))
        };
        let frames: Vec<Map<String, Value>> = trained.iter().filter_map(frame).collect();
        let transforms = json!({"camera_model": model.name(), "frames": frames});
        write_json(&out.join("transforms.json"), &transforms)?;
        let colored = colored_points(log, poses, self.colors.into(), self.points)?;
        let converted = colored
            .into_iter()
            .map(|point| Point { at_m: point.at_m.to_array(), rgb8: point.rgb8 });
        let points: Vec<Point> = converted.collect();
        let colmap = ColmapModel { model, cameras: &cameras, images: &trained, points: &points };
        output::create_dir(&out.join("sparse/0"))?;
        for (name, bytes) in colmap.files(ColmapForm::Text) {
            output::write(&out.join("sparse/0").join(name), &bytes)?;
        }
        let count = counted(points.len(), "point");
        Ok(format!("sparse/0: {} and {count}", counted(trained.len(), "image")))
    }
}

fn training_cameras(rig: &Rig) -> Vec<TrainingCamera> {
    let camera = |mounted: &wildcity_scene::rig::RigCamera| TrainingCamera {
        name: mounted.name.clone(),
        camera: mounted.camera,
        rig_from_camera: mounted.rig_from_camera,
    };
    rig.cameras.iter().map(camera).collect()
}

/// Writes the boxes and the tracks.
fn write_tracks(log: &Log, out: &Path) -> anyhow::Result<String> {
    let Some(rows) = log.tracks()? else { return Ok("no tracks".to_owned()) };
    let mut boxes = Vec::new();
    for row in rows {
        writeln!(boxes, "{}", serde_json::to_string(&row?)?)?;
    }
    output::write(&out.join("boxes.jsonl"), &boxes)?;
    let tracks = Tracks::read(log, [i64::MIN, i64::MAX])?;
    write_json(&out.join("tracks.json"), &tracks.recorded_actors())?;
    Ok(counted(tracks.len(), "track"))
}

/// Writes the lists of all cameras and of those of held-out images. Returns how many are held out.
fn write_lists(log: &Log, images: &[PlacedImage], out: &Path) -> anyhow::Result<usize> {
    let mut all = Vec::new();
    let mut held_out = Vec::new();
    let mut count = 0;
    for image in images {
        let line = serde_json::to_string(&listed(log, image)?)?;
        writeln!(all, "{line}")?;
        if image.row.held_out {
            count += 1;
            writeln!(held_out, "{line}")?;
        }
    }
    output::write(&out.join("cameras.jsonl"), &all)?;
    if count > 0 {
        output::write(&out.join("held-out.jsonl"), &held_out)?;
    }
    Ok(count)
}

/// A camera of a list.
fn listed(log: &Log, image: &PlacedImage) -> anyhow::Result<Map<String, Value>> {
    let PlacedImage { row, camera, world_from_camera, .. } = image;
    let Intrinsics { size_px, focal_px, center_px, lens, windshield, native_size_px } =
        Intrinsics::from_camera(camera);
    let rotation = world_from_camera.rotation_matrix();
    // The rows of the inverse are the columns of the matrix.
    let rows = [rotation.x_axis, rotation.y_axis, rotation.z_axis].map(|axis| axis.to_array());
    let fields = json!({
        "name": format!("{}-{:012}", row.camera, row.time_us),
        "width": size_px[0],
        "height": size_px[1],
        "fx": focal_px[0],
        "fy": focal_px[1],
        "cx": center_px[0],
        "cy": center_px[1],
        "lens": lens,
        "windshield": windshield,
        "native_size": native_size_px,
        "position": world_from_camera.position_m.to_array(),
        "R_world_to_cam": rows,
        "image": absolute(&image.file)?,
        "mask": row.mask.as_ref().map(|mask| absolute(&log.path(mask))).transpose()?,
        "time_us": row.time_us,
        "exposure_stops": row.exposure_stops,
    });
    let Value::Object(mut fields) = fields else { return Ok(Map::new()) };
    fields.retain(|_, value| !value.is_null());
    Ok(fields)
}

/// Links the file of an image below a folder. Returns its name there.
fn linked(image: &PlacedImage, folder: &Path) -> anyhow::Result<String> {
    let extension = image.file.extension().and_then(|extension| extension.to_str());
    let name = format!("{}.{}", image.name, extension.unwrap_or("jpg"));
    let path = folder.join(&name);
    output::create_dir(path.parent().unwrap_or(folder))?;
    // A link is resolved from its own folder, and not from the current one.
    let source = absolute(&image.file)?;
    let cannot = || format!("cannot write {}", path.display());
    #[cfg(unix)]
    std::os::unix::fs::symlink(source, &path).with_context(cannot)?;
    #[cfg(not(unix))]
    fs::copy(source, &path).with_context(cannot)?;
    Ok(name)
}

fn absolute(path: &Path) -> anyhow::Result<PathBuf> {
    fs::canonicalize(path).with_context(|| format!("{}", path.display()))
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec(value)?;
    text.push(b'\n');
    output::write(path, &text)
}
