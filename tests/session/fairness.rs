//! A session with small images together with sessions with the largest ones, on the cpu backend.
//!
//! `FAIRNESS_SESSIONS=12 FAIRNESS_SIZE=16384x8192 FAIRNESS_SECONDS=120` is the full size: 12
//! answers of 400 MB.

use std::sync::Arc;
use std::time::Duration;

use glam::{DQuat, DVec3};
use tokio::time::Instant;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice, Start};
use wildcity_session::{Session, SessionError, limits};
use wildcity_twin::residency::Cache;

use crate::driving::{Bench, bench};
use crate::streaming::demo;

/// Where the sessions drive: at the start of the street; high above it unless the full size is
/// asked for, so that a large frame takes a second and not a minute on a busy machine.
fn place() -> Pose {
    let street = demo().at(0.0);
    let height_m = if std::env::var("FAIRNESS_SIZE").is_ok() { 0.0 } else { 500.0 };
    Pose { position_m: street.position_m + height_m * DVec3::Z, ..street }
}

/// Opens a session with one camera of a size, at the start of the street.
async fn session(bench: &Bench, name: String, width_px: u32, height_px: u32) -> Session {
    let [width, height] = [width_px, height_px].map(f64::from);
    let pinhole = Pinhole { fx: width, fy: width, cx: 0.5 * width, cy: 0.5 * height };
    let camera = Camera::from_pinhole(width_px, height_px, pinhole);
    // Ahead, from the height of a windshield: OpenCV's axes (x right, y down, z ahead) in those of
    // the vehicle.
    let ahead =
        Pose { position_m: 1.5 * DVec3::Z, rotation: DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5) };
    let cameras = vec![RigCamera::new("front", camera, ahead)];
    let options = Open {
        start: Some(Start::from(place())),
        rig: Some(RigChoice::Full(Rig::new("one", cameras).into())),
        outputs: Outputs::colour(Encoding::Raw),
        ..Open::twin("demo")
    };
    Session::open(bench.engine.clone(), name, options).await.unwrap()
}

/// Steps until a moment. Returns the number of steps that were answered.
async fn steps(mut session: Session, end: Instant) -> u64 {
    let mut answered = 0;
    while Instant::now() < end {
        match session.step(place(), false).await {
            Ok(_) => answered += u64::from(Instant::now() < end),
            // A large frame that cannot be ready in time is refused; its agent asks again.
            Err(SessionError::Busy { .. } | SessionError::DeadlineExceeded) => {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
            Err(error) => panic!("{error}"),
        }
    }
    answered
}

fn setting(name: &str, default: &str) -> String {
    std::env::var(name).unwrap_or(default.to_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_small_session_keeps_driving_beside_large_ones() {
    let sessions: u64 = setting("FAIRNESS_SESSIONS", "2").parse().unwrap();
    let time = Duration::from_secs(setting("FAIRNESS_SECONDS", "5").parse().unwrap());
    let size = setting("FAIRNESS_SIZE", "6144x4608");
    let (width_px, height_px) = size.split_once('x').unwrap();
    let [width_px, height_px] = [width_px, height_px].map(|side| side.parse::<u32>().unwrap());
    assert!(u64::from(width_px) * u64::from(height_px) > limits::LARGE_SAMPLES);
    let bench = Arc::new(bench(Cache::new(demo().catalog())));

    // The large sessions without the small one, if the full size is requested, and then with it.
    let large = async |prefix: &str, end: Instant| {
        let names = (0..sessions).map(|k| format!("{prefix}-{k}"));
        let opened = names.map(|name| session(&bench, name, width_px, height_px));
        let opened = futures_util::future::join_all(opened).await;
        let all = opened.into_iter().map(|session| steps(session, end));
        futures_util::future::join_all(all).await.into_iter().sum::<u64>()
    };
    let alone = match std::env::var("FAIRNESS_SIZE") {
        Ok(_) => Some(large("alone", Instant::now() + time).await),
        Err(_) => None,
    };
    let small = session(&bench, "small".to_owned(), 32, 24).await;
    let end = Instant::now() + time;
    let (together, small) = tokio::join!(large("together", end), steps(small, end));
    let per_minute = 60.0 * small as f64 / time.as_secs_f64();
    eprintln!(
        "{small} small steps, {per_minute:.0} a minute; large ones: {together}, alone {alone:?}"
    );
    assert!(per_minute >= 60.0, "{per_minute:.0} small steps a minute");
    if let Some(alone) = alone {
        let needed = 10 * sessions;
        assert!(alone >= needed, "{alone} large frames, compare {needed}: raise FAIRNESS_SECONDS");
        // The last frame of each session, which is being rendered at the end, is not counted.
        let counted = together + sessions;
        assert!(10 * counted >= 9 * alone, "{together} large frames, {alone} alone");
    }
}
