//! Every byte of an observation.

use std::collections::BTreeMap;

use serde_json::json;
use wildcity_scene::geometry::Pose;

use crate::support::{Agent, Painter, Seen, TestServer, pose, rig};

fn world_from_rig(x_m: f64) -> Pose {
    Pose { position_m: glam::DVec3::new(x_m, 0.0, 0.0), ..Pose::IDENTITY }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

async fn open(server: &TestServer, outputs: serde_json::Value) -> Agent {
    let mut agent = server.agent().await;
    agent.open(json!({ "outputs": outputs })).await;
    agent
}

#[tokio::test]
async fn opened_names_every_setting() {
    let server = TestServer::start().await;
    let mut agent = Agent::connect(server.address()).await;
    let welcome = agent.hello().await;
    assert_eq!(welcome["type"], "welcome");
    assert_eq!(welcome["protocol"], "wildcity.v1");
    assert_eq!(welcome["backend"], "painter");
    assert_eq!(welcome["limits"]["message_bytes"], 1 << 20);
    let twin = &welcome["twins"][0];
    assert_eq!((&twin["name"], &twin["gaussians"]), (&json!("test"), &json!(64)));
    assert_eq!(twin["trajectories"][0], json!({ "name": "log", "length_m": 9.0, "keyframes": 10 }));

    let opened = agent.open(json!({ "seed": 5 })).await;
    assert_eq!(opened["seq"], 1);
    assert_eq!(opened["version"], 1);
    assert_eq!(opened["version_hash"], twin["version_hash"]);
    assert_eq!(opened["profile"]["alpha_cap"], 0.99);
    assert_eq!((&opened["seed"], &opened["dt_us"]), (&json!(5), &json!(100_000)));
    assert_eq!(opened["deadline_ms"], 60_000);
    assert_eq!(opened["start"], pose(0.0));
    let cameras = opened["cameras"].as_array().unwrap();
    assert_eq!(cameras.len(), 2);
    assert_eq!((&cameras[0]["name"], &cameras[0]["width"]), (&json!("front"), &json!(8)));
    let outputs = json!({
        "cameras": ["front", "rear"], "encoding": "jpeg", "quality": 90,
        "depth": false, "opacity": false, "normals": false,
        "frames": 1, "trust": false, "period_us": { "front": 100_000, "rear": 100_000 },
    });
    assert_eq!(opened["outputs"], outputs);
    assert!(opened["reserved_bytes"].as_u64().unwrap() > 64 * 11 * 4);
    assert_eq!(agent.ask(json!({ "type": "close" })).await["summary"]["steps"], 0);
}

#[tokio::test]
async fn observations_tell_what_they_waited_for_and_hints_are_taken() {
    let server = TestServer::start().await;
    let mut agent = open(&server, json!({})).await;
    assert_eq!(agent.ask(json!({ "type": "prefetch", "poses": [pose(1.0)] })).await["type"], "ok");
    let first = agent.step(0.0).await.meta["residency"].clone();
    assert!(first["held_bytes"].as_u64().unwrap() > 0);
    assert!(first["held_bytes"].as_u64() <= first["limit_bytes"].as_u64());
    // The twin is small: all of it is loaded for the first frame.
    let second = agent.step(1.0).await.meta["residency"].clone();
    assert_eq!((&second["waited_for"], &second["waited_us"]), (&json!(0), &json!(0)));
    let answer = agent.ask(json!({ "type": "prefetch", "poses": [] })).await;
    crate::support::refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "poses");
}

