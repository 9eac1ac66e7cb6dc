//! Frames without actors are those of the builds before there were actors: the images of commit
//! 4f2fba29, which served the same file with the cpu backend to an agent that sent the same poses.
//! Its demo street had the same images as well: 13 frames of six full-size cameras, and today's
//! `wildcity episode verify` finds no difference in its record.
//!
//! A change of the images of pinhole cameras on purpose changes the hashes. Then compare such a
//! build with the previous one, and write the new hashes into this file.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_session::Session;
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice, Start};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::driving::bench_with;
use crate::scene_files::gaussians;

/// The `frame_hash` of the start and of four steps.
const FRAME_HASHES: [&str; 5] = [
    "90d12f4aa5c2236daa2a82ad79f570a8d379c169303b2a0f9314e15622424d6f",
    "be3f5ea694b8f15a362d0e33c5c94d61472a058a5b0523c062e5e5a6d7ee8475",
    "902dae6f1b434ebe89c3a434ef3c34acd60e7b2c27572858abfc36f0bb87f998",
    "374e4699d930f4f1648ee266fffcc7cedfc158c3eb6a921b88f570a88e2f2a67",
    "ba39488527a55f23ca913939924267fa778eb39d731bc3dd006c550488de9781",
];

/// Where the rig is: in a curve to the left, 2 m apart.
fn at(step: u32) -> Pose {
    let step = f64::from(step);
    let position_m = DVec3::new(2.0 * step, 0.25 * step * step, 0.0);
    // Of rational components: no function of a library rounds them.
    let half = 0.125 * step;
    let (w, z) = ((1.0 - half * half) / (1.0 + half * half), 2.0 * half / (1.0 + half * half));
    Pose { position_m, rotation: DQuat::from_xyzw(0.0, 0.0, z, w) }
}

fn rig() -> Rig {
    let camera = |name: &str, size_px: [u32; 2], focal_px: f64, rotation: DQuat| {
        let [width_px, height_px] = size_px;
        let [cx, cy] = [width_px, height_px].map(|size| 0.5 * f64::from(size));
        let pinhole = Pinhole { fx: focal_px, fy: focal_px, cx, cy };
        let rig_from_camera = Pose { position_m: DVec3::new(1.5, 0.0, 1.6), rotation };
        RigCamera::new(name, Camera::from_pinhole(width_px, height_px, pinhole), rig_from_camera)
    };
    let cameras = vec![
        camera("front", [160, 96], 110.0, DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5)),
        camera("up", [97, 64], 60.0, DQuat::IDENTITY),
    ];
    Rig::new("two", cameras)
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_without_actors_are_those_before_there_were_actors() {
    // Other instruction sets round otherwise: sets of four lanes have no fused multiply-add.
    let Ok(backend) = Cpu::new(0, Simd::Avx2) else {
        eprintln!("NOT RUN: frames of earlier builds: this machine has no AVX2");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let cloud = gaussians(20_000, 1, 30.0, 9);
    let new = NewVersion::from_gaussians("cloud", &cloud, Provenance::new("test".to_owned()));
    catalog.commit(new, &mut |_, _| {}).unwrap();
    let bench = bench_with(Cache::new(catalog), Arc::new(backend));
    let options = Open {
        start: Some(Start::from(at(0))),
        rig: Some(RigChoice::Full(rig().into())),
        outputs: Outputs::colour(Encoding::Raw),
        ..Open::twin("cloud")
    };
    let mut session = Session::open(bench.engine.clone(), "a".to_owned(), options).await.unwrap();
    let mut found = vec![session.reset(0, None).await.unwrap().frame_hash];
    for step in 1..5 {
        found.push(session.step(at(step), false).await.unwrap().frame_hash);
    }
    let found: Vec<String> = found.iter().map(|hash| hash.to_hex().to_string()).collect();
    assert_eq!(found, FRAME_HASHES);
}
