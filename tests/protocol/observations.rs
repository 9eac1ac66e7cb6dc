//! Golden observations: frames, and the contents that a client must find in them.

use serde_json::{Value, json};
use wildcity_client::{FrameError, ImageView, Observation};
use wildcity_protocol::error::Code;
use wildcity_protocol::message::Encoding;
use wildcity_protocol::observation::{ManyMetadata, SessionAnswer, SessionRefusal};

use super::frames::{self, Frame, Recipe};
use super::{blessing, check_file, check_json, read};

/// The golden frames: name, `seq` of the request vector that the frame answers, recipe.
fn golden() -> [(&'static str, u64, Recipe); 12] {
    let raw = Recipe::RAW;
    [
        ("raw", 3, raw),
        ("png", 3, Recipe { encoding: Encoding::Png, depth: false, ..raw }),
        ("jpeg", 3, Recipe { encoding: Encoding::Jpeg, cameras: 1, ..raw }),
        ("bundle", 3, Recipe { cameras: 1, depth: false, history: 2, ..raw }),
        ("two_poses", 5, Recipe { poses: 2, cameras: 1, depth: false, ..raw }),
        ("normals", 3, Recipe { cameras: 1, normals: true, ..raw }),
        ("instances", 3, Recipe { cameras: 1, depth: false, instances: true, ..raw }),
        ("semantics", 3, Recipe { cameras: 1, depth: false, semantics: true, ..raw }),
        ("trust", 3, Recipe { depth: false, trust_and_windshield: true, ..raw }),
        ("repair", 3, Recipe { depth: false, repair: true, ..raw }),
        ("sensors", 3, Recipe { depth: false, sensors: true, ..raw }),
        // Between two decisions.
        ("no_images", 3, Recipe { cameras: 0, ..raw }),
    ]
}

/// A frame of raw images with known pixels.
pub(crate) fn raw_frame() -> Frame {
    let (_, seq, recipe) = golden()[0];
    Frame::new(seq, recipe)
}

/// A frame with PNG files.
pub(crate) fn png_frame() -> Frame {
    let (_, seq, recipe) = golden()[1];
    Frame::new(seq, recipe)
}

#[test]
fn golden_frames_decode_to_their_contents() {
    for (name, seq, recipe) in golden() {
        let frame = Frame::new(seq, recipe);
        let file = format!("vectors/observations/{name}.bin");
        // Another version of the encoder may write other files with the same pixels.
        if blessing() || recipe.encoding == Encoding::Raw {
            check_file(&file, &frame.bytes());
        }
        check_json(
            &format!("vectors/observations/{name}.expected.json"),
            &expected(&frame, recipe),
        );

        let observation = Observation::decode(read(&file)).unwrap();
        assert_eq!(observation.metadata(), &frame.metadata, "{name}");
        observation.verify().unwrap();
        check_history(&observation);
        let motion = [observation.imu().to_vec(), observation.wheel_speed().to_vec()];
        let expected = if recipe.sensors {
            [frames::IMU.to_vec(), frames::WHEEL_SPEED.to_vec()]
        } else {
            [Vec::new(), Vec::new()]
        };
        assert_eq!(motion, expected, "{name}");
        assert_eq!(observation.images().count() as u64, recipe.poses * recipe.cameras as u64);
        for (number, image) in observation.images().enumerate() {
            check_image(&image, recipe, number as u64);
        }
    }
}

#[test]
fn the_last_frames_of_a_camera_are_in_the_order_they_were_taken() {
    let (_, seq, recipe) = golden()[3];
    let observation = Observation::decode(read("vectors/observations/bundle.bin")).unwrap();
    assert_eq!(observation.metadata(), &Frame::new(seq, recipe).metadata);
    let frames = observation.frames("front");
    let times: Vec<_> = frames.iter().map(|frame| frame.metadata().shutter_end_us).collect();
    assert_eq!(times, [0, 100_000, 200_000]);
    // The current image is number 0, the earlier ones are 1 and 2.
    for (frame, number) in frames.iter().zip([2, 1, 0]) {
        assert_eq!(frame.rgb().unwrap()[..3], frames::color(recipe, number, 0, 0).as_slice()[..3]);
    }
    assert!(observation.frames("roof").is_empty());

    let mut wrong = Frame::new(seq, recipe);
    wrong.tensors.last_mut().unwrap().bytes[0] ^= 1;
    let found = Observation::decode(wrong.bytes()).unwrap().verify();
    assert!(matches!(found, Err(FrameError::Hash { name, .. }) if name.contains("history/2")));
    wrong.tensors.pop();
    let found = Observation::decode(wrong.bytes());
    assert!(matches!(found, Err(FrameError::Missing { name }) if name.contains("history/2")));
}

/// The golden answer to the golden `step_many`: one observation and one refusal.
#[test]
fn observations_of_several_sessions() {
    let frame = raw_frame().bytes();
    let metadata = ManyMetadata {
        seq: 3,
        answers: vec![
            SessionAnswer {
                session: "run-17".into(),
                tensor: Some("session/run-17".into()),
                error: None,
            },
            SessionAnswer {
                session: "run-18".into(),
                tensor: None,
                error: Some(SessionRefusal {
                    code: Code::SessionState,
                    message: "action moves a car; the dynamics are teleport".into(),
                    field: Some("steps[1].action".into()),
                }),
            },
        ],
    };
    let header = json!({
        "__metadata__": { "many": serde_json::to_string(&metadata).unwrap() },
        "session/run-17": { "dtype": "U8", "shape": [frame.len()], "data_offsets": [0, frame.len()] },
    });
    check_file("vectors/many/two.bin", &frames::assemble(&header.to_string(), &frame));
    check_json("vectors/many/two.expected.json", &metadata);
}

#[test]
fn raw_tensors_are_read_in_place() {
    let observation = Observation::decode(read("vectors/observations/raw.bin")).unwrap();
    let frame = observation.frame().as_ptr_range();
    for image in observation.images() {
        let rgb = image.rgb().unwrap();
        assert!(frame.contains(&rgb.as_ptr()), "{} was copied", image.metadata().tensor);
    }
}

#[test]
fn a_wrong_pixel_or_hash_is_found() {
    let mut frame = raw_frame();
    frame.tensors[2].bytes[7] ^= 1;
    let pixel = Observation::decode(frame.bytes()).unwrap().verify();
    assert!(matches!(pixel, Err(FrameError::Hash { name, .. }) if name == "camera/front/rgb"));

    let mut frame = raw_frame();
    frame.metadata.frame_hash = "0".repeat(64);
    let hash = Observation::decode(frame.bytes()).unwrap().verify();
    assert!(matches!(hash, Err(FrameError::Hash { name, .. }) if name == "frame_hash"));
}

#[test]
fn unknown_fields_of_the_metadata_are_ignored() {
    let frame = raw_frame();
    let mut metadata = serde_json::to_value(&frame.metadata).unwrap();
    super::messages::add_unknown_fields(&mut metadata);
    let known: wildcity_protocol::observation::ObservationMetadata =
        serde_json::from_value(metadata).unwrap();
    assert_eq!(known, frame.metadata);
}

fn check_history(observation: &Observation) {
    let xyz_m = observation.history_xyz_m();
    let expected: Vec<f32> = (0..16).flat_map(frames::history_xyz_m).collect();
    assert_eq!(xyz_m.as_ref(), expected);
    let rot = observation.history_rot();
    assert_eq!(rot.len(), 16 * 9);
    assert_eq!(rot[15 * 9..], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
}

fn check_image(image: &ImageView<'_>, recipe: Recipe, number: u64) {
    let rgb = image.rgb().unwrap();
    let depth_m = image.depth_m();
    let opacity = image.opacity();
    let normals = image.normals();
    assert_eq!(normals.is_some(), recipe.normals);
    let instances = image.instances();
    assert_eq!(instances.is_some(), recipe.instances);
    let semantics = image.semantics();
    assert_eq!(semantics.is_some(), recipe.semantics);
    assert_eq!(depth_m.is_some(), recipe.depth);
    assert_eq!(opacity.is_some(), recipe.depth);
    for (pixel, rgb) in rgb.chunks_exact(3).enumerate() {
        let x = pixel as u64 % 4;
        let y = pixel as u64 / 4;
        let expected = frames::color(recipe, number, x, y);
        let close = rgb.iter().zip(expected).all(|(&a, b)| a.abs_diff(b) <= tolerance(recipe));
        assert!(close, "pixel ({x}, {y}) of image {number}: {rgb:?}, not {expected:?}");
        if let Some(depth_m) = &depth_m {
            assert_eq!(depth_m[pixel], frames::depth_m(number, x, y));
        }
        if let (Some(depth_m), Some(opacity)) = (&depth_m, &opacity) {
            assert_eq!(depth_m[pixel] == 0.0, opacity[pixel] == 0.0, "pixel ({x}, {y})");
        }
        if let Some(opacity) = &opacity {
            assert_eq!(opacity[pixel], frames::opacity(x, y));
        }
        if let Some(normals) = &normals {
            assert_eq!(normals[3 * pixel..][..3], frames::normal(x, y));
        }
        if let Some(instances) = &instances {
            assert_eq!(instances[pixel], frames::instance(x, y));
        }
        if let Some(semantics) = semantics {
            assert_eq!(semantics[pixel], frames::class(x, y));
        }
    }
    assert_eq!(rgb.len(), 4 * 3 * 3);
}

/// Largest accepted error of a decoded channel.
fn tolerance(recipe: Recipe) -> u8 {
    if recipe.encoding == Encoding::Jpeg { 4 } else { 0 }
}

/// The contents that a client in any language can compare with: metadata, and a few pixels of each
/// image.
fn expected(frame: &Frame, recipe: Recipe) -> Value {
    let tensors: Vec<Value> = frame
        .tensors
        .iter()
        .map(|t| {
            // The length of a JPEG or PNG file depends on its encoder.
            let file = t.name.ends_with("/rgb") && recipe.encoding != Encoding::Raw;
            let shape = if file { Value::Null } else { json!(t.shape) };
            json!({"name": t.name, "dtype": t.dtype, "shape": shape})
        })
        .collect();
    let images: Vec<Value> = (0..frame.metadata.images.len() as u64)
        .map(|image| {
            let pixels = [(0, 0), (3, 0), (1, 2)].map(|(x, y)| {
                let depth_m = recipe.depth.then(|| frames::depth_m(image, x, y));
                let opacity = recipe.depth.then(|| frames::opacity(x, y));
                let rgb = frames::color(recipe, image, x, y);
                let normal = recipe.normals.then(|| frames::normal(x, y));
                let mut pixel = json!({
                    "x": x, "y": y, "rgb": rgb, "depth_m": depth_m, "opacity": opacity, "normal": normal,
                });
                if recipe.instances {
                    pixel["instance"] = frames::instance(x, y).into();
                }
                if recipe.semantics {
                    pixel["class"] = frames::class(x, y).into();
                }
                pixel
            });
            json!({"shape": [3, 4, 3], "pixels": pixels})
        })
        .collect();
    json!({
        "observation": frame.metadata,
        "tensors": tensors,
        "history_xyz_m_first": frames::history_xyz_m(0),
        "history_xyz_m_last": frames::history_xyz_m(15),
        "images": images,
        "rgb_tolerance": tolerance(recipe),
    })
}