#[tokio::test]
async fn raw_pixels_and_maps_are_the_renderers() {
    let server = TestServer::start().await;
    let outputs = json!({
        "encoding": "raw", "depth": true, "opacity": true, "normals": true, "instances": true,
        "semantics": true,
    });
    let mut agent = open(&server, outputs).await;
    let seen = agent.step(2.0).await;
    let tensors = seen.tensors();
    for (k, camera) in rig().cameras.iter().enumerate() {
        let w = camera.camera.width_px as usize;
        let h = camera.camera.height_px as usize;
        let rgb = tensors.tensor(&format!("camera/{}/rgb", camera.name)).unwrap();
        assert_eq!(rgb.shape(), [h, w, 3]);
        let expected =
            Painter::image(&(world_from_rig(2.0) * camera.rig_from_camera), &camera.camera);
        assert_eq!(rgb.data(), expected);
        let depth = tensors.tensor(&format!("camera/{}/depth", camera.name)).unwrap();
        assert_eq!(depth.shape(), [h, w]);
        assert_eq!(floats(depth.data()), vec![1.5 + k as f32; w * h]);
        let opacity = tensors.tensor(&format!("camera/{}/opacity", camera.name)).unwrap();
        assert_eq!(floats(opacity.data()), vec![0.25; w * h]);
        let normals = tensors.tensor(&format!("camera/{}/normals", camera.name)).unwrap();
        assert_eq!(normals.shape(), [h, w, 3]);
        assert_eq!(floats(normals.data()), vec![-0.5; 3 * w * h]);
        let instances = tensors.tensor(&format!("camera/{}/instances", camera.name)).unwrap();
        assert_eq!((instances.shape(), instances.dtype()), (&[h, w][..], safetensors::Dtype::U16));
        assert_eq!(instances.data(), [7 + k as u8, 0].repeat(w * h));
        let semantics = tensors.tensor(&format!("camera/{}/semantics", camera.name)).unwrap();
        assert_eq!((semantics.shape(), semantics.dtype()), (&[h, w][..], safetensors::Dtype::U8));
        assert_eq!(semantics.data(), vec![3 + k as u8; w * h]);

        let image = &seen.meta["images"][k];
        assert_eq!(image["hash"], blake3::hash(&expected).to_hex().as_str());
        assert_eq!(image["tensor"], format!("camera/{}/rgb", camera.name));
        assert_eq!((&image["index"], &image["pose"]), (&json!(k), &json!(0)));
        assert_eq!((&image["width"], &image["fx"]), (&json!(w), &json!(10.0)));
        assert_eq!(image["shutter_end_us"], 100_000);
    }
    assert_eq!(tensors.len(), 14);
    assert_eq!(seen.meta["timings"]["stages_ms"], json!([{ "name": "paint", "ms": 0.5 }]));
}

/// The header has no padding except at most 7 spaces; the tensors begin at a multiple of 8.
#[tokio::test]
async fn the_header_has_the_size_of_its_contents() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "outputs": { "encoding": "raw" }, "decision_us": 200_000 })).await;
    for (step, images, at_most) in [(1, 0, 3072), (2, 2, 6144)] {
        let seen = agent.step(f64::from(step)).await;
        assert_eq!(seen.meta["images"].as_array().unwrap().len(), images);
        let length = u64::from_le_bytes(seen.bytes[..8].try_into().unwrap()) as usize;
        let header = &seen.bytes[8..8 + length];
        let spaces = header.iter().rev().take_while(|&&byte| byte == b' ').count();
        assert!(length.is_multiple_of(8) && spaces < 8, "{length} bytes with {spaces} spaces");
        assert!(seen.bytes.len() < at_most, "{} bytes", seen.bytes.len());
        if images == 0 {
            assert_eq!(seen.bytes.len(), 8 + length + 4 * 16 * 12);
            assert_eq!(seen.frame_hash(), blake3::hash(&[]).to_hex().as_str());
        }
    }
}

