//! A COLMAP model in sparse/0: cameras, images and points, as text or binary.
//!
//! Written after COLMAP's `doc/format.rst`: `camera_from_world` as quaternion (w, x, y, z) and
//! translation, pixel centres at 0.5, no points in the images, no tracks. Without rigs and frames
//! COLMAP makes trivial ones.

use std::fmt::Write as _;

use wildcity_scene::geometry::Pose;

use crate::cameras::{CameraModel, TrainingCamera};
use crate::points::Point;
use crate::training_image::TrainingImage;

/// How the files are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColmapForm {
    /// The files cameras.txt, images.txt and points3D.txt.
    Text,
    /// The files cameras.bin, images.bin and points3D.bin.
    Binary,
}

impl ColmapForm {
    /// Extension of the files.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Text => "txt",
            Self::Binary => "bin",
        }
    }
}

/// Contents of the model.
#[derive(Clone, Copy, Debug)]
pub struct ColmapModel<'a> {
    /// The model of all cameras.
    pub model: CameraModel,
    /// The cameras; COLMAP counts them from 1.
    pub cameras: &'a [TrainingCamera],
    /// The images, counted from 1 as well.
    pub images: &'a [TrainingImage],
    pub points: &'a [Point],
}

impl ColmapModel<'_> {
    /// The files, by their names.
    pub fn files(&self, form: ColmapForm) -> [(String, Vec<u8>); 3] {
        let contents = match form {
            ColmapForm::Text => [
                self.cameras_text().into_bytes(),
                self.images_text().into_bytes(),
                self.points_text().into_bytes(),
            ],
            ColmapForm::Binary => {
                [self.cameras_binary(), self.images_binary(), self.points_binary()]
            }
        };
        let [cameras, images, points] = contents;
        let name = |stem: &str| format!("{stem}.{}", form.extension());
        [(name("cameras"), cameras), (name("images"), images), (name("points3D"), points)]
    }

    /// Focal lengths, principal point and coefficients of each camera.
    fn parameters(&self, camera: &TrainingCamera) -> Vec<f64> {
        let pinhole = &camera.camera.pinhole;
        let coefficients = self.model.coefficients(&camera.camera);
        let more = coefficients.into_iter().map(|(_, value)| value);
        [pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy].into_iter().chain(more).collect()
    }

    /// Index of an image's camera, from 1.
    fn camera_id(&self, image: &TrainingImage) -> u32 {
        let index = self.cameras.iter().position(|camera| camera.name == image.camera);
        // Images are of these cameras: 0, which COLMAP lacks, does not occur.
        index.map_or(0, |index| index as u32 + 1)
    }

    fn cameras_text(&self) -> String {
        let mut text = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
        for (id, camera) in (1..).zip(self.cameras) {
            let width = camera.camera.width_px;
            let height = camera.camera.height_px;
            let _ = write!(text, "{id} {} {width} {height}", self.model.name());
            for value in self.parameters(camera) {
                let _ = write!(text, " {value}");
            }
            text.push('\n');
        }
        text
    }

    fn images_text(&self) -> String {
        let mut text =
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] (none)\n"
                .to_owned();
        for (id, image) in (1..).zip(self.images) {
            let _ = write!(text, "{id}");
            for value in camera_from_world(&image.world_from_camera) {
                let _ = write!(text, " {value}");
            }
            // The empty line is the image's list of points.
            let _ = write!(text, " {} {}\n\n", self.camera_id(image), image.name);
        }
        text
    }

    fn points_text(&self) -> String {
        let mut text = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] (none)\n".to_owned();
        // COLMAP's points count in 64 bits, its cameras and images in 32.
        for (id, Point { at_m: [x, y, z], rgb8: [r, g, b] }) in (1_u64..).zip(self.points) {
            let _ = writeln!(text, "{id} {x} {y} {z} {r} {g} {b} 0");
        }
        text
    }

    fn cameras_binary(&self) -> Vec<u8> {
        let mut bytes = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for (id, camera) in (1_u32..).zip(self.cameras) {
            bytes.extend(id.to_le_bytes());
            bytes.extend(self.model.colmap_id().to_le_bytes());
            bytes.extend(u64::from(camera.camera.width_px).to_le_bytes());
            bytes.extend(u64::from(camera.camera.height_px).to_le_bytes());
            bytes.extend(self.parameters(camera).into_iter().flat_map(f64::to_le_bytes));
        }
        bytes
    }

    fn images_binary(&self) -> Vec<u8> {
        let mut bytes = (self.images.len() as u64).to_le_bytes().to_vec();
        for (id, image) in (1_u32..).zip(self.images) {
            bytes.extend(id.to_le_bytes());
            let pose = camera_from_world(&image.world_from_camera);
            bytes.extend(pose.into_iter().flat_map(f64::to_le_bytes));
            bytes.extend(self.camera_id(image).to_le_bytes());
            bytes.extend(image.name.as_bytes());
            // A name ends with a zero byte.
            bytes.push(0);
            // Points in the image.
            bytes.extend(0_u64.to_le_bytes());
        }
        bytes
    }

    fn points_binary(&self) -> Vec<u8> {
        let mut bytes = (self.points.len() as u64).to_le_bytes().to_vec();
        for (id, Point { at_m, rgb8 }) in (1_u64..).zip(self.points) {
            bytes.extend(id.to_le_bytes());
            bytes.extend(at_m.iter().flat_map(|value| value.to_le_bytes()));
            bytes.extend(rgb8);
            // The error, and the length of the track.
            bytes.extend(0_f64.to_le_bytes());
            bytes.extend(0_u64.to_le_bytes());
        }
        bytes
    }
}

