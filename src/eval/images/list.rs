//! Lists of real images: their files, masks and cameras.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use serde::Deserialize;
use serde::de::IgnoredAny;

use wildcity_log::{Log, PlacedImage};
use wildcity_scene::align::PosedImage;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_twin::ingest::capture::CaptureError;
use wildcity_twin::ingest::{self, cameras, capture};

/// A real image and its camera.
#[derive(Clone, Debug)]
pub struct RealImage {
    /// Its name in the list.
    pub name: String,
    pub file: PathBuf,
    pub mask: Option<PathBuf>,
    /// Its depth, if the list says one: a grey PNG of 16 bits in millimetres, 0 where there is
    /// none.
    pub depth: Option<PathBuf>,
    /// Factor of its loss in training, if the list says one.
    pub weight: Option<f64>,
    pub camera: Camera,
    /// Pose in the axes and unit of the list.
    pub world_from_camera: Pose,
    /// The smallest z that it draws, if the list says one, in units of the scene.
    pub near: Option<f64>,
    /// When it was taken, in microseconds, if the list says so.
    pub time_us: Option<i64>,
    /// Its exposure in stops against the scene's, if the list says so.
    pub exposure_stops: Option<f64>,
    /// A mask whose bright pixels show the ground, of a log.
    pub ground_mask: Option<PathBuf>,
    /// A mask whose bright pixels show the sky, of a log.
    pub sky_mask: Option<PathBuf>,
    /// Whether the log says that no scene was trained on it.
    pub held_out: bool,
}

/// Real images, in the order of their names.
pub struct ImageList {
    images: Vec<RealImage>,
    /// Whether the poses are in the axes of the scene; else they are in those of a capture.
    pub is_in_scene_axes: bool,
    /// What the list says and is not used, for a person.
    pub warnings: Vec<String>,
}

/// An image of a list.
struct ListedImage {
    posed: PosedImage,
    mask: Option<String>,
    depth: Option<String>,
    weight: Option<f64>,
    near: Option<f64>,
    exposure_stops: Option<f64>,
}

/// A list before its files are looked for.
struct Listed {
    images: Vec<ListedImage>,
    /// The folder that names are in, unless the user gives a different one.
    folder: PathBuf,
    is_in_scene_axes: bool,
    warnings: Vec<String>,
}

impl ImageList {
    /// Reads the list and finds the files.
    ///
    /// # Errors
    /// The list cannot be read, or an image or a mask is missing.
    pub fn read(
        source: &Path,
        image_dir: Option<&Path>,
        masks: Option<&Path>,
    ) -> anyhow::Result<Self> {
        if Log::is_log(source) {
            ensure!(
                image_dir.is_none() && masks.is_none(),
                "{} is a log, whose tables name the files: leave --image-dir and --masks out",
                source.display()
            );
            return Self::from_log(&Log::open(source)?);
        }
        let Listed { images, folder, is_in_scene_axes, warnings } =
            read(source).with_context(|| format!("--images {}", source.display()))?;
        let folder = image_dir.unwrap_or(&folder);
        let mut found = Vec::with_capacity(images.len());
        for ListedImage { posed, mask, depth, weight, near, exposure_stops } in images {
            let PosedImage { name, camera, world_from_camera, time_us } = posed;
            let file = image_file(folder, &name)?;
            // A folder of masks on the command line replaces those that the list names.
            let mask = match (masks, mask) {
                (Some(masks), _) => Some(mask_file(masks, &name)?),
                (None, Some(mask)) => Some(folder.join(mask)),
                (None, None) => None,
            };
            found.push(RealImage {
                name,
                file,
                mask,
                depth: depth.map(|depth| folder.join(depth)),
                weight,
                camera,
                world_from_camera,
                near,
                time_us,
                exposure_stops,
                ground_mask: None,
                sky_mask: None,
                held_out: false,
            });
        }
        // Lists of one capture may differ in order; every n-th image must be the same in all of
        // them.
        found.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Self { images: found, is_in_scene_axes, warnings })
    }

    /// The images of a log, in the axes of a twin that was made of it. Those at times without a
    /// pose are left out.
    ///
    /// # Errors
    /// A table cannot be used, or an image is missing.
    pub fn from_log(log: &Log) -> anyhow::Result<Self> {
        let poses = log.poses()?;
        let mut images = Vec::new();
        for placed in log.placed_images(&poses)? {
            let PlacedImage { row, name, file, camera, world_from_camera } = placed?;
            ensure!(file.is_file(), "there is no image {}", file.display());
            let path = |file: Option<String>| file.map(|file| log.path(&file));
            images.push(RealImage {
                name,
                file,
                mask: path(row.mask),
                depth: None,
                weight: None,
                camera,
                world_from_camera,
                near: None,
                time_us: Some(row.time_us),
                exposure_stops: row.exposure_stops,
                ground_mask: path(row.ground_mask),
                sky_mask: path(row.sky_mask),
                held_out: row.held_out,
            });
        }
        images.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Self { images, is_in_scene_axes: true, warnings: Vec::new() })
    }

    /// The images that a log marks as held out; all if it marks none.
    #[must_use]
    pub fn held_out(mut self) -> Self {
        if self.images.iter().any(|image| image.held_out) {
            self.images.retain(|image| image.held_out);
        }
        self
    }

    /// Whether a log marks images as held out.
    pub fn has_held_out(&self) -> bool {
        self.images.iter().any(|image| image.held_out)
    }

    /// Every `step`-th image, starting with the first.
    pub fn every(&self, step: usize) -> Vec<&RealImage> {
        self.images.iter().step_by(step).collect()
    }
}