/// With normals, an answer has half of the pixels, and with instances, semantics or both three
/// quarters.
#[tokio::test]
async fn normals_halve_the_pixels_of_an_answer() {
    let server = TestServer::start().await;
    let mut agent = Agent::connect(server.address()).await;
    let most = agent.hello().await["limits"]["answer_pixels"].as_u64().unwrap();
    // 8 x 6 and 5 x 4 px: the sizes of the images make up the number of pixels exactly, or one row
    // more.
    let width = 16_384;
    for (normals, [instances, semantics], pixels) in [
        (true, [false; 2], most / 2),
        (true, [true; 2], most / 8 * 3),
        (true, [false, true], most / 8 * 3),
        (false, [true, false], most / 4 * 3),
        (false, [false, true], most / 4 * 3),
        (false, [true; 2], most / 4 * 3),
        (false, [false; 2], most),
    ] {
        for more in [0, 1] {
            let height = pixels / width + more;
            let outputs = json!({
                "cameras": ["front"], "normals": normals, "instances": instances,
                "semantics": semantics, "depth": true, "opacity": true,
                "images": { "front": { "size": [width, height] } },
            });
            let answer = agent.try_open(json!({ "outputs": outputs })).await;
            if more == 1 {
                crate::support::refused(&answer, "answer_too_large");
                assert!(
                    answer["message"].as_str().unwrap().contains(&pixels.to_string()),
                    "{answer}"
                );
            } else {
                assert_eq!(answer["type"], "opened", "{answer}");
                agent.ask(json!({ "type": "close" })).await;
            }
        }
    }
}

#[tokio::test]
async fn lenses_shutters_and_parts_of_images_are_described_as_sent() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let lens = json!({ "model": "fisheye", "k": [0.0, 0.0, 0.0, 0.0], "max_angle": 0.5 });
    let camera = json!({
        "name": "wide", "width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8.0, "cy": 6.0,
        "lens": lens, "shutter": { "direction": "top_to_bottom", "duration_us": 30_000 },
        "camera_to_rig": pose(0.0),
    });
    let part = json!({ "wide": { "crop": [2, 0, 12, 12], "size": [24, 12] } });
    let opened = agent
        .open(json!({
            "rig": { "name": "r", "cameras": [camera] },
            "outputs": { "images": part, "encoding": "raw" },
        }))
        .await;
    let seen = agent.step(1.0).await;
    for said in [&opened["cameras"][0], &seen.meta["images"][0]] {
        assert_eq!((&said["width"], &said["height"]), (&json!(24), &json!(12)));
        assert_eq!((&said["fx"], &said["fy"]), (&json!(20.0), &json!(10.0)));
        assert_eq!((&said["cx"], &said["cy"]), (&json!(12.0), &json!(6.0)));
        assert_eq!(said["lens"], lens);
    }
    let image = &seen.meta["images"][0];
    assert_eq!(
        (&image["shutter_start_us"], &image["shutter_end_us"]),
        (&json!(70_000), &json!(100_000))
    );
    // A disc of 5 px around the middle of 12 x 12.
    let share = image["seen"].as_f64().unwrap();
    assert!((share - 25.0 * std::f64::consts::PI / 144.0).abs() < 0.05, "{share}");
    // A crop that is not within the image is refused.
    let mut agent = server.agent().await;
    for (part, code, field) in [
        (json!({ "front": { "crop": [0, 0, 9, 6] } }), "out_of_range", "outputs.images.front.crop"),
        (json!({ "top": {} }), "unknown_camera", "outputs.images.top"),
    ] {
        let answer = agent.try_open(json!({ "outputs": { "images": part } })).await;
        crate::support::refused(&answer, code);
        assert_eq!(answer["field"], field);
    }
    server.still_serves().await;
}

