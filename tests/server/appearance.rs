//! Appearance of a camera: from the rig's JSON through crop and size to the pixels, and back.

use std::sync::Arc;

use serde_json::{Value, json};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::appearance::Overlay;

use crate::replay::replay;
use crate::support::{Agent, TestServer, refused, rig};

/// The front camera of the test's rig, 8 x 6 px, with additional fields.
fn front(more: Value) -> Value {
    let mut rig = serde_json::to_value(rig()).unwrap();
    rig["cameras"].as_array_mut().unwrap().truncate(1);
    rig["cameras"][0].as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    rig
}

/// An overlay of 8 x 6 px. Its right half is opaque and green.
fn green_half() -> Overlay {
    let pixel = |at: usize| if at % 8 < 4 { [9, 9, 9, 0] } else { [0, 200, 0, 255] };
    Overlay::new(8, (0..48).flat_map(pixel).collect()).unwrap()
}

async fn open(server: &TestServer, more: Value) -> Agent {
    let mut agent = server.agent().await;
    agent.open(more).await;
    agent
}

async fn pixels(agent: &mut Agent) -> Vec<u8> {
    agent.step(-4.0).await.tensors().tensor("camera/front/rgb").unwrap().data().to_vec()
}

#[tokio::test]
async fn exposure_and_overlay_are_in_the_image_and_on_record() {
    let cpu = || Cpu::new(1, Simd::Best).unwrap();
    let server = TestServer::configured(|config| config.backend = Arc::new(cpu())).await;
    let raw = json!({ "encoding": "raw" });
    let plain = json!({ "session": "plain", "rig": front(json!({})), "outputs": raw });
    let plain = pixels(&mut open(&server, plain).await).await;
    assert!(plain.iter().any(|&byte| byte > 60), "the view is empty");

    let looks = json!({
        "exposure": { "gain": [0.5, 1.0, 0.25], "offset": [0.25, 0.0, 0.0] },
        "overlay": green_half().to_data_uri(),
    });
    let request = json!({ "session": "looks", "rig": front(looks.clone()), "outputs": raw });
    let mut agent = server.agent().await;
    let opened = agent.open(request).await;
    let said = &opened["cameras"][0];
    assert_eq!(
        said["exposure"]["matrix"],
        json!([[0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.25]])
    );
    assert_eq!(said.get("overlay"), None, "it is not repeated");
    let seen = pixels(&mut agent).await;
    for (index, (seen, plain)) in seen.chunks(3).zip(plain.chunks(3)).enumerate() {
        if index % 8 >= 4 {
            assert_eq!(seen, [0, 200, 0], "pixel {index}");
            continue;
        }
        let wanted = [0.5, 1.0, 0.25].into_iter().zip([63.75, 0.0, 0.0]).zip(plain);
        for (seen, ((gain, offset), plain)) in seen.iter().zip(wanted) {
            let wanted = gain * f64::from(*plain) + offset;
            assert!((f64::from(*seen) - wanted).abs() < 1.1, "pixel {index}: {seen}, not {wanted}");
        }
    }

    // The right half, twice as high: all of it is green; the left half is as if there were none.
    for (left, green) in [(4, true), (0, false)] {
        let part = json!({ "front": { "crop": [left, 0, 4, 6], "size": [4, 12] } });
        let outputs = json!({ "encoding": "raw", "images": part });
        let request = json!({ "rig": front(looks.clone()), "outputs": outputs });
        let seen = pixels(&mut open(&server, request).await).await;
        assert_eq!(seen.len(), 3 * 4 * 12);
        assert_eq!(seen.chunks(3).all(|pixel| pixel == [0, 200, 0]), green);
    }

    // The record has all of it.
    agent.ask(json!({ "type": "close" })).await;
    let path = server.recorded().into_iter().find(|path| path.ends_with("looks-1.jsonl")).unwrap();
    assert_eq!(replay(&server, &path, &cpu()).unwrap().difference, None);
    let text = std::fs::read_to_string(&path).unwrap();
    let without = text.replace(&format!(",\"overlay\":\"{}\"", green_half().to_data_uri()), "");
    assert_ne!(text, without);
    std::fs::write(&path, without).unwrap();
    assert!(replay(&server, &path, &cpu()).unwrap().difference.is_some());
}

#[tokio::test]
async fn what_is_no_appearance_is_refused_by_its_field() {
    let server = TestServer::start().await;
    let large = Overlay::new(2, vec![0; 8]).unwrap().to_data_uri();
    let both = json!({ "gain": [1, 1, 1], "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]] });
    for (more, field) in [
        (json!({ "overlay": large }), "rig.cameras[0].overlay"),
        (json!({ "overlay": "hood.png" }), "rig.cameras[0].overlay"),
        (json!({ "exposure": {} }), "rig.cameras[0].exposure"),
        (json!({ "exposure": both }), "rig.cameras[0].exposure"),
        (json!({ "exposure": { "gain": [1, 1, 1e9] } }), "rig.cameras[0].exposure.gain"),
    ] {
        let mut agent = server.agent().await;
        let answer = agent.try_open(json!({ "rig": front(more) })).await;
        refused(&answer, "camera_invalid");
        assert_eq!(answer["field"], field);
    }
    // Each of the two is enough to be refused: a PNG of 4,096 x 3,000 clear pixels is a few
    // kilobytes.
    let clear = Overlay::new(4096, vec![0; 4 * 4096 * 3000]).unwrap().to_data_uri();
    let mut rig = front(json!({ "width": 4096, "height": 3000, "overlay": clear }));
    let second = rig["cameras"][0].clone();
    rig["cameras"].as_array_mut().unwrap().push(second);
    rig["cameras"][1]["name"] = "rear".into();
    let answer = server.agent().await.try_open(json!({ "rig": rig })).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "rig.cameras[1].overlay");
    assert!(answer["message"].as_str().unwrap().contains("24576000 pixels"), "{answer}");
    server.still_serves().await;
}
