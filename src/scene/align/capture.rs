//! A drive and a rig from the camera poses of training images.
//!
//! The images of one folder are of one camera. The rig stands level under the reference camera, at
//! the camera's mean height below it; its x axis is where the camera looks, seen from above. So the
//! ground that the drive defines follows hills, but not how the camera was tilted from image to
//! image.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use crate::geometry::{Camera, Pose};
use crate::rig::{RigCamera, RigError, is_name};
use crate::trajectory::Keyframe;
use crate::{Rig, Trajectory};

use super::{Alignment, median};

/// A training image and its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedImage {
    /// Its name, perhaps with folders: `front/000012.png`.
    pub name: String,
    /// Size, intrinsics and lens.
    pub camera: Camera,
    /// Its pose; x right, y down, z forward.
    pub world_from_camera: Pose,
    /// Time at which it was taken, in microseconds, if its file has it.
    pub time_us: Option<i64>,
}

/// How a capture becomes a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureOptions {
    /// Name of the drive and of the rig.
    pub name: String,
    /// Images a second, if they have no times; `None` for [`DEFAULT_FPS`].
    pub fps: Option<f64>,
    /// Height of the reference camera above the ground, in metres; `None` if the ground is at z =
    /// 0.
    pub camera_height_m: Option<f64>,
    /// Folder of the reference camera; `None` for the one with the most images.
    pub reference: Option<String>,
    /// Folders of the rig's cameras; empty for all.
    pub cameras: Vec<String>,
}

/// Images a second of a capture whose images have no times.
pub const DEFAULT_FPS: f64 = 10.0;

/// A drive and its rig.
#[derive(Clone, Debug, PartialEq)]
pub struct CapturedDrive {
    /// Poses of the rig, one for each image of the reference camera.
    pub trajectory: Trajectory,
    /// A camera for each folder.
    pub rig: Rig,
    /// Height of the reference camera above the ground, in metres.
    pub camera_height_m: f64,
    /// Largest angle between an image of the reference camera and the rig's camera at its time, in
    /// radians: how far the camera was tilted from its mean.
    pub most_tilt_rad: f64,
}

/// Why a capture is no drive.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CapturedDriveError {
    /// The name cannot be used.
    #[error("{0:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not start with .")]
    Name(String),
    /// The frame rate is out of range.
    #[error("{0:?} images a second; from 0.001 to 10000 are accepted")]
    Fps(f64),
    /// The images have times, and a frame rate is given, too.
    #[error(
        "the images have time_us, and {0:?} images a second are asked for: leave out --fps, or remove time_us"
    )]
    FpsAndTimes(f64),
    /// Some images of the reference camera have a time and some have none.
    #[error(
        "{name:?} has no time_us, and other images have one: give it to all of {folder:?}, or to none"
    )]
    NoTime {
        name: String,
        /// The folder of the reference camera.
        folder: String,
    },
    /// Two images of the reference camera have one time.
    #[error(
        "{name:?} has the same time_us as the image before it, {time_us}: a camera takes one image at a time"
    )]
    SameTime { name: String, time_us: i64 },
    /// There is no such folder.
    #[error("there is no image in the folder {folder:?}; the folders are {}", known.join(", "))]
    Folder {
        folder: String,
        /// The folders that have images.
        known: Vec<String>,
    },
    /// The camera is below the ground.
    #[error(
        "the camera is {height_m:.3} m above z = 0, which is not the ground: put the twin on its ground first \
         (`wildcity twin align`), and give the same axes here; or give the camera's height"
    )]
    BelowGround {
        /// Its median height, in metres.
        height_m: f64,
    },
    /// A camera has no image at the time of one of the reference camera.
    #[error(
        "no image of the folder {folder:?} has the name of one in {reference:?}, so that its place on the rig is \
         unknown: name images of one time alike, or leave that folder out"
    )]
    NoPair { folder: String, reference: String },
    /// The rig cannot be used.
    #[error(transparent)]
    Rig(#[from] RigError),
}

/// The images of a folder.
type Folder<'a> = Vec<&'a PosedImage>;

