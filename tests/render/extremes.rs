//! The stress table on the cpu backend and on the definition, and that its bounds can be missed.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use glam::{DQuat, DVec3};
use wildcity::geometry::Pose;
use wildcity::geometry::camera::Lens;
use wildcity::render::cpu::Cpu;
use wildcity::render::reference::Reference;
use wildcity::render::{Backend, Finished, Frame, FrameStats, RenderError, Target, View};
use wildcity::report::drawing::{crop, cut, draw};
use wildcity::report::recorded::recorded;
use wildcity::report::stress::blobs::{Blob, ahead, scene};
use wildcity::report::stress::{CASES, Case, Verdict};
use wildcity::scene::{Record, RenderProfile, Scene};

use crate::images::{agree, cpu, render_one};

fn case(number: &str) -> &'static Case {
    CASES.iter().find(|case| case.number == number).unwrap()
}

/// Makes sure that every case holds, but for those that take gigabytes.
fn all_hold(backend: &dyn Backend) {
    let outcomes = CASES.iter().map(|case| case.run(backend, false));
    let wrong = outcomes.filter(|outcome| match outcome.verdict {
        Verdict::Held => outcome.checks == 0 || outcome.strain > 1.0,
        Verdict::NotRun => !NOT_RUN.contains(&outcome.case),
        Verdict::Missed => true,
    });
    let wrong: Vec<_> = wrong.collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// What takes gigabytes.
const NOT_RUN: &[&str] = &["T21"];

#[test]
fn the_table_holds_on_the_cpu_backend() {
    all_hold(&cpu());
}

#[test]
fn the_table_holds_on_the_definition() {
    all_hold(&Reference);
}

#[test]
fn cases_are_numbered_in_order() {
    for (index, case) in CASES.iter().enumerate() {
        assert_eq!(case.number, format!("T{}", index + 1));
    }
}

#[test]
#[ignore = "gigabytes of memory and a minute: cargo test --release --test render t21 -- --ignored"]
fn t21_seventy_million_sort_keys() {
    let outcome = case("T21").run(&cpu(), true);
    assert_eq!(outcome.verdict, Verdict::Held, "{outcome:?}");
}

/// The cpu backend, and what goes wrong with it.
struct Faulty {
    cpu: Cpu,
    fault: Fault,
    /// Drawings so far.
    count: AtomicU32,
}

/// Faults of the kinds that renderers had.
#[derive(Clone, Copy, Debug)]
enum Fault {
    /// Everything is culled.
    Culled,
    /// Thin things are a little wider.
    Blur,
    /// What is nearer than near is drawn.
    Near,
    /// What is behind is drawn as if it were ahead.
    Mirror,
    /// Drawings differ by an ulp or two in one value.
    Restless,
    /// Every other drawing is darker by a hundredth.
    Flicker,
    /// Another cap, and another stop.
    Rules,
    /// Centres are off by what 20 bits of a cell tell, so that neighbours change places in depth.
    Places,
    /// The pose is taken in f32.
    PoseF32,
    /// The slope clamp is that of an image twice as wide.
    Clamp,
    /// The principal point is taken to be in the middle.
    Centred,
    /// The last pixel of the image is never written.
    Unwritten,
    /// The background is not black.
    Background,
    /// What a lens does not see is drawn.
    Unmasked,
    /// All rows are exposed at once.
    Global,
    /// A lens is taken for its pinhole.
    Straight,
}

impl Backend for Faulty {
    fn name(&self) -> &'static str {
        "faulty"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
    ) -> Result<FrameStats, RenderError> {
        let count = self.count.fetch_add(1, Relaxed);
        let (mut scene, mut profile) = (frame.scene.clone(), *frame.profile);
        let mut views = frame.views.to_vec();
        match self.fault {
            Fault::Culled => scene = Scene::default(),
            Fault::Blur => profile.blur *= 1.2,
            Fault::Near => profile.near *= 0.5,
            Fault::Rules => (profile.alpha_cap, profile.stop) = (0.995, 2.0 * profile.stop),
            Fault::Places => scene = recorded(&scene, Record::Q24).scene,
            Fault::Mirror => views.iter_mut().for_each(|view| {
                let turned = DQuat::from_rotation_y(std::f64::consts::PI);
                view.world_from_camera.rotation *= turned;
            }),
            Fault::Centred => views.iter_mut().for_each(|view| {
                let camera = &mut view.camera;
                camera.pinhole.cx = 0.5 * f64::from(camera.width_px);
                camera.pinhole.cy = 0.5 * f64::from(camera.height_px);
            }),
            Fault::PoseF32 => views.iter_mut().for_each(|view| {
                let position_m = &mut view.world_from_camera.position_m;
                *position_m = position_m.as_vec3().as_dvec3();
            }),
            Fault::Straight => views.iter_mut().for_each(|view| view.camera.lens = Lens::Pinhole),
            Fault::Global => views.iter_mut().for_each(|view| view.rolling = None),
            _ => {}
        }
        if let Fault::Clamp = self.fault {
            let [view] = views[..] else { panic!("one view") };
            let [width, height] = [view.camera.width_px, view.camera.height_px];
            let wide = crop(view, [-(width as i32), 0], [3 * width, height]);
            let drawing = draw(&self.cpu, &scene, &profile, &[wide])?.remove(0);
            let rgba = cut(&drawing, 3 * width, [width, 0], [width, height]);
            self.cpu.render(frame, targets, finished)?;
            targets[0].rgba.as_mut().unwrap().copy_from_slice(&rgba);
            return Ok(FrameStats::default());
        }
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let stats = self.cpu.render(&frame, targets, finished)?;
        for target in targets {
            let (Some(rgba), Some(opacity)) = (&mut target.rgba, &mut target.opacity) else {
                panic!("every output is asked for")
            };
            let middle = rgba.len() / 2;
            match self.fault {
                Fault::Restless => rgba[middle] += f32::EPSILON * (count % 3) as f32,
                Fault::Flicker if count % 2 == 1 => {
                    rgba.iter_mut().for_each(|v| *v = 0.99 * *v - 1e-3)
                }
                Fault::Background => rgba[middle] += 2e-3,
                Fault::Unmasked => opacity.iter_mut().for_each(|o| *o = o.max(0.01)),
                Fault::Unwritten => {
                    *rgba.last_mut().unwrap() = f32::NAN;
                    *opacity.last_mut().unwrap() = f32::NAN;
                }
                _ => {}
            }
        }
        Ok(stats)
    }
}