fn read(source: &Path) -> anyhow::Result<Listed> {
    let beside = source.parent().unwrap_or(Path::new("")).to_owned();
    let is_dir = source.is_dir();
    // A folder with both kinds is read as transforms.json, which also names masks and depths.
    if is_dir && !source.join("transforms.json").is_file() {
        let images = capture::read_colmap(source).map_err(|error| match error {
            CaptureError::NoModel { .. } => anyhow!("{error}; there is no transforms.json either"),
            error => error.into(),
        })?;
        let listed = |posed| ListedImage {
            posed,
            mask: None,
            depth: None,
            weight: None,
            near: None,
            exposure_stops: None,
        };
        let images = images.into_iter().map(listed).collect();
        return Ok(Listed {
            images,
            folder: colmap_images(source),
            is_in_scene_axes: false,
            warnings: Vec::new(),
        });
    }
    if is_dir || has_frames(source)? {
        let capture::NerfstudioCapture { frames, warnings } = capture::read_nerfstudio(source)?;
        let listed = |frame: capture::FrameImage| {
            let capture::FrameImage { posed, mask, depth, weight, exposure_stops } = frame;
            ListedImage { posed, mask, depth, weight, near: None, exposure_stops }
        };
        let images = frames.into_iter().map(listed).collect();
        let folder = if is_dir { source.to_owned() } else { beside };
        return Ok(Listed { images, folder, is_in_scene_axes: false, warnings });
    }
    let listed = cameras::read(source)?.into_iter().map(|listed| {
        // A list of cameras to render has no files: then the camera's name is that of its image.
        let name = listed.image.unwrap_or(listed.name);
        let cameras::ListedCamera {
            camera,
            world_from_camera,
            mask,
            near,
            time_us,
            exposure_stops,
            ..
        } = listed;
        let posed = PosedImage { name, camera, world_from_camera, time_us };
        ListedImage { posed, mask, depth: None, weight: None, near, exposure_stops }
    });
    Ok(Listed {
        images: listed.collect(),
        folder: beside,
        is_in_scene_axes: true,
        warnings: Vec::new(),
    })
}

/// Whether a JSON file has the field `frames`, as transforms.json has.
fn has_frames(path: &Path) -> anyhow::Result<bool> {
    #[derive(Deserialize)]
    struct Frames {
        frames: Option<IgnoredAny>,
    }
    let text = ingest::read_whole(path, wildcity_twin::limits::CAPTURE_BYTES)?;
    // serde would read a list as the fields of an object in their order.
    let is_object = text.trim_ascii_start().first() == Some(&b'{');
    let parsed: Result<Frames, serde_json::Error> = serde_json::from_slice(&text);
    Ok(is_object && parsed.is_ok_and(|file| file.frames.is_some()))
}

/// The folder `images` in that of the model or in one of the two above, as COLMAP's workspaces have
/// it.
fn colmap_images(model: &Path) -> PathBuf {
    let candidates = ["", "..", "../.."].map(|up| model.join(up).join("images"));
    let [beside, ..] = &candidates;
    candidates.iter().find(|dir| dir.is_dir()).unwrap_or(beside).clone()
}

/// The file of an image. instant-ngp's names have no extension.
fn image_file(folder: &Path, name: &str) -> anyhow::Result<PathBuf> {
    let named = folder.join(name);
    let with = |extension: &str| PathBuf::from(format!("{}.{extension}", named.display()));
    let candidates = [named.clone(), with("png"), with("jpg"), with("jpeg")];
    candidates.into_iter().find(|file| file.is_file()).with_context(|| {
        format!(
            "there is no image {}: give the folder of the images as --image-dir",
            named.display()
        )
    })
}

/// The mask of an image: with the image's name, with .png in place of its extension, or with .png
/// appended, as COLMAP names masks. Names of transforms.json start with the folder of the images,
/// such as `images` or `images_4`; those of masks need not.
fn mask_file(masks: &Path, name: &str) -> anyhow::Result<PathBuf> {
    let within = name.split_once('/').filter(|(folder, _)| folder.starts_with("images"));
    let names = [Some(name), within.map(|(_, within)| within)].into_iter().flatten();
    let candidates = names.flat_map(|name| {
        let named = masks.join(name);
        let appended = PathBuf::from(format!("{}.png", named.display()));
        [appended, named.with_extension("png"), named]
    });
    candidates.into_iter().find(|file| file.is_file()).with_context(|| {
        format!(
            "there is no mask {0}, nor {0}.png: --masks needs one for each image, white where it counts",
            masks.join(name).display()
        )
    })
}