/// Makes the drive and the rig of a capture. `alignment` takes the capture's axes and unit to the
/// twin's.
///
/// # Errors
/// Names what cannot be used.
pub fn captured_drive(
    images: &[PosedImage],
    alignment: &Alignment,
    options: &CaptureOptions,
) -> Result<CapturedDrive, CapturedDriveError> {
    let CaptureOptions { name, fps, camera_height_m, .. } = options;
    if !is_name(name) {
        return Err(CapturedDriveError::Name(name.clone()));
    }
    if let Some(fps) = fps.filter(|fps| !(1e-3..=1e4).contains(fps)) {
        return Err(CapturedDriveError::Fps(fps));
    }
    // Align first: heights, headings and distances below are metres in the axes of the twin.
    let images: Vec<PosedImage> = images.iter().map(|image| aligned(image, alignment)).collect();
    let folders = folders(&images, options)?;
    let reference_name = reference(&folders, options)?;
    let (reference, times_us) = timed(folders[&reference_name].clone(), &reference_name, *fps)?;

    // 1. How the reference camera stands on the rig.
    let heights_m = reference.iter().map(|image| image.world_from_camera.position_m.z);
    // The median, because a bridge or an outlier of the reconstruction moves a mean.
    let camera_height_m = camera_height_m.unwrap_or_else(|| median(heights_m.collect()));
    // A NaN height is not above the ground, and is refused as well.
    let is_above = camera_height_m > 0.0;
    if !is_above {
        return Err(CapturedDriveError::BelowGround { height_m: camera_height_m });
    }
    // What is left of a camera's rotation after its heading: pitch and roll, which differ from
    // image to image by the vehicle's nodding. Their mean is the mount.
    let level = |image: &PosedImage| DQuat::from_rotation_z(heading(&image.world_from_camera));
    let mounts: Vec<DQuat> = reference
        .iter()
        .map(|image| level(image).inverse() * image.world_from_camera.rotation)
        .collect();
    let rotation = mean_rotation(&mounts);
    let rig_from_reference = Pose { position_m: camera_height_m * DVec3::Z, rotation };

    // 2. The poses of the rig.
    // The rig stands exactly under the camera and turns only about z. The tilt of single images is
    // dropped here and reported as `most_tilt_rad`.
    let keyframe = |(image, time_us): (&&PosedImage, i64)| Keyframe {
        time_us,
        world_from_rig: Pose {
            position_m: image.world_from_camera.position_m - camera_height_m * DVec3::Z,
            rotation: level(image),
        },
    };
    let keyframes = reference.iter().zip(times_us).map(keyframe).collect();
    let most_tilt_rad =
        mounts.iter().map(|mount| mount.angle_between(rotation)).fold(0.0, f64::max);

    // 3. The cameras.
    let mut cameras = Vec::with_capacity(folders.len());
    for (folder, of_camera) in &folders {
        // The reference camera defines the rig, so that its mount is exact; a mean over pairs with
        // itself would only add rounding.
        let rig_from_camera = if *folder == reference_name {
            rig_from_reference
        } else {
            let no_pair = || CapturedDriveError::NoPair {
                folder: folder.clone(),
                reference: reference_name.clone(),
            };
            rig_from_reference * relative(&reference, of_camera).ok_or_else(no_pair)?
        };
        let camera_name = camera_name(folder, cameras.len());
        cameras.push(RigCamera::new(camera_name, usual_camera(of_camera), rig_from_camera));
    }
    let rig = Rig::new(name.clone(), cameras);
    rig.check()?;
    let trajectory = Trajectory { name: name.clone(), keyframes };
    Ok(CapturedDrive { trajectory, rig, camera_height_m, most_tilt_rad })
}

