//! Names of the cameras of real images.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use wildcity_scene::rig::is_name;

use super::list::RealImage;

/// The camera of each image: its folder if the images are in several folders, else its file name
/// without the digits at its end.
pub fn camera_names(images: &[&RealImage]) -> Vec<String> {
    let folder = |image: &RealImage| Path::new(&image.name).parent().map(Path::to_owned);
    // Captures of several cameras have a folder for each, or one folder with files that begin with
    // the names of the cameras.
    let folders: BTreeSet<Option<PathBuf>> = images.iter().map(|image| folder(image)).collect();
    let name = |image: &&RealImage| {
        let path = Path::new(&image.name);
        let text = if folders.len() > 1 {
            path.parent().and_then(Path::file_name)
        } else {
            path.file_stem()
        };
        let text = text.unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let ends_name = |c: char| c.is_ascii_digit() || "._-".contains(c);
        let text = if folders.len() > 1 { &*text } else { text.trim_end_matches(ends_name) };
        let allowed = |c: char| if c.is_ascii_alphanumeric() || "_-".contains(c) { c } else { '_' };
        let text: String = text.chars().map(allowed).collect();
        if is_name(&text) { text } else { "camera".to_owned() }
    };
    images.iter().map(name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::geometry::{Camera, Pose};

    fn named(names: &[&str]) -> Vec<String> {
        let pinhole = Pinhole { fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 };
        let image = |name: &&str| RealImage {
            name: (*name).to_owned(),
            file: PathBuf::new(),
            mask: None,
            depth: None,
            weight: None,
            camera: Camera::from_pinhole(2, 2, pinhole),
            world_from_camera: Pose::IDENTITY,
            near: None,
            time_us: None,
            exposure_stops: None,
            ground_mask: None,
            sky_mask: None,
            held_out: false,
        };
        let images: Vec<RealImage> = names.iter().map(image).collect();
        camera_names(&images.iter().collect::<Vec<_>>())
    }

    #[test]
    fn cameras_are_named_by_folder_or_file() {
        assert_eq!(named(&["images/front/1.png", "images/Left 2/1.png"]), ["front", "left_2"]);
        assert_eq!(named(&["images/front_0001.jpg", "images/rear_0001.jpg"]), ["front", "rear"]);
        assert_eq!(named(&["0001.jpg", "0002.jpg"]), ["camera", "camera"]);
    }
}
