//! transforms.json, as nerfstudio reads it.
//!
//! Poses are `world_from_camera` with OpenGL's camera: x right, y up, z backwards (nerfstudio's
//! data conventions). The world is the twin's. nerfstudio requires `mask_path` and
//! `depth_file_path` on every frame or on none, and one `camera_model` per file. `weight`, `trust`
//! and `station_m` are additions of this project, which other readers ignore.

use glam::{DMat3, DVec3};
use serde_json::{Map, Value, json};

use wildcity_scene::geometry::Pose;

use crate::cameras::{CameraModel, TrainingCamera};
use crate::record::Sample;
use crate::training_image::TrainingImage;

/// The file: a frame for each sample, with the intrinsics of its camera.
pub fn transforms(model: CameraModel, cameras: &[TrainingCamera], samples: &[Sample]) -> Value {
    let frame = |sample: &Sample| {
        let camera = cameras.iter().find(|camera| camera.name == sample.camera)?;
        Some(frame(model, camera, sample))
    };
    // A sample without a camera of the list would be a frame without intrinsics.
    let frames: Vec<Value> = samples.iter().filter_map(frame).collect();
    json!({"camera_model": model.name(), "frames": frames})
}

fn frame(model: CameraModel, training: &TrainingCamera, sample: &Sample) -> Value {
    let mut fields = posed_frame(model, training, &TrainingImage::from(sample));
    let name = &sample.name;
    let mut set = |field: &str, value: Value| fields.insert(field.to_owned(), value);
    set("mask_path", json!(format!("masks/{name}")));
    set("depth_file_path", json!(format!("depth/{name}")));
    set("weight", json!(sample.weight));
    set("trust", json!(sample.trust));
    Value::Object(fields)
}

/// A frame of transforms.json with its file in `images/`, its camera and its pose.
pub fn posed_frame(
    model: CameraModel,
    training: &TrainingCamera,
    image: &TrainingImage,
) -> Map<String, Value> {
    let camera = &training.camera;
    let mut fields = Map::new();
    let mut set = |field: &str, value: Value| fields.insert(field.to_owned(), value);
    set("file_path", json!(format!("images/{}", image.name)));
    set("w", json!(camera.width_px));
    set("h", json!(camera.height_px));
    set("fl_x", json!(camera.pinhole.fx));
    set("fl_y", json!(camera.pinhole.fy));
    set("cx", json!(camera.pinhole.cx));
    set("cy", json!(camera.pinhole.cy));
    for (field, value) in model.coefficients(camera) {
        set(field, json!(value));
    }
    set("transform_matrix", json!(opengl(&image.world_from_camera)));
    fields
}

/// Rows of the 4 x 4 matrix `world_from_camera` with OpenGL's camera axes.
fn opengl(world_from_camera: &Pose) -> [[f64; 4]; 4] {
    // OpenCV's camera has y down and z ahead: both change their sign.
    let flipped = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let rotation = world_from_camera.rotation_matrix() * flipped;
    let at_m = world_from_camera.position_m;
    let row = |k: usize| {
        let [x, y, z] = rotation.row(k).to_array();
        [x, y, z, at_m[k]]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::Camera;
    use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};

    use super::*;

    #[test]
    fn a_camera_that_looks_east_has_its_opengl_axes() {
        // Camera x (right) is south, y (down) is down, z (forward) is east.
        let pose = Pose::checked([1.0, 2.0, 3.0], [0.5, -0.5, 0.5, -0.5]).unwrap();
        let rows = opengl(&pose);
        let expected = [
            // OpenGL's z looks backwards, that is west.
            [0.0, 0.0, -1.0, 1.0],
            [-1.0, 0.0, 0.0, 2.0],
            [0.0, 1.0, 0.0, 3.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        for (row, expected) in rows.iter().zip(&expected) {
            for (value, expected) in row.iter().zip(expected) {
                assert!((value - expected).abs() < 1e-12, "{rows:?}");
            }
        }
    }

    #[test]
    fn every_frame_has_its_files_intrinsics_and_weight() {
        let pinhole = Pinhole { fx: 10.0, fy: 11.0, cx: 5.5, cy: 4.0 };
        let mut camera = Camera::from_pinhole(12, 8, pinhole);
        camera.lens = Lens::Fisheye(Fisheye::new([0.1, 0.0, 0.0, 0.2], None));
        let rig_from_camera = Pose::IDENTITY;
        let camera = TrainingCamera { name: "front".to_owned(), camera, rig_from_camera };
        let sample = Sample {
            name: "front/a.png".to_owned(),
            trajectory: "log".to_owned(),
            station_m: 2.0,
            offset_m: 0.5,
            camera: "front".to_owned(),
            world_from_camera: Pose::IDENTITY,
            trust: 0.5,
            weight: crate::weight(0.5),
            counted: 1.0,
            repair: None,
            files: Default::default(),
        };
        let made = transforms(CameraModel::OpenCvFisheye, &[camera], &[sample]);
        assert_eq!(made["camera_model"], "OPENCV_FISHEYE");
        let frame = &made["frames"][0];
        assert_eq!(frame["file_path"], "images/front/a.png");
        assert_eq!(frame["mask_path"], "masks/front/a.png");
        assert_eq!(frame["depth_file_path"], "depth/front/a.png");
        for (field, value) in
            [("w", 12.0), ("h", 8.0), ("fl_x", 10.0), ("fl_y", 11.0), ("cx", 5.5), ("cy", 4.0)]
        {
            assert_eq!(frame[field].as_f64(), Some(value), "{field}");
        }
        assert_eq!((frame["k1"].as_f64(), frame["k4"].as_f64()), (Some(0.1), Some(0.2)));
        assert_eq!(frame["weight"].as_f64(), Some(0.15));
    }
}