/// The images of the reference camera in the order in which they were taken, with their times from
/// the first one on, in microseconds.
fn timed<'a>(
    mut images: Folder<'a>,
    folder: &str,
    fps: Option<f64>,
) -> Result<(Folder<'a>, Vec<i64>), CapturedDriveError> {
    if images.iter().all(|image| image.time_us.is_none()) {
        let period_us = 1e6 / fps.unwrap_or(DEFAULT_FPS);
        // Rounded from the index and not summed up, so that the error stays below 0.5 µs however
        // long the drive is.
        let times_us = (0..images.len()).map(|index| (period_us * index as f64).round() as i64);
        return Ok((images, times_us.collect()));
    }
    if let Some(image) = images.iter().find(|image| image.time_us.is_none()) {
        let name = image.name.clone();
        let folder = folder.to_owned();
        return Err(CapturedDriveError::NoTime { name, folder });
    }
    if let Some(fps) = fps {
        return Err(CapturedDriveError::FpsAndTimes(fps));
    }
    // Sorted by time, and names no longer count. The sort is stable, so that equal times stay in
    // the order of names for the message below.
    images.sort_by_key(|image| image.time_us);
    let all_us: Vec<i64> = images.iter().filter_map(|image| image.time_us).collect();
    // A trajectory needs rising times.
    if let Some(at) = all_us.windows(2).position(|pair| pair[0] == pair[1]) {
        let name = images[at + 1].name.clone();
        let time_us = all_us[at];
        return Err(CapturedDriveError::SameTime { name, time_us });
    }
    let first_us = all_us.first().copied().unwrap_or(0);
    // Times may be those of a clock since 1970; the subtraction saturates, because a file can name
    // any i64.
    Ok((images, all_us.into_iter().map(|time_us| time_us.saturating_sub(first_us)).collect()))
}

fn aligned(image: &PosedImage, alignment: &Alignment) -> PosedImage {
    PosedImage { world_from_camera: alignment.pose(&image.world_from_camera), ..image.clone() }
}

/// The folder of an image, and its name without folder and extension.
fn parts(name: &str) -> (&str, &str) {
    // Both separators: COLMAP on Windows writes backslashes into its model.
    let (folder, file) = name.rsplit_once(['/', '\\']).unwrap_or(("", name));
    (folder.trim_start_matches("./"), file.rsplit_once('.').map_or(file, |(stem, _)| stem))
}

/// The images of each wanted folder, in the order of their names.
fn folders<'a>(
    images: &'a [PosedImage],
    options: &CaptureOptions,
) -> Result<BTreeMap<String, Folder<'a>>, CapturedDriveError> {
    let mut all: BTreeMap<String, Folder<'a>> = BTreeMap::new();
    for image in images {
        all.entry(parts(&image.name).0.to_owned()).or_default().push(image);
    }
    let known: Vec<String> = all.keys().map(|folder| format!("{folder:?}")).collect();
    if let Some(folder) = options.cameras.iter().find(|folder| !all.contains_key(*folder)) {
        return Err(CapturedDriveError::Folder { folder: folder.clone(), known });
    }
    if !options.cameras.is_empty() {
        all.retain(|folder, _| options.cameras.contains(folder));
    }
    for folder in all.values_mut() {
        folder.sort_by(|a, b| by_number(&a.name, &b.name));
    }
    Ok(all)
}

fn reference(
    folders: &BTreeMap<String, Folder<'_>>,
    options: &CaptureOptions,
) -> Result<String, CapturedDriveError> {
    let wanted = options.reference.clone().unwrap_or_else(|| {
        // The first of equal folders, in the order of their names, so that the choice does not
        // depend on the order of images.
        let most = folders.values().map(Vec::len).max().unwrap_or(0);
        let first = folders.iter().find(|(_, images)| images.len() == most);
        first.map(|(folder, _)| folder.clone()).unwrap_or_default()
    });
    if folders.contains_key(&wanted) {
        return Ok(wanted);
    }
    let known = folders.keys().map(|folder| format!("{folder:?}")).collect();
    Err(CapturedDriveError::Folder { folder: wanted, known })
}

