//! Small observations and an encoder of their binary layout, independent of the server's.

use serde_json::{Map, Value, json};
use wildcity_protocol::camera::{Windshield, WindshieldReference};
use wildcity_protocol::message::{Encoding, Pose, RigCamera};
use wildcity_protocol::observation::{
    Ego, Geo, Image, ImageRepair, ImageSensor, ObservationMetadata, RepairFailure, RepairStatus,
    Residency, SensorReason, SensorStatus, Stage, Timings, Trust,
};

use super::messages::{front, rear};

/// A tensor of a frame under construction.
#[derive(Clone)]
pub(crate) struct Tensor {
    pub(crate) name: String,
    pub(crate) dtype: &'static str,
    pub(crate) shape: Vec<u64>,
    pub(crate) bytes: Vec<u8>,
}

/// The parts of a frame.
#[derive(Clone)]
pub(crate) struct Frame {
    pub(crate) metadata: ObservationMetadata,
    pub(crate) tensors: Vec<Tensor>,
}

/// Contents of a frame.
#[derive(Clone, Copy)]
pub(crate) struct Recipe {
    pub(crate) encoding: Encoding,
    pub(crate) poses: u64,
    pub(crate) cameras: usize,
    pub(crate) depth: bool,
    /// Number of earlier frames of each camera.
    pub(crate) history: u64,
    pub(crate) normals: bool,
    pub(crate) instances: bool,
    pub(crate) semantics: bool,
    /// Whether the images come with their trust, the first camera is behind a windshield, and the
    /// georeference is present.
    pub(crate) trust_and_windshield: bool,
    /// Whether the session asked for repair: the first image is repaired, the second failed.
    pub(crate) repair: bool,
    /// Whether sensors have effects: the first image is late and has noise, the second is as it is;
    /// and there are samples of the motion.
    pub(crate) sensors: bool,
}

impl Recipe {
    /// Raw images of one pose and two cameras.
    pub(crate) const RAW: Self = Self {
        encoding: Encoding::Raw,
        poses: 1,
        cameras: 2,
        depth: true,
        history: 0,
        normals: false,
        instances: false,
        semantics: false,
        trust_and_windshield: false,
        repair: false,
        sensors: false,
    };
}

/// Colour of a pixel. JPEG is lossy, so its pixels are grey and change slowly.
pub(crate) fn color(recipe: Recipe, image: u64, x: u64, y: u64) -> [u8; 3] {
    let channels = match recipe.encoding {
        Encoding::Jpeg => [100 + 8 * x + 4 * y + 20 * image; 3],
        _ => [10 + 60 * x, 5 + 70 * y, 3 + 50 * image + 7 * x * y],
    };
    channels.map(|channel| u8::try_from(channel).unwrap())
}

/// Depth of a pixel, in metres; a third, so that it is not a round number in f32. 0 where nothing
/// is seen.
pub(crate) fn depth_m(image: u64, x: u64, y: u64) -> f32 {
    if opacity(x, y) > 0.0 { (1 + x + 10 * y + 100 * image) as f32 / 3.0 } else { 0.0 }
}

/// Normal of a pixel; 0 where there is no depth.
pub(crate) fn normal(x: u64, y: u64) -> [f32; 3] {
    match (opacity(x, y) > 0.0, x % 2) {
        (false, _) => [0.0; 3],
        (true, 0) => [0.0, 0.0, -1.0],
        (true, _) => [0.6, 0.0, -0.8],
    }
}

/// Whose Gaussian a pixel shows.
pub(crate) fn instance(x: u64, y: u64) -> u16 {
    [0, 1, 2, 257][((x + y) % 4) as usize]
}

/// The class of the Gaussian that a pixel shows.
pub(crate) fn class(x: u64, y: u64) -> u8 {
    [0, 1, 2, 24][((x + 2 * y) % 4) as usize]
}

/// Opacity of a pixel.
pub(crate) fn opacity(x: u64, y: u64) -> f32 {
    (x + y) as f32 / 5.0
}