/// Quaternion (w, x, y, z), then translation.
fn camera_from_world(world_from_camera: &Pose) -> [f64; 7] {
    let pose = world_from_camera.inverse();
    let [w, x, y, z] = pose.q_wxyz();
    let [tx, ty, tz] = pose.position_m.to_array();
    [w, x, y, z, tx, ty, tz]
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::Camera;
    use wildcity_scene::geometry::camera::Pinhole;

    use super::*;

    #[test]
    fn text_and_binary_say_the_same() {
        let pinhole = Pinhole { fx: 10.5, fy: 11.0, cx: 5.5, cy: 4.0 };
        let camera = Camera::from_pinhole(12, 8, pinhole);
        let named = |name: &str| TrainingCamera {
            name: name.to_owned(),
            camera,
            rig_from_camera: Pose::IDENTITY,
        };
        let cameras = [named("left"), named("front")];
        // The camera looks east from (1, 2, 3): the world's origin is 2 m to its right, 3 m below,
        // 1 m behind it.
        let image = TrainingImage {
            name: "front/a.png".to_owned(),
            camera: "front".to_owned(),
            // Camera x south, y down, z east.
            world_from_camera: Pose::checked([1.0, 2.0, 3.0], [0.5, -0.5, 0.5, -0.5]).unwrap(),
        };
        let points = [Point { at_m: [1.0, -2.5, 3.0], rgb8: [1, 2, 255] }];
        let images = [image];
        let made = ColmapModel {
            model: CameraModel::Pinhole,
            cameras: &cameras,
            images: &images,
            points: &points,
        };
        let [(name, cameras), (_, images), (_, points)] = made.files(ColmapForm::Text);
        assert_eq!(name, "cameras.txt");
        let data = |bytes: &[u8]| {
            let text = String::from_utf8(bytes.to_vec()).unwrap();
            text.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n")
        };
        assert_eq!(data(&cameras), "1 PINHOLE 12 8 10.5 11 5.5 4\n2 PINHOLE 12 8 10.5 11 5.5 4");
        assert_eq!(data(&images), "1 0.5 0.5 -0.5 0.5 2 3 -1 2 front/a.png\n");
        assert_eq!(data(&points), "1 1 -2.5 3 1 2 255 0");

        let [(_, cameras), (name, images), (_, points)] = made.files(ColmapForm::Binary);
        assert_eq!(name, "images.bin");
        // A camera: id 4, model 4, two sides of 8, four numbers of 8. A point: id 8, place 24,
        // colour 3, error and track 16.
        assert_eq!((cameras.len(), points.len()), (8 + 2 * 56, 8 + 8 + 24 + 3 + 16));
        assert_eq!(cameras[64..72], [2, 0, 0, 0, 1, 0, 0, 0]);
        let number =
            |bytes: &[u8], at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let pose: Vec<f64> = (0..7).map(|k| number(&images, 12 + 8 * k)).collect();
        assert_eq!(pose, [0.5, 0.5, -0.5, 0.5, 2.0, 3.0, -1.0]);
        assert_eq!(images[68..72], [2, 0, 0, 0]);
        assert_eq!(&images[72..84], b"front/a.png\0");
        assert_eq!((number(&points, 24), points[42]), (-2.5, 255));
    }
}