/// Orders `frame_9` before `frame_10`.
fn by_number(a: &str, b: &str) -> Ordering {
    let is_digit = |text: &str| text.starts_with(|c: char| c.is_ascii_digit());
    let split = |text: &str| {
        let in_number = is_digit(text);
        text.find(|c: char| c.is_ascii_digit() != in_number).unwrap_or(text.len())
    };
    // Compares run by run: a run is all digits or has none. Both texts lose one run in each round.
    let mut left = a;
    let mut right = b;
    while !left.is_empty() && !right.is_empty() {
        let (l, left_rest) = left.split_at(split(left));
        let (r, right_rest) = right.split_at(split(right));
        let order = if is_digit(l) && is_digit(r) {
            // Numbers compare as texts, without leading zeros first: a name may have more digits
            // than any integer type holds. Then the longer number is the larger one.
            let l = l.trim_start_matches('0');
            let r = r.trim_start_matches('0');
            l.len().cmp(&r.len()).then_with(|| l.cmp(r))
        } else {
            l.cmp(r)
        };
        if order != Ordering::Equal {
            return order;
        }
        (left, right) = (left_rest, right_rest);
    }
    // Equal so far. The shorter rest comes first; names that differ only in zeros (`07`, `7`) keep
    // a total order by their text.
    left.len().cmp(&right.len()).then_with(|| a.cmp(b))
}

/// Heading of a camera, in radians from x towards y. One that looks down has that of the upper edge
/// of its image.
fn heading(world_from_camera: &Pose) -> f64 {
    let forward = world_from_camera.rotation * DVec3::Z;
    let upwards = world_from_camera.rotation * DVec3::NEG_Y;
    let toward = match forward.z {
        // 0.9 is the sine of 64 degrees. Nearer to the vertical, the direction seen from above is
        // mostly noise, and the upper edge of the image takes its place.
        z if z < -0.9 => upwards,
        z if z > 0.9 => -upwards,
        _ => forward,
    };
    toward.y.atan2(toward.x)
}

/// The mean of rotations that are close to each other: of their quaternions, with the sign of the
/// first.
fn mean_rotation(rotations: &[DQuat]) -> DQuat {
    let first = rotations[0];
    let sum =
        // q and -q are one rotation. Without equal signs, two of them would cancel out.
        rotations.iter().fold(first * 0.0, |sum, &q| sum + if q.dot(first) < 0.0 { -q } else { q });
    if sum.length() > 1e-9 { sum.normalize() } else { first }
}

/// The mean pose of a camera in the axes of the reference camera, over images of the same name.
fn relative(reference: &[&PosedImage], other: &[&PosedImage]) -> Option<Pose> {
    // Images of one time have one stem. Of equal stems in a folder (`1.png` and `1.jpg`) the last
    // counts.
    let by_stem: BTreeMap<&str, &PosedImage> =
        other.iter().map(|image| (parts(&image.name).1, *image)).collect();
    let pair = |image: &&PosedImage| {
        let other = by_stem.get(parts(&image.name).1)?;
        Some(image.world_from_camera.inverse() * other.world_from_camera)
    };
    let poses: Vec<Pose> = reference.iter().filter_map(pair).collect();
    if poses.is_empty() {
        return None;
    }
    let rotations: Vec<DQuat> = poses.iter().map(|pose| pose.rotation).collect();
    let position_m = poses.iter().map(|pose| pose.position_m).sum::<DVec3>() / poses.len() as f64;
    Some(Pose { position_m, rotation: mean_rotation(&rotations) })
}

/// The camera that most images have; the first of equals. COLMAP may estimate one for each image.
fn usual_camera(images: &[&PosedImage]) -> Camera {
    // A list and not a map: a camera has floats, which have no order and no hash. Captures have few
    // different cameras.
    let mut cameras: Vec<(Camera, usize)> = Vec::new();
    for image in images {
        match cameras.iter_mut().find(|(camera, _)| *camera == image.camera) {
            Some((_, count)) => *count += 1,
            None => cameras.push((image.camera, 1)),
        }
    }
    let most = cameras.iter().map(|(_, count)| *count).max();
    let usual = cameras.iter().find(|(_, count)| Some(*count) == most);
    usual.map_or(images[0].camera, |(camera, _)| *camera)
}

