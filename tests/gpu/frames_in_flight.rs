//! Several frames in flight: one is drawn while others are encoded.

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::{Backend, Frame, OnViewDone, Target};
use wildcity_scene::{RenderProfile, Scene};

use crate::gpu::gpu_on;
use crate::images::render_one;
use crate::streets::{street, turning_views};

const TIMEOUT: Duration = Duration::from_secs(20);

/// Renders the first view to 8-bit colour.
fn draw(gpu: &Gpu, scene: &Scene, finished: OnViewDone<'_>) -> Vec<u8> {
    let profile = RenderProfile::default();
    let views = &turning_views()[..1];
    let mut image = vec![77; 3 * views[0].camera.pixels()];
    let target = Target { rgb8: Some(&mut image), ..Target::default() };
    gpu.render(&Frame { scene, profile: &profile, views }, &mut [target], finished).unwrap();
    image
}

#[test]
fn a_frame_is_drawn_while_another_is_encoded() {
    // The encoder of the first frame waits until as many other frames as the backend allows are
    // drawn.
    let gpu = gpu_on(&AdapterChoice::Best, 1);
    let beside = gpu.frames_in_flight() - 1;
    assert!(beside > 0);
    let gpu = gpu_on(&AdapterChoice::Best, gpu.frames_in_flight());
    let scene = Scene::from_gaussians(&street(5_000, 1, 51));
    let alone = render_one(&gpu, &scene, &RenderProfile::default(), turning_views()[0]).rgb8;
    let (encoding, is_encoding) = mpsc::channel();
    let (drawn, all_drawn) = mpsc::channel();
    thread::scope(|scope| {
        let all_drawn = std::sync::Mutex::new(all_drawn);
        let gpu = &gpu;
        let scene = &scene;
        let alone = &alone;
        let first = scope.spawn(move || {
            draw(gpu, scene, &|_, _| {
                encoding.send(()).unwrap();
                for _ in 0..beside {
                    all_drawn.lock().unwrap().recv_timeout(TIMEOUT).expect("another frame");
                }
            })
        });
        is_encoding.recv_timeout(TIMEOUT).unwrap();
        for _ in 0..beside {
            let drawn = drawn.clone();
            scope.spawn(move || {
                assert!(draw(gpu, scene, &|_, _| {}) == *alone);
                drawn.send(()).unwrap();
            });
        }
        assert!(first.join().unwrap() == *alone);
    });
}

/// A thread of a pool that waits takes up other work of the pool. With more callers than threads,
/// this must not end in a deadlock.
#[test]
fn many_callers_with_few_threads_do_not_deadlock() {
    let gpu = gpu_on(&AdapterChoice::Best, 1);
    let scene = Scene::from_gaussians(&street(5_000, 1, 52));
    let alone = draw(&gpu, &scene, &|_, _| {});
    let (done, all_done) = mpsc::channel();
    thread::scope(|scope| {
        for _ in 0..8 {
            let (gpu, scene, alone, done) = (&gpu, &scene, &alone, done.clone());
            scope.spawn(move || {
                for _ in 0..10 {
                    assert!(draw(gpu, scene, &|_, _| {}) == *alone);
                }
                done.send(()).unwrap();
            });
        }
        for _ in 0..8 {
            all_done.recv_timeout(3 * TIMEOUT).expect("the callers are deadlocked");
        }
    });
}

/// The buffers are too small for one of two frames that are drawn at the same time, or for both.
#[test]
fn a_frame_that_overflows_beside_another() {
    let scenes = [5_000, 150_000].map(|n| Scene::from_gaussians(&street(n, 1, 53)));
    let alone = [0, 1].map(|k| draw(&gpu_on(&AdapterChoice::Best, 2), &scenes[k], &|_, _| {}));
    let gpu = gpu_on(&AdapterChoice::Best, 2);
    thread::scope(|scope| {
        for thread in 0..4 {
            let (gpu, scenes, alone) = (&gpu, &scenes, &alone);
            scope.spawn(move || {
                for turn in 0..3 {
                    let k = (thread + turn) % 2;
                    assert!(draw(gpu, &scenes[k], &|_, _| {}) == alone[k], "{thread}, {turn}");
                }
            });
        }
    });
    assert!(gpu.usage().unwrap().retries > 0, "no frame overflowed");
}