/// Past positions: half a metre a step.
pub(crate) fn history_xyz_m(k: usize) -> [f32; 3] {
    [0.5 * (k as f32 - 15.0), 0.0, 0.0]
}

impl Frame {
    pub(crate) fn new(seq: u64, recipe: Recipe) -> Self {
        let xyz: Vec<f32> = (0..16).flat_map(history_xyz_m).collect();
        let rot: Vec<f32> =
            (0..16).flat_map(|_| [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]).collect();
        let mut tensors = vec![
            f32_tensor("ego.history_xyz", vec![16, 3], &xyz),
            f32_tensor("ego.history_rot", vec![16, 3, 3], &rot),
        ];
        if recipe.sensors {
            tensors.push(f32_tensor("sensor.imu", vec![2, 6], &IMU));
            tensors.push(f32_tensor("sensor.wheel_speed", vec![2], &WHEEL_SPEED));
        }
        let mut images = Vec::new();
        let mut hashes = blake3::Hasher::new();
        let mut cameras = [front(), rear()];
        if recipe.trust_and_windshield {
            cameras[0].windshield = Some(Windshield {
                reference: WindshieldReference::Forward,
                horizontal: vec![0.0, 1.0, 0.0],
                vertical: vec![0.015625, 0.0, 1.0],
            });
        }
        for pose in 0..recipe.poses {
            for (index, camera) in cameras[..recipe.cameras].iter().enumerate() {
                let number = images.len() as u64;
                let pixels = pixels(recipe, number, camera);
                let hash = blake3::hash(&pixels);
                hashes.update(hash.as_bytes());
                let prefix = if recipe.poses > 1 { format!("pose/{pose}/") } else { String::new() };
                let stem = format!("{prefix}camera/{}", camera.name);
                tensors.push(color_tensor(recipe, &stem, camera, pixels));
                if recipe.depth {
                    tensors.extend(depth_and_opacity(number, &stem, camera));
                }
                if recipe.normals {
                    let grid =
                        (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
                    let normals: Vec<f32> = grid.flat_map(|(x, y)| normal(x, y)).collect();
                    let shape = vec![camera.height, camera.width, 3];
                    tensors.push(f32_tensor(&format!("{stem}/normals"), shape, &normals));
                }
                if recipe.instances {
                    let grid =
                        (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
                    let bytes = grid.flat_map(|(x, y)| instance(x, y).to_le_bytes()).collect();
                    let shape = vec![camera.height, camera.width];
                    let name = format!("{stem}/instances");
                    tensors.push(Tensor { name, dtype: "U16", shape, bytes });
                }
                if recipe.semantics {
                    let grid =
                        (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
                    let bytes = grid.map(|(x, y)| class(x, y)).collect();
                    let shape = vec![camera.height, camera.width];
                    let name = format!("{stem}/semantics");
                    tensors.push(Tensor { name, dtype: "U8", shape, bytes });
                }
                let tensor = format!("{stem}/rgb");
                let hash = hash.to_hex().to_string();
                images.push(image(recipe, camera, index as u64, pose, tensor, hash));
            }
        }
        let frame_hash = hashes.finalize().to_hex().to_string();
        let mut history = Vec::new();
        for (index, camera) in cameras[..recipe.cameras].iter().enumerate() {
            for back in 1..=recipe.history {
                let pixels = pixels(recipe, (images.len() + history.len()) as u64, camera);
                let hash = blake3::hash(&pixels).to_hex().to_string();
                let stem = format!("camera/{}/history/{back}", camera.name);
                tensors.push(color_tensor(recipe, &stem, camera, pixels));
                let tensor = format!("{stem}/rgb");
                let time_us = 200_000 - 100_000 * back as i64;
                history.push(Image {
                    back,
                    shutter_start_us: time_us,
                    shutter_end_us: time_us,
                    ..image(recipe, camera, index as u64, 0, tensor, hash)
                });
            }
        }
        let geo = recipe.trust_and_windshield.then_some(Geo {
            latitude: 52.5,
            longitude: 13.375,
            altitude: 34.125,
            heading: 16.25,
        });
        let mut metadata =
            ObservationMetadata { history, geo, ..observation(seq, images, frame_hash) };
        metadata.timings.repair_ms = recipe.repair.then_some(7.25);
        Self { metadata, tensors }
    }

    /// The frame's bytes.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let (header, data) = self.header();
        assemble(&serde_json::to_string(&header).unwrap(), &data)
    }

    /// The header as JSON, and the tensors' bytes.
    pub(crate) fn header(&self) -> (Map<String, Value>, Vec<u8>) {
        let mut header = Map::new();
        let text = serde_json::to_string(&self.metadata).unwrap();
        header.insert("__metadata__".into(), json!({"observation": text}));
        let mut data = Vec::new();
        for Tensor { name, dtype, shape, bytes } in &self.tensors {
            let offsets = [data.len(), data.len() + bytes.len()];
            let info = json!({"dtype": dtype, "shape": shape, "data_offsets": offsets});
            header.insert(name.clone(), info);
            data.extend_from_slice(bytes);
        }
        (header, data)
    }
}

/// A frame: header length, header padded with spaces to a multiple of 8, data.
pub(crate) fn assemble(header: &str, data: &[u8]) -> Vec<u8> {
    let padded = header.len().next_multiple_of(8);
    let mut bytes = (padded as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(header.as_bytes());
    bytes.resize(8 + padded, b' ');
    bytes.extend_from_slice(data);
    bytes
}

fn pixels(recipe: Recipe, image: u64, camera: &RigCamera) -> Vec<u8> {
    (0..camera.height)
        .flat_map(|y| (0..camera.width).flat_map(move |x| color(recipe, image, x, y)))
        .collect()
}

fn color_tensor(recipe: Recipe, stem: &str, camera: &RigCamera, pixels: Vec<u8>) -> Tensor {
    let width = camera.width as u16;
    let height = camera.height as u16;
    let bytes = match recipe.encoding {
        Encoding::Raw => pixels,
        Encoding::Png => png(&pixels, width.into(), height.into()),
        Encoding::Jpeg => {
            let mut bytes = Vec::new();
            let encoder = jpeg_encoder::Encoder::new(&mut bytes, 95);
            encoder.encode(&pixels, width, height, jpeg_encoder::ColorType::Rgb).unwrap();
            // An odd length, so that the tensors after it are not aligned to 4 bytes. Decoders stop
            // at the end marker.
            if bytes.len().is_multiple_of(2) {
                bytes.push(0);
            }
            bytes
        }
    };
    let shape = match recipe.encoding {
        Encoding::Raw => vec![camera.height, camera.width, 3],
        Encoding::Png | Encoding::Jpeg => vec![bytes.len() as u64],
    };
    Tensor { name: format!("{stem}/rgb"), dtype: "U8", shape, bytes }
}

/// A PNG file.
pub(crate) fn png(pixels: &[u8], width: u32, height: u32) -> Vec<u8> {
    use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(pixels, width, height, ExtendedColorType::Rgb8)
        .unwrap();
    bytes
}

fn depth_and_opacity(image: u64, stem: &str, camera: &RigCamera) -> [Tensor; 2] {
    let grid = || (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
    let depth: Vec<f32> = grid().map(|(x, y)| depth_m(image, x, y)).collect();
    let opacity: Vec<f32> = grid().map(|(x, y)| opacity(x, y)).collect();
    let shape = vec![camera.height, camera.width];
    [
        f32_tensor(&format!("{stem}/depth"), shape.clone(), &depth),
        f32_tensor(&format!("{stem}/opacity"), shape, &opacity),
    ]
}

fn f32_tensor(name: &str, shape: Vec<u64>, values: &[f32]) -> Tensor {
    let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    Tensor { name: name.into(), dtype: "F32", shape, bytes }
}

fn image(
    recipe: Recipe,
    camera: &RigCamera,
    index: u64,
    pose: u64,
    tensor: String,
    hash: String,
) -> Image {
    let RigCamera { name, width, height, cx, cy, lens, windshield, shutter, .. } = camera.clone();
    let exposed_us = shutter.map_or(0, |shutter| shutter.duration_us);
    let seen = lens.map(|_| 0.75);
    Image {
        camera: name,
        index,
        pose,
        back: 0,
        tensor,
        encoding: recipe.encoding,
        width,
        height,
        fx: camera.fx.unwrap_or_default(),
        fy: camera.fy.unwrap_or_default(),
        cx,
        cy,
        lens,
        windshield,
        seen,
        camera_to_rig: camera.camera_to_rig,
        shutter_start_us: 200_000 - exposed_us,
        shutter_end_us: 200_000,
        repair: recipe.repair.then(|| repair(index, &hash)),
        sensor: recipe.sensors.then(|| sensor(index)),
        hash,
        trust: recipe.trust_and_windshield.then_some(Trust {
            value: 0.5,
            distance_m: 3.25,
            angle_rad: 0.0625,
            low_coverage: 0.03125,
            outside: 0.125,
        }),
    }
}

fn sensor(index: u64) -> ImageSensor {
    let [due_us, taken_us] = [200_000, 200_000 - 100_000 * (1 - index as i64)];
    match index {
        0 => ImageSensor {
            status: SensorStatus::Degraded,
            reasons: vec![SensorReason::Late, SensorReason::Noise],
            due_us,
            taken_us,
            stops: None,
            clean_hash: Some(blake3::hash(b"without noise").to_hex().to_string()),
        },
        _ => ImageSensor {
            status: SensorStatus::Ok,
            reasons: Vec::new(),
            due_us,
            taken_us,
            stops: None,
            clean_hash: None,
        },
    }
}

/// Samples of the inertial measurement unit and of the wheels, for two steps.
pub(crate) const IMU: [f32; 12] =
    [0.25, -0.5, 9.75, 0.0, 0.0, 0.125, 0.5, -0.25, 9.8125, 0.0, 0.015625, 0.25];
pub(crate) const WHEEL_SPEED: [f32; 2] = [4.5, 5.25];

fn repair(index: u64, hash: &str) -> ImageRepair {
    let before = blake3::hash(b"as rendered").to_hex().to_string();
    match index {
        0 => ImageRepair {
            status: RepairStatus::Repaired,
            rendered_hash: before,
            failure: None,
            references: vec!["log@12.00/front".into(), "log@10.00/left".into()],
        },
        _ => ImageRepair {
            status: RepairStatus::Failed,
            rendered_hash: hash.to_owned(),
            failure: Some(RepairFailure::TimedOut),
            references: Vec::new(),
        },
    }
}

fn observation(seq: u64, images: Vec<Image>, frame_hash: String) -> ObservationMetadata {
    ObservationMetadata {
        sweeps: Vec::new(),
        newer_version: None,
        seq,
        step: 2,
        time_us: 200_000,
        session: "run-17".into(),
        seed: 42,
        terminated: false,
        twin: "street".into(),
        version: 3,
        version_hash: blake3::hash(b"a manifest").to_hex().to_string(),
        profile_hash: blake3::hash(b"a profile").to_hex().to_string(),
        backend: "cpu".into(),
        frame_hash,
        ego: Ego {
            pose: Pose { xyz: [12.5, -3.25, 0.125], q: [0.8, 0.0, 0.0, 0.6] },
            velocity: [1.4, 4.8, 0.0],
            acceleration: [0.5, -0.25, 0.0],
            yaw_rate: 0.125,
            steering: Some(-0.0625),
            history_count: 3,
        },
        geo: None,
        images,
        history: Vec::new(),
        timings: Timings {
            queue_ms: 0.5,
            render_ms: 12.25,
            encode_ms: 1.5,
            repair_ms: None,
            stages_ms: vec![
                Stage { name: "project".into(), ms: 2.0 },
                Stage { name: "rasterize".into(), ms: 9.75 },
            ],
        },
        events: Vec::new(),
        route: None,
        actors: None,
        residency: Residency {
            held_bytes: 30_000_000,
            limit_bytes: 64_000_000,
            waited_for: 2,
            waited_us: 1_500,
        },
    }
}