/// A name for the camera of a folder.
fn camera_name(folder: &str, index: usize) -> String {
    let last = folder.rsplit(['/', '\\']).next().unwrap_or(folder).to_lowercase();
    let allowed = |c: char| if c.is_ascii_alphanumeric() || "._-".contains(c) { c } else { '-' };
    let name: String = last.chars().map(allowed).collect();
    let name = name.trim_start_matches('.');
    match name {
        "" => format!("camera{index}"),
        name => name.chars().take(64).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::Pinhole;

    /// A rig of two cameras, 1.5 m high, that drives a quarter circle and nods a little.
    fn images() -> (Vec<PosedImage>, [Pose; 2]) {
        let eye = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
        let down = DQuat::from_rotation_y(0.1);
        let front = Pose { position_m: DVec3::new(0.0, 0.0, 1.5), rotation: down * eye };
        let left = Pose {
            position_m: DVec3::new(-0.4, 0.3, 1.4),
            rotation: DQuat::from_rotation_z(1.2) * eye,
        };
        let camera = |focal: f64| {
            Camera::from_pinhole(640, 480, Pinhole { fx: focal, fy: focal, cx: 320.0, cy: 240.0 })
        };
        let mut images = Vec::new();
        // Falling numbers, so that the test fails if the order of the images is kept.
        for i in (0..12_u32).rev() {
            // 0.13 rad times 11 is 1.43 rad, about a quarter of a circle with a radius of 20 m.
            let angle = 0.13 * f64::from(i);
            let at_m = 20.0 * DVec3::new(angle.sin(), 1.0 - angle.cos(), 0.01 * f64::from(i));
            // The nodding is symmetric, so that its mean is 0: from -0.022 to 0.022 rad.
            let nod = DQuat::from_rotation_y(0.004 * (f64::from(i) - 5.5));
            let world_from_rig = Pose { position_m: at_m, rotation: DQuat::from_rotation_z(angle) };
            let world_from_front =
                world_from_rig * Pose { rotation: nod * front.rotation, ..front };
            images.push(PosedImage {
                name: format!("front/{i}.png"),
                camera: camera(500.0),
                world_from_camera: world_from_front,
                time_us: None,
            });
            let front_from_left = front.inverse() * left;
            images.push(PosedImage {
                name: format!("Left Side/{i}.jpg"),
                camera: camera(300.0),
                world_from_camera: world_from_front * front_from_left,
                time_us: None,
            });
        }
        (images, [front, left])
    }

    fn options() -> CaptureOptions {
        CaptureOptions {
            name: "capture".into(),
            fps: None,
            camera_height_m: Some(1.5),
            reference: Some("front".into()),
            cameras: Vec::new(),
        }
    }

    #[test]
    fn times_of_the_images_are_those_of_the_drive() {
        let (mut images, _) = images();
        for image in &mut images {
            let number: i64 = parts(&image.name).1.parse().unwrap();
            // Taken in the order of falling numbers.
            image.time_us = Some(9_000_000 - 500_000 * number);
        }
        let made = captured_drive(&images, &Alignment::IDENTITY, &options()).unwrap();
        let keyframes = &made.trajectory.keyframes;
        let times_us: Vec<i64> = keyframes.iter().map(|keyframe| keyframe.time_us).collect();
        assert_eq!(times_us, (0..12).map(|i| 500_000 * i).collect::<Vec<_>>());
        assert!(keyframes[11].world_from_rig.position_m.length() < 1e-9);

        let refused = |images: &[PosedImage], fps| {
            let options = CaptureOptions { fps, ..options() };
            captured_drive(images, &Alignment::IDENTITY, &options).unwrap_err().to_string()
        };
        assert!(refused(&images, Some(10.0)).contains("leave out --fps"));
        let front = images.iter().position(|image| image.name == "front/3.png").unwrap();
        images[front].time_us = Some(9_000_000);
        assert!(refused(&images, None).contains("the same time_us"));
        images[front].time_us = None;
        assert!(refused(&images, None).starts_with("\"front/3.png\" has no time_us"));
    }

    #[test]
    fn the_drive_and_the_rig_are_those_that_took_the_images() {
        let (images, [front, left]) = images();
        let made = captured_drive(&images, &Alignment::IDENTITY, &options()).unwrap();
        made.trajectory.check().unwrap();
        let keyframes = &made.trajectory.keyframes;
        // 11 intervals of 0.1 s, at 10 images a second.
        assert_eq!((keyframes.len(), keyframes[11].time_us), (12, 1_100_000));
        for (i, keyframe) in keyframes.iter().enumerate() {
            let angle = 0.13 * i as f64;
            let at_m = 20.0 * DVec3::new(angle.sin(), 1.0 - angle.cos(), 0.01 * i as f64);
            let pose = keyframe.world_from_rig;
            assert!((pose.position_m - at_m).length() < 1e-9, "{i}: {pose:?}");
            assert!(
                pose.rotation.angle_between(DQuat::from_rotation_z(angle)) < 1e-6,
                "{i}: {pose:?}"
            );
        }
        let names: Vec<&str> = made.rig.cameras.iter().map(|camera| camera.name.as_str()).collect();
        assert_eq!(names, ["left-side", "front"]);
        for (camera, wanted) in made.rig.cameras.iter().zip([left, front]) {
            let pose = camera.rig_from_camera;
            assert!(
                (pose.position_m - wanted.position_m).length() < 1e-3,
                "{}: {pose:?}",
                camera.name
            );
            assert!(
                pose.rotation.angle_between(wanted.rotation) < 1e-3,
                "{}: {pose:?}",
                camera.name
            );
        }
        assert!((0.02..0.023).contains(&made.most_tilt_rad), "{}", made.most_tilt_rad);
        assert_eq!(made.rig.cameras[1].camera.pinhole.fx, 500.0);
    }

    #[test]
    fn axes_and_unit_are_those_of_the_twin() {
        let (images, _) = images();
        let plane = super::super::GroundPlane { point: DVec3::Z, up: DVec3::NEG_Z };
        // `turn` puts the capture upside down, and `back` is its inverse: together they change
        // nothing.
        let turn = Alignment::onto(&plane);
        let turned: Vec<PosedImage> = images.iter().map(|image| aligned(image, &turn)).collect();
        let back = Alignment { new_from_old: turn.new_from_old.inverse(), metres_per_unit: 1.0 };
        let wanted = captured_drive(&images, &Alignment::IDENTITY, &options()).unwrap();
        let made = captured_drive(&turned, &back, &options()).unwrap();
        for (a, b) in made.trajectory.keyframes.iter().zip(&wanted.trajectory.keyframes) {
            let off_m = a.world_from_rig.position_m.distance(b.world_from_rig.position_m);
            assert!(off_m < 1e-9, "{off_m}");
        }
        // Upside down, the cameras are below the ground.
        let without_height = CaptureOptions { camera_height_m: None, ..options() };
        let refused = captured_drive(&turned, &Alignment::IDENTITY, &without_height).unwrap_err();
        assert!(matches!(refused, CapturedDriveError::BelowGround { .. }), "{refused}");
    }

    #[test]
    fn what_cannot_be_a_drive_is_named() {
        let (images, _) = images();
        let refused = |options: CaptureOptions| {
            captured_drive(&images, &Alignment::IDENTITY, &options).unwrap_err().to_string()
        };
        let rear = CaptureOptions { reference: Some("rear".into()), ..options() };
        assert!(refused(rear).contains("\"Left Side\", \"front\""));
        assert!(
            refused(CaptureOptions { fps: Some(0.0), ..options() }).contains("images a second")
        );
        assert!(refused(CaptureOptions { name: "A".into(), ..options() }).contains("not a name"));
        let mut other = images.clone();
        other.iter_mut().filter(|i| i.name.starts_with("Left")).for_each(|i| i.name += "x.png");
        let no_pair = captured_drive(&other, &Alignment::IDENTITY, &options()).unwrap_err();
        assert!(matches!(no_pair, CapturedDriveError::NoPair { .. }), "{no_pair}");
        let one = CaptureOptions { cameras: vec!["front".into()], ..options() };
        assert_eq!(
            captured_drive(&other, &Alignment::IDENTITY, &one).unwrap().rig.cameras.len(),
            1
        );
    }

    #[test]
    fn numbers_in_names_are_ordered_as_numbers() {
        let mut names = ["a/10.png", "a/9.png", "a/009b.png", "a/1.png"];
        names.sort_by(|a, b| by_number(a, b));
        assert_eq!(names, ["a/1.png", "a/9.png", "a/009b.png", "a/10.png"]);
    }
}