#[tokio::test]
async fn trust_is_sent_if_it_is_requested() {
    let server = TestServer::start().await;
    let mut agent = open(&server, json!({ "encoding": "raw", "trust": true })).await;
    // The drive ends at 9 m; the painter's opacity is a quarter everywhere: a hole, where it is
    // below the horizon. The sampled pixels of the small rear image are above it.
    let seen = agent.step(20.0).await;
    for (image, low_coverage) in seen.meta["images"].as_array().unwrap().iter().zip([1.0, 0.0]) {
        let trust = &image["trust"];
        assert_eq!((&trust["distance_m"], &trust["angle_rad"]), (&json!(11.0), &json!(0.0)));
        assert_eq!(trust["low_coverage"], json!(low_coverage));
        let value = (-11.0_f64 / 5.0).exp() * (1.0 - low_coverage);
        assert!((trust["value"].as_f64().unwrap() - value).abs() < 1e-9, "{trust}");
    }
    assert!(!seen.tensors().names().iter().any(|name| name.ends_with("opacity")), "not asked for");
    // Eleven metres off the drive, and half of the visible ground is a hole.
    let summary = &agent.ask(json!({ "type": "close" })).await["summary"];
    assert_eq!(summary["outcome"], "off_model");
    let least = summary["least_trust"].as_f64().unwrap();
    assert!((least - 0.5 * (-11.0_f64 / 5.0).exp()).abs() < 1e-9, "{least}");
    let mut agent = open(&server, json!({ "encoding": "raw", "trust": true })).await;
    agent.step(9.0).await;
    let looks = agent.look(json!({ "type": "observe", "poses": [pose(9.0), pose(12.0)] })).await;
    let images = looks.meta["images"].as_array().unwrap();
    let distances_m: Vec<_> = images.iter().map(|image| &image["trust"]["distance_m"]).collect();
    assert_eq!(distances_m, [0.0, 0.0, 3.0, 3.0].map(|m| json!(m)).iter().collect::<Vec<_>>());
    // Poses that are only observed do not count as poses of the ego.
    let summary = &agent.ask(json!({ "type": "close" })).await["summary"];
    assert_eq!(
        *summary,
        json!({
            "outcome": "completed", "steps": 1, "time_us": 100_000, "distance_m": 9.0, "least_trust": 0.5,
            "episode": summary["episode"],
        })
    );
    let seen = open(&server, json!({})).await.step(1.0).await;
    assert_eq!(seen.meta["images"][0].get("trust"), None);
}

#[tokio::test]
async fn floats_can_be_read_in_place() {
    let server = TestServer::start().await;
    // 5 x 4 px: 60 raw bytes, and a JPEG of whatever length.
    for encoding in ["raw", "jpeg", "png"] {
        let outputs = json!({ "encoding": encoding, "depth": true, "opacity": true });
        let seen = open(&server, outputs).await.step(1.0).await;
        let header = u64::from_le_bytes(seen.bytes[..8].try_into().unwrap()) as usize;
        let (_, layout) = safetensors::SafeTensors::read_metadata(&seen.bytes).unwrap();
        for (name, info) in layout.tensors().into_iter().collect::<BTreeMap<_, _>>() {
            let at = 8 + header + info.data_offsets.0;
            let is_aligned = at.is_multiple_of(4);
            assert!(is_aligned || name.ends_with("/rgb"), "{encoding}: {name} at {at}");
        }
    }
}

#[tokio::test]
async fn frame_hashes_chain_the_images() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let seen = agent.step(1.0).await;
    let mut hasher = blake3::Hasher::new();
    for image in seen.meta["images"].as_array().unwrap() {
        hasher.update(blake3::Hash::from_hex(image["hash"].as_str().unwrap()).unwrap().as_bytes());
    }
    assert_eq!(seen.frame_hash(), hasher.finalize().to_hex().as_str());
    assert_ne!(agent.step(1.5).await.frame_hash(), seen.frame_hash());
}

#[tokio::test]
async fn png_is_lossless_and_jpeg_is_near() {
    let server = TestServer::start().await;
    let camera = &rig().cameras[0];
    let truth = Painter::image(&(world_from_rig(1.0) * camera.rig_from_camera), &camera.camera);
    let decode = |seen: &Seen| {
        let tensors = seen.tensors();
        let file = tensors.tensor("camera/front/rgb").unwrap();
        assert_eq!(file.shape(), [file.data().len()]);
        image::load_from_memory(file.data()).unwrap().into_rgb8()
    };
    let png = open(&server, json!({ "encoding": "png" })).await.step(1.0).await;
    assert_eq!(decode(&png).into_raw(), truth);
    let best = open(&server, json!({ "encoding": "jpeg", "quality": 100 })).await.step(1.0).await;
    let worst = open(&server, json!({ "encoding": "jpeg", "quality": 1 })).await.step(1.0).await;
    let error = |seen: &Seen| -> u64 {
        let pixels = decode(seen).into_raw();
        assert_eq!(pixels.len(), truth.len());
        pixels.iter().zip(&truth).map(|(a, b)| u64::from(a.abs_diff(*b)).pow(2)).sum()
    };
    assert!(error(&best) < error(&worst), "{} {}", error(&best), error(&worst));
    // The hash is of the pixels before they are encoded.
    assert_eq!(png.frame_hash(), best.frame_hash());
    assert_eq!(png.frame_hash(), worst.frame_hash());
}