/// A bound that cannot be missed proves nothing.
#[test]
fn every_bound_can_be_missed() {
    use Fault::{
        Background, Blur, Centred, Clamp, Culled, Flicker, Global, Mirror, Near, Places, PoseF32,
        Restless, Rules, Straight, Unmasked, Unwritten,
    };
    let planted: [(&str, &[Fault]); 28] = [
        ("T1", &[Culled, Blur]),
        ("T2", &[Clamp]),
        ("T3", &[Culled, Flicker]),
        ("T4", &[Near]),
        ("T5", &[Mirror]),
        ("T6", &[Restless]),
        ("T7", &[Culled, Places]),
        ("T8", &[Flicker]),
        ("T9", &[PoseF32]),
        ("T10", &[Flicker]),
        ("T11", &[Rules]),
        ("T12", &[Culled, Flicker]),
        ("T13", &[Blur]),
        ("T14", &[Restless]),
        ("T15", &[Restless]),
        ("T16", &[Background, Unwritten]),
        ("T17", &[Unwritten]),
        ("T18", &[Centred]),
        ("T19", &[Rules]),
        ("T20", &[Places]),
        ("T22", &[Straight]),
        ("T23", &[Mirror, Unmasked]),
        ("T24", &[Global]),
        ("T25", &[Mirror, Flicker]),
        ("T26", &[Culled]),
        ("T27", &[Places]),
        ("T28", &[Culled]),
        ("T28", &[Unwritten]),
    ];
    let mut faulty = Faulty { cpu: cpu(), fault: Fault::Culled, count: AtomicU32::new(0) };
    for (number, faults) in planted {
        for &fault in faults {
            faulty.fault = fault;
            let outcome = case(number).run(&faulty, false);
            assert_eq!(outcome.verdict, Verdict::Missed, "{fault:?} went unnoticed: {outcome:?}");
        }
    }
    for case in CASES.iter().filter(|case| !NOT_RUN.contains(&case.number)) {
        let is_planted = planted.iter().any(|(number, _)| *number == case.number);
        assert!(is_planted, "{} has no fault", case.number);
    }
}

#[test]
fn too_much_is_refused_and_the_next_frame_is_right() {
    // 400,000 tiles of an 10,240 px square times 340 walls are beyond 2^27 pairs.
    let wall = || Blob { sigma_m: DVec3::splat(1e3), opacity: 0.01, ..Blob::default() };
    let walls: Vec<Blob> = (0..340).map(|_| wall()).collect();
    let (backend, profile) = (cpu(), RenderProfile::default());
    let view = ahead([10_240, 10_240], 300.0);
    let small = ahead([64, 48], 50.0);
    let walls = scene(&walls);
    let fresh = render_one(&backend, &walls, &profile, small);
    let mut opacity = vec![7.0; view.camera.pixels()];
    let target = Target { opacity: Some(&mut opacity), ..Target::default() };
    let frame = Frame { scene: &walls, profile: &profile, views: &[view] };
    let refused = backend.render(&frame, &mut [target], &|_, _| {}).unwrap_err();
    assert!(matches!(refused, RenderError::TooMany { .. }), "{refused}");
    assert!(opacity.iter().all(|&o| o == 7.0), "nothing was written");
    assert!(render_one(&backend, &walls, &profile, small) == fresh);
}

#[test]
fn a_pose_turns_and_moves_the_image() {
    // A blob ahead of a camera that looks along +x lies in the middle of its image.
    let east = Pose {
        position_m: DVec3::new(3.0, 0.0, 0.0),
        rotation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
    };
    let view = View { world_from_camera: east, ..ahead([65, 65], 100.0) };
    let blob = scene(&[Blob { mean_m: DVec3::new(8.0, 0.0, 0.0), ..Blob::default() }]);
    let profile = RenderProfile::default();
    let image = render_one(&cpu(), &blob, &profile, view);
    agree(&image, &render_one(&Reference, &blob, &profile, view)).unwrap();
    let brightest = image.opacity.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
    assert_eq!(brightest, 32 * 65 + 32);
    assert!((image.depth_m[brightest] - 5.0).abs() < 1e-4);
}
