//! Render profiles that a server or a session overrides.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DMat3;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, Rays, RenderProfile};
use wildcity_twin::ingest;
use wildcity_twin::store::{Catalog, NewSky, NewVersion, SkyBytes};

use crate::support::{TestServer, refused, rig};

fn changes(json: Value) -> wildcity_scene::ProfileOverrides {
    serde_json::from_value(json).unwrap()
}

#[tokio::test]
async fn a_session_gets_its_own_profile_before_the_servers_and_the_twins() {
    let plain = TestServer::start().await;
    let mut agent = plain.agent().await;
    let twins = agent.open(json!({})).await;
    assert_eq!(twins["profile"]["tau_px"], 1.0, "{twins}");

    let told = TestServer::configured(|config| {
        config.profile = changes(json!({ "tau_px": 2.0, "stop": 0.004 }));
    });
    let told = told.await;
    let servers = told.agent().await.open(json!({ "session": "a" })).await;
    assert_eq!(
        [&servers["profile"]["tau_px"], &servers["profile"]["stop"], &servers["profile"]["blur"]],
        [&json!(2.0), &json!(0.004), &twins["profile"]["blur"]]
    );
    let mut agent = told.agent().await;
    let own = agent.open(json!({ "session": "b", "profile": { "tau_px": 0.0 } })).await;
    assert_eq!([&own["profile"]["tau_px"], &own["profile"]["stop"]], [&json!(0.0), &json!(0.004)]);
    let hashes = [&twins, &servers, &own].map(|opened| opened["profile_hash"].as_str().unwrap());
    assert!(
        hashes[0] != hashes[1] && hashes[1] != hashes[2] && hashes[0] != hashes[2],
        "{hashes:?}"
    );
    let seen = agent.step(1.0).await;
    assert_eq!(seen.meta["profile_hash"], hashes[2], "an observation names what it was made with");
}

#[tokio::test]
async fn a_profile_that_cannot_be_had_is_refused_by_its_field() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    for (profile, code, field) in [
        (json!({ "tau_px": -1.0 }), "out_of_range", "profile.tau_px"),
        (json!({ "fov": 90 }), "invalid_request", "profile.fov"),
        (json!({ "antialiased": "yes" }), "invalid_request", "profile.antialiased"),
        (json!({ "near": 2.0, "far": 1.0 }), "out_of_range", "profile.far"),
        // The backend draws splats only: the error comes at `open`, and not with the first frame.
        (json!({ "rays": "exact" }), "out_of_range", "profile"),
    ] {
        let answer = agent.try_open(json!({ "profile": profile.clone() })).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{profile}: {answer}");
    }
    refused(&agent.try_open(json!({ "profile": 7 })).await, "invalid_request");
    agent.open(json!({})).await;
}

/// The backend cannot draw the next version: the session stays on its own.
#[tokio::test]
async fn a_version_with_a_profile_that_cannot_be_had_is_not_switched_to() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let catalog = Catalog::open(server.twins.path()).unwrap();
    let gaussians = one_gaussian();
    let next = NewVersion {
        rig: Some(rig()),
        profile: RenderProfile { rays: Rays::Exact, ..RenderProfile::default() },
        ..NewVersion::from_gaussians("test", &gaussians, Provenance::new("test".to_owned()))
    };
    assert_eq!(catalog.commit(next, &mut |_, _| {}).unwrap().number, 2);
    let answer = agent.ask(json!({ "type": "switch_version" })).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "profile", "{answer}");
    assert_eq!(agent.step(1.0).await.meta["version"], 1);
}

fn one_gaussian() -> Gaussians {
    Gaussians {
        sh_degree: 0,
        means_m: vec![[5.0, 0.0, 1.0]],
        quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]],
        ln_scales: vec![[-1.0; 3]],
        logit_opacities: vec![2.0],
        sh: vec![0.5; 3],
        ..Gaussians::default()
    }
}

/// Commits a twin `creased`. Its sky has one kink: baked at the default sky_error, the map is off
/// by at most half a step of 8 bits; for 1e-4 no map is fine enough.
fn commit_creased(dir: &Path) {
    let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let layers: [(usize, usize, Vec<u8>, Vec<u8>); 3] = [
        (1, 3, floats(&[2.0, 0.0, 0.0]), floats(&[0.2])),
        (1, 1, floats(&[1.0]), floats(&[0.0])),
        (3, 1, floats(&[1.0; 3]), floats(&[0.0; 3])),
    ];
    let mut tensors = BTreeMap::new();
    for (k, (outputs, inputs, weight, bias)) in layers.iter().enumerate() {
        let view = |shape, data| TensorView::new(Dtype::F32, shape, data).unwrap();
        tensors.insert(
            format!("sky_head.layers.{k}.weight"),
            view(vec![*outputs, *inputs], &weight[..]),
        );
        tensors.insert(format!("sky_head.layers.{k}.bias"), view(vec![*outputs], &bias[..]));
    }
    let file = safetensors::serialize(tensors, None).unwrap();
    let bytes = ingest::sky::read_bytes(&file, None).unwrap().bytes.into();
    let sky = SkyBytes { bytes, image: None, sky_from_world: DMat3::IDENTITY };
    let gaussians = one_gaussian();
    let new = NewVersion {
        rig: Some(rig()),
        sky: Some(NewSky::Put(sky)),
        ..NewVersion::from_gaussians("creased", &gaussians, Provenance::new("test".to_owned()))
    };
    Catalog::open(dir).and_then(|catalog| catalog.commit(new, &mut |_, _| {})).expect("a twin");
}

#[tokio::test]
async fn a_sky_that_cannot_be_baked_as_finely_is_refused_when_it_is_opened() {
    let server = TestServer::configured(|config| commit_creased(&config.directories.twins)).await;
    let mut agent = server.agent().await;
    let asked =
        |sky_error: f64| json!({ "twin": "creased", "profile": { "sky_error": sky_error } });
    let answer = agent.try_open(asked(1e-4)).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "profile.sky_error", "{answer}");
    let message = answer["message"].as_str().unwrap();
    assert!(message.contains("sky_error is 0.0001: set sky_error to 0.000"), "{message}");
    // The message names what works: a larger error, or 0.
    for sky_error in [0.001, 0.0] {
        let opened = server.agent().await.try_open(asked(sky_error)).await;
        assert_eq!(opened["profile"]["sky_error"], sky_error, "{opened}");
    }
}

#[tokio::test]
async fn every_map_that_was_baked_of_a_sky_is_set_aside() {
    let server = TestServer::configured(|config| commit_creased(&config.directories.twins)).await;
    let mut agents = [server.agent().await, server.agent().await];
    let mut reserved_bytes = Vec::new();
    for (agent, sky_error) in agents.iter_mut().zip([0.1, 0.001]) {
        let asked = json!({ "twin": "creased", "profile": { "sky_error": sky_error } });
        reserved_bytes.push(agent.try_open(asked).await["reserved_bytes"].as_u64().unwrap());
    }
    // Six faces of 257 x 257 values and more, of 8 B.
    let [coarse, fine] = reserved_bytes[..] else { panic!("{reserved_bytes:?}") };
    assert!(fine >= coarse + 6 * 257 * 257 * 8, "{reserved_bytes:?}");
}