#[tokio::test]
async fn time_motion_and_history_advance_with_steps() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "dt_us": 50_000, "outputs": { "encoding": "raw" } })).await;
    let start = agent.look(json!({ "type": "reset", "seed": 9 })).await;
    assert_eq!((&start.meta["step"], &start.meta["time_us"]), (&json!(0), &json!(0)));
    assert_eq!(start.meta["ego"]["velocity"], json!([0.0, 0.0, 0.0]));
    assert_eq!(start.meta["ego"]["history_count"], 1);
    let mut last = start;
    for step in 1..=10 {
        last = agent.step(f64::from(step) * 0.5).await;
    }
    assert_eq!((&last.meta["step"], &last.meta["time_us"]), (&json!(10), &json!(500_000)));
    assert_eq!(last.meta["seed"], 9);
    assert_eq!(last.meta["ego"]["velocity"], json!([10.0, 0.0, 0.0]));
    assert_eq!(last.meta["ego"]["pose"], pose(5.0));
    assert_eq!(last.meta["ego"]["history_count"], 6);
    let tensors = last.tensors();
    let xyz = floats(tensors.tensor("ego.history_xyz").unwrap().data());
    assert_eq!(xyz[45..], [0.0; 3]);
    assert!((xyz[42] + 1.0).abs() < 1e-6, "{xyz:?}");
    assert!((xyz[0] + 5.0).abs() < 1e-6, "{xyz:?}");
    let rotation = floats(tensors.tensor("ego.history_rot").unwrap().data());
    assert_eq!(rotation[135..], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);

    let over = agent.look(json!({ "type": "step", "pose": pose(6.0), "terminate": true })).await;
    assert_eq!(over.meta["terminated"], true);
    let refused = agent.ask(json!({ "type": "step", "pose": pose(7.0) })).await;
    crate::support::refused(&refused, "session_state");
    let summary = &agent.ask(json!({ "type": "close" })).await["summary"];
    let expected = json!({
        "outcome": "completed", "steps": 11, "time_us": 550_000, "distance_m": 6.0,
        "episode": summary["episode"],
    });
    assert_eq!(*summary, expected);
}

#[tokio::test]
async fn observe_shows_several_places_and_moves_nothing() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    let poses = [pose(4.0), pose(5.0), pose(6.0)];
    let seen = agent.look(json!({ "type": "observe", "poses": poses })).await;
    assert_eq!((&seen.meta["step"], &seen.meta["ego"]["pose"]), (&json!(1), &pose(1.0)));
    let images = seen.meta["images"].as_array().unwrap();
    assert_eq!(images.len(), 6);
    let tensors = seen.tensors();
    for (k, x_m) in [4.0, 5.0, 6.0].into_iter().enumerate() {
        for (c, camera) in rig().cameras.iter().enumerate() {
            let image = &images[2 * k + c];
            let name = format!("pose/{k}/camera/{}/rgb", camera.name);
            assert_eq!((&image["tensor"], &image["pose"]), (&json!(name), &json!(k)));
            let expected =
                Painter::image(&(world_from_rig(x_m) * camera.rig_from_camera), &camera.camera);
            assert_eq!(tensors.tensor(&name).unwrap().data(), expected);
        }
    }
    let one = agent.look(json!({ "type": "observe", "poses": [pose(4.0)] })).await;
    assert_eq!(one.meta["images"][0]["tensor"], "camera/front/rgb");
    assert_eq!(agent.step(2.0).await.meta["step"], 2);
}

#[tokio::test]
async fn cameras_are_chosen_and_ordered_by_the_agent() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "cameras": ["rear"] });
    let mut agent = server.agent().await;
    let opened = agent.open(json!({ "outputs": outputs })).await;
    assert_eq!(opened["cameras"][0]["name"], "rear");
    let seen = agent.step(1.0).await;
    assert_eq!(seen.meta["images"].as_array().unwrap().len(), 1);
    assert_eq!((&seen.meta["images"][0]["index"], seen.tensors().len()), (&json!(0), 3));

    let mut agent = server.agent().await;
    let preset = agent.open(json!({ "rig": "vehicle6" })).await;
    assert_eq!(preset["cameras"].as_array().unwrap().len(), 6);
    let station = json!({ "trajectory": "log", "station_m": 2.5 });
    let start = agent.look(json!({ "type": "reset", "start": station })).await;
    assert_eq!(start.meta["ego"]["pose"], pose(2.5));
    assert_eq!(start.meta["images"].as_array().unwrap().len(), 6);
}

/// A number that takes 24 characters.
const UGLY: f64 = -1.234_567_890_123_456_7e-300;

/// Sixteen cameras with the longest names, and lenses and windshields with the most numbers.
pub(crate) fn cameras_of_long_headers() -> Vec<serde_json::Value> {
    let coefficients = |first: usize| {
        let mut all = [UGLY; 21];
        all[first] = 1.0;
        all.to_vec()
    };
    let camera = |k: usize| {
        json!({
            "name": format!("{k:x}{}", "c".repeat(63)),
            "width": 1, "height": 1,
            "fx": 123_456.789_012_345_67, "fy": 123_456.789_012_345_67,
            "cx": UGLY, "cy": UGLY,
            "lens": { "model": "opencv", "k": vec![UGLY; 6], "p": vec![UGLY; 2], "s": vec![UGLY; 4] },
            // The coefficients of φ and of θ.
            "windshield": {
                "reference": "backward", "horizontal": coefficients(1), "vertical": coefficients(6),
            },
            "native_size": [1_920.123_456_789_012_3, 1_080.123_456_789_012_3],
            "camera_to_rig": { "xyz": [UGLY, UGLY, UGLY], "q": [1.0, UGLY, UGLY, UGLY] },
        })
    };
    (0..16).map(camera).collect()
}

/// Room for the header is reserved before the header is known: the longest header must fit.
#[tokio::test]
async fn the_longest_header_fits() {
    let server = TestServer::start().await;
    let cameras = cameras_of_long_headers();
    let ugly = UGLY;
    let mut agent = server.agent().await;
    let outputs = json!({ "encoding": "raw", "depth": true, "opacity": true, "normals": true });
    let rig = json!({ "name": "r", "cameras": cameras });
    agent
        .open(
            json!({ "rig": rig, "outputs": outputs, "session": "s".repeat(64), "seed": u64::MAX }),
        )
        .await;
    let poses: Vec<_> = (0..16)
        .map(|_| json!({ "xyz": [ugly, ugly, ugly], "q": [1.0, ugly, ugly, ugly] }))
        .collect();
    let seen = agent.look(json!({ "type": "observe", "poses": poses })).await;
    assert_eq!(seen.meta["images"].as_array().unwrap().len(), 256);
    assert_eq!(seen.tensors().len(), 2 + 4 * 256);
}

#[tokio::test]
async fn sessions_side_by_side_see_what_they_would_see_alone() {
    let server = TestServer::start().await;
    let mut alone = Vec::new();
    let mut agent = server.driver("alone").await;
    for step in 0..20 {
        alone.push(agent.step(f64::from(step)).await.frame_hash().to_owned());
    }
    let mut one = server.driver("one").await;
    let mut two = server.driver("two").await;
    for (step, expected) in alone.iter().enumerate() {
        let back = alone.len() - 1 - step;
        let (a, b) = tokio::join!(one.step(step as f64), two.step(back as f64));
        assert_eq!((a.frame_hash(), b.frame_hash()), (&**expected, &*alone[back]));
    }
    assert_eq!(server.running.sessions(), 3);
}
