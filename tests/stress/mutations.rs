//! The stress cases on the cpu backend and on the reference backend, and mutations: faulty backends
//! with which each check must fail.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, OnceLock};

use glam::{DQuat, DVec3};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::compare::images::{crop_rgba, crop_view, render_images};
use wildcity_render::cpu::Cpu;
use wildcity_render::gradient::{Differentiate, GradientError, Gradients, LossGradient};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};
use wildcity_scene::chunk::{ActivatedGaussian, column, columns};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::Lens;
use wildcity_scene::record::round_trip;
use wildcity_scene::{Chunk, RecordFormat, RenderProfile, Scene};
use wildcity_stress::table::{self, Candidate};
use wildcity_stress::{CASES, Case, Check, Verdict};

use crate::images::{agree, cpu, render_one};

fn case(number: &str) -> &'static Case {
    CASES.iter().find(|case| case.number == number).unwrap()
}

/// The checks of all cases on a backend, except for those that take gigabytes.
type Checked = Vec<(&'static str, Vec<Check>)>;

fn checked(backend: &dyn Backend) -> Checked {
    let cases = CASES.iter().filter(|case| !NOT_RUN.contains(&case.number));
    cases.map(|case| (case.number, case.checks(backend).unwrap())).collect()
}

/// The checks on the cpu backend, made once for all tests.
fn checked_on_cpu() -> &'static Checked {
    static CHECKED: OnceLock<Checked> = OnceLock::new();
    CHECKED.get_or_init(|| checked(&cpu()))
}

/// The checks on the reference backend, made once for all tests.
fn checked_on_reference() -> &'static Checked {
    static CHECKED: OnceLock<Checked> = OnceLock::new();
    CHECKED.get_or_init(|| checked(&Reference))
}

/// Asserts that every case holds, except for those that take gigabytes. `device.rs` asserts the
/// outcomes of cases.
fn all_hold(backend: &dyn Backend, checked: &Checked) {
    let wrong = checked.iter().filter(|(_, checks)| {
        checks.is_empty() || checks.iter().any(|c| !c.holds() || c.bound_usage() > 1.0)
    });
    let wrong: Vec<_> = wrong.collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
    for number in NOT_RUN {
        assert_eq!(case(number).run(backend, false).verdict, Verdict::NotRun);
    }
    assert_eq!(checked.len() + NOT_RUN.len(), CASES.len());
}

/// Cases that take gigabytes.
const NOT_RUN: &[&str] = &["T21"];

#[test]
fn the_table_holds_on_the_cpu_backend() {
    all_hold(&cpu(), checked_on_cpu());
}

#[test]
fn the_table_holds_on_the_reference() {
    all_hold(&Reference, checked_on_reference());
}

#[test]
fn cases_are_numbered_in_order() {
    for (index, case) in CASES.iter().enumerate() {
        assert_eq!(case.number, format!("T{}", index + 1));
    }
}

#[test]
#[ignore = "gigabytes of memory and a minute: cargo test -p wildcity-stress --test stress t21 -- --ignored"]
fn t21_seventy_million_sort_keys() {
    let outcome = case("T21").run(&cpu(), true);
    assert_eq!(outcome.verdict, Verdict::Held, "{outcome:?}");
}

/// A backend with a mutation.
struct MutatedBackend<'a> {
    inner: &'a dyn Backend,
    mutation: Mutation,
    /// Frames rendered so far.
    count: AtomicU32,
}

/// Faults of the kinds that renderers have had.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mutation {
    /// Everything is culled.
    Culled,
    /// The blur is larger by a fifth, so that thin splats are wider.
    MoreBlur,
    /// Gaussians nearer than near are drawn.
    HalfNear,
    /// Gaussians behind the camera are drawn as if they were ahead.
    Mirror,
    /// Gaussians beyond a lens' fold are drawn where the polynomial puts them.
    Folded,
    /// At equal depths the higher id is in front.
    Reversed,
    /// Images differ by an ulp or two in one value.
    Nondeterministic,
    /// Every other image is darker by a hundredth.
    Flicker,
    /// All images are darker and less opaque by a twentieth.
    Paler,
    /// The cap and the stop are different.
    CapAndStop,
    /// Centres are quantized to 20 bits of a cell, so that neighbours change their depth order.
    CoarseCentres,
    /// The camera's position is rounded to f32.
    PoseF32,
    /// The slope clamp is that of an image twice as wide.
    OtherClamp,
    /// The principal point is in the middle of the image.
    CentredPrincipalPoint,
    /// The last pixel of the image is never written.
    Unwritten,
    /// One value of the background is off by 2e-3.
    Background,
    /// One byte of the background is off by one.
    OneByte,
    /// Pixels outside of the lens' field have opacity.
    Unmasked,
    /// All rows are exposed at once, at the end of the exposure.
    GlobalShutter,
    /// The lens is replaced by its pinhole.
    NoLens,
    /// One (Gaussian, tile) pair more is counted.
    DuplicateInstance,
    /// An image below its native size is drawn with the blur of its own pixels.
    OwnBlur,
    /// Actors are not drawn.
    NoActors,
    /// Actors are drawn 2 cm off.
    ActorsOff,
    /// Actors stand still during the exposure.
    FrozenActors,
    /// Actors are drawn on top of everything, without the Gaussians that hide them.
    OnlyActors,
}

impl Backend for MutatedBackend<'_> {
    /// The name of the inner backend, since cases treat the reference backend differently.
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn as_differentiate(&self) -> Option<&dyn Differentiate> {
        Some(self)
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        let count = self.count.fetch_add(1, Relaxed);
        let (scene, profile, views) = self.mutated(frame);
        if let Mutation::OtherClamp = self.mutation {
            let [view] = views[..] else { panic!("one view") };
            let [width, height] = [view.camera.width_px, view.camera.height_px];
            let wide = crop_view(view, [-(width as i32), 0], [3 * width, height]);
            let drawing = render_images(self.inner, &scene, &profile, &[wide])?.remove(0);
            let rgba = crop_rgba(&drawing, 3 * width, [width, 0], [width, height]);
            self.inner.render(frame, targets, finished)?;
            targets[0].rgba.as_mut().unwrap().copy_from_slice(&rgba);
            return Ok(FrameStats::default());
        }
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let mut stats = self.inner.render(&frame, targets, finished)?;
        stats.instances += u64::from(matches!(self.mutation, Mutation::DuplicateInstance));
        for target in targets {
            let Target { rgba: Some(rgba), rgb8: Some(rgb8), opacity: Some(opacity), .. } = target
            else {
                continue;
            };
            let middle = rgba.len() / 2;
            let darken =
                |values: &mut [f32], share: f32| values.iter_mut().for_each(|v| *v *= share);
            match self.mutation {
                Mutation::Nondeterministic => rgba[middle] += f32::EPSILON * (count % 3) as f32,
                Mutation::Flicker if count % 2 == 1 => {
                    darken(opacity, 0.99);
                    rgba.iter_mut().for_each(|v| *v = 0.99 * *v - 1e-3);
                }
                Mutation::Paler => {
                    darken(rgba, 0.95);
                    darken(opacity, 0.95);
                }
                Mutation::Background => rgba[middle] += 2e-3,
                Mutation::OneByte => rgb8[0] ^= 1,
                Mutation::Unmasked => opacity.iter_mut().for_each(|o| *o = o.max(0.01)),
                Mutation::Unwritten => {
                    *rgba.last_mut().unwrap() = f32::NAN;
                    *opacity.last_mut().unwrap() = f32::NAN;
                }
                _ => {}
            }
        }
        Ok(stats)
    }
}

impl MutatedBackend<'_> {
    /// What the mutation makes of the input of a frame.
    fn mutated(&self, frame: &Frame<'_>) -> (Scene, RenderProfile, Vec<View>) {
        let mut scene = frame.scene.clone();
        let mut profile = *frame.profile;
        let mut views = frame.views.to_vec();
        match self.mutation {
            Mutation::Culled => scene = Scene::default(),
            Mutation::MoreBlur => profile.blur *= 1.2,
            Mutation::HalfNear => profile.near *= 0.5,
            Mutation::CapAndStop => (profile.alpha_cap, profile.stop) = (0.995, 2.0 * profile.stop),
            Mutation::CoarseCentres => scene = round_trip(&scene, RecordFormat::Q24).scene,
            Mutation::Mirror => views.iter_mut().for_each(|view| {
                let turned = DQuat::from_rotation_y(std::f64::consts::PI);
                view.world_from_camera.rotation *= turned;
            }),
            Mutation::Folded => {
                scene = views.iter_mut().fold(scene, |scene, view| folded(&scene, view))
            }
            Mutation::Reversed => scene = remade(&scene, &mut |_, rows| rows.reverse()),
            Mutation::CentredPrincipalPoint => views.iter_mut().for_each(|view| {
                let camera = &mut view.camera;
                camera.pinhole.cx = 0.5 * f64::from(camera.width_px);
                camera.pinhole.cy = 0.5 * f64::from(camera.height_px);
            }),
            Mutation::PoseF32 => views.iter_mut().for_each(|view| {
                let position_m = &mut view.world_from_camera.position_m;
                *position_m = position_m.as_vec3().as_dvec3();
            }),
            Mutation::NoLens => views.iter_mut().for_each(|view| view.camera.lens = Lens::Pinhole),
            Mutation::OwnBlur => {
                views.iter_mut().for_each(|view| view.camera.native_size_px = None)
            }
            Mutation::NoActors => scene.placed.clear(),
            Mutation::OnlyActors => scene.chunks.clear(),
            Mutation::ActorsOff => scene.placed.iter_mut().for_each(|placed| {
                placed.world_from_actor.position_m.x += 0.02;
                placed.world_from_actor_at_start.position_m.x += 0.02;
            }),
            Mutation::FrozenActors => scene.placed.iter_mut().for_each(|placed| {
                placed.world_from_actor_at_start = placed.world_from_actor;
            }),
            Mutation::GlobalShutter => {
                views.iter_mut().for_each(|view| view.rolling_shutter = None)
            }
            _ => {}
        }
        (scene, profile, views)
    }
}

impl Differentiate for MutatedBackend<'_> {
    fn differentiate(
        &self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
    ) -> Result<FrameStats, GradientError> {
        let inner = self.inner.as_differentiate().expect("a backend with gradients");
        let (scene, profile, views) = self.mutated(frame);
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let stats = inner.differentiate(&frame, depth, loss, gradients)?;
        if let Mutation::Unwritten = self.mutation {
            gradients.twists[0].rho.x = f64::NAN;
        }
        Ok(stats)
    }
}

/// The same scene after `edit`, which gets each chunk's origin in metres and a row of columns for
/// each Gaussian.
fn remade(scene: &Scene, edit: &mut dyn FnMut(DVec3, &mut Vec<Vec<f32>>)) -> Scene {
    let again = scene.chunks.iter().map(|chunk| {
        let width = columns(chunk.sh_degree());
        let row = |i| (0..width).map(|c| chunk.value(i, c)).collect::<Vec<f32>>();
        let mut rows: Vec<_> = (0..chunk.len()).map(row).collect();
        edit(chunk.origin_m(), &mut rows);
        let cell = chunk.cell();
        let origin_m = chunk.origin_m();
        let mut again = Chunk::new(cell, origin_m, chunk.sh_degree(), rows.len());
        for row in &rows {
            again.push_activated(&ActivatedGaussian {
                mean_m: row[column::MEAN..][..3].try_into().unwrap(),
                scale_m: row[column::SCALE..][..3].try_into().unwrap(),
                quat_wxyz: row[column::QUAT..][..4].try_into().unwrap(),
                log2_opacity: row[column::LOG2_OPACITY],
                sh: &row[column::SH..],
            });
        }
        Arc::new(again)
    });
    Scene { chunks: again.collect(), ..scene.clone() }
}

/// Moves Gaussians so that a pinhole draws them where an OpenCV lens' polynomial puts them, beyond
/// its fold too; and replaces the lens by the pinhole. For a camera at the origin that looks along
/// +z.
fn folded(scene: &Scene, view: &mut View) -> Scene {
    let Lens::OpenCv(lens) = view.camera.lens else { return scene.clone() };
    view.camera.lens = Lens::Pinhole;
    let [k1, k2, k3, ..] = lens.k();
    remade(scene, &mut |origin_m, rows| {
        for mean_m in rows.iter_mut().map(|row| &mut row[column::MEAN..][..3]) {
            let at_m = origin_m + DVec3::new(mean_m[0].into(), mean_m[1].into(), mean_m[2].into());
            let r2 = (at_m.truncate() / at_m.z).length_squared();
            let factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
            let moved_m = (factor * at_m.truncate()).extend(at_m.z) - origin_m;
            mean_m.copy_from_slice(&moved_m.as_vec3().to_array());
        }
    })
}

use Mutation::{
    ActorsOff, Background, CapAndStop, CentredPrincipalPoint, CoarseCentres, Culled,
    DuplicateInstance, Flicker, Folded, FrozenActors, GlobalShutter, HalfNear, Mirror, MoreBlur,
    NoActors, NoLens, Nondeterministic, OneByte, OnlyActors, OtherClamp, OwnBlur, Paler, PoseF32,
    Reversed, Unmasked, Unwritten,
};

/// Mutations for each case, and the checks that must fail with each, by a part of their text.
const MUTATIONS: &[(&str, Mutation, &[&str])] = &[
    ("T1", Culled, &[": seen"]),
    ("T1", MoreBlur, &["opacity off by"]),
    ("T1", Unmasked, &["the cut off by"]),
    ("T2", OtherClamp, &["as f64"]),
    ("T2", Culled, &["some reach into the image"]),
    ("T3", Culled, &["opacity from 0.9"]),
    ("T3", Flicker, &["as f64"]),
    ("T3", DuplicateInstance, &["in the list of each tile"]),
    ("T4", HalfNear, &["drawn as near says", "as f64"]),
    ("T5", Mirror, &["behind: opacity", "as f64"]),
    ("T5", Culled, &["inside: seen"]),
    ("T6", Reversed, &["the first of each pair is in front", "as f64"]),
    ("T6", Nondeterministic, &["100 images"]),
    ("T7", CoarseCentres, &["the nearer one is in front", "as f64"]),
    ("T8", Culled, &["it pops"]),
    ("T8", Paler, &["apart", "as f64"]),
    ("T9", Culled, &["something is seen"]),
    ("T9", PoseF32, &["off by"]),
    ("T10", Flicker, &["drawn: dB"]),
    ("T11", CapAndStop, &["off the cap by"]),
    ("T11", Unmasked, &[": opacity", "off 0 and 1/255 by"]),
    ("T11", Culled, &["above the logit of 1/255: seen"]),
    ("T11", Paler, &["as f64"]),
    ("T11", Flicker, &["monotone"]),
    ("T12", Culled, &["it is seen"]),
    ("T12", Flicker, &["neighbours off by", "as f64"]),
    ("T13", MoreBlur, &["as f64"]),
    ("T13", Paler, &["centre's opacity from 0.9"]),
    ("T14", Nondeterministic, &["20 images"]),
    ("T14", Paler, &["as f64"]),
    ("T15", Nondeterministic, &["the small frame after it", "and so has the large one"]),
    ("T15", Paler, &["as f64"]),
    ("T16", Background, &["every value is 0", "off the background by"]),
    ("T16", OneByte, &["every byte is the background's"]),
    ("T16", Unmasked, &["no opacity and no depth"]),
    ("T16", Culled, &["one: seen"]),
    ("T16", Unwritten, &["as f64", "is finite"]),
    ("T17", Culled, &["something is seen"]),
    ("T17", Unwritten, &["off by"]),
    ("T18", Culled, &[": seen"]),
    ("T18", CentredPrincipalPoint, &["off the whole by", "as f64"]),
    ("T19", CapAndStop, &["layers of 0.9", "layers of 1,", "as f64"]),
    ("T19", Paler, &["thin layers"]),
    ("T20", CoarseCentres, &["as f64"]),
    ("T22", NoLens, &["centre off by", "spread along x off", "spread along y off", "as f64"]),
    ("T22", NoLens, &["spread along xy off"]),
    ("T23", Mirror, &["nothing of what is behind"]),
    ("T23", Unmasked, &["pixels wrong about the lens' field"]),
    ("T23", NoLens, &["seen at 100°", "as f64"]),
    ("T23", Folded, &["opacity of what is mirrored"]),
    ("T23", Culled, &["within the fold: seen"]),
    ("T24", GlobalShutter, &["row by row: dB", "as f64"]),
    ("T25", Culled, &["seen"]),
    ("T25", Flicker, &["off by", "as f64"]),
    ("T26", Culled, &[": seen", "as f64"]),
    ("T27", CoarseCentres, &["as f64"]),
    ("T27", Culled, &["it is covered"]),
    ("T28", Paler, &["the fog lets through", "as f64"]),
    ("T29", NoActors, &["around the camera: the actor is seen", "1,000 m away: the actor is seen"]),
    ("T29", NoActors, &["overlapping: the actor is seen", "overlapping: as within the scene"]),
    ("T29", ActorsOff, &["around the camera: as within the scene", "1,000 m away: as within the"]),
    ("T29", ActorsOff, &["1,000 m away: as f64", "around the camera: as f64"]),
    ("T29", ActorsOff, &["overlapping: as f64"]),
    ("T29", OnlyActors, &["under the road: the actor is seen", "under the road: as within the"]),
    ("T29", OnlyActors, &["under the road: as f64"]),
    ("T30", FrozenActors, &["across: exact rays", "across: as f64", "along: as at rest"]),
    ("T30", FrozenActors, &["along: as f64"]),
    ("T31", OwnBlur, &["nearer to native by dB", "as f64"]),
    ("T32", Unwritten, &["every derivative is finite"]),
    ("T32", MoreBlur, &["off f64 by", "as f64 in direction"]),
];

/// The check that no mutation of a backend affects: the bound of the record format. In the unit
/// tests of `src/stress/places.rs` a coarser format fails it.
const OUT_OF_REACH: (&str, &str) = ("T10", "centres off by m");

/// Asserts that the listed checks fail with each mutation of a backend, and that no check is
/// without a mutation.
fn every_check_can_fail(backend: &dyn Backend, sound: &Checked) {
    let mut wrong = Vec::new();
    // The checks of the last case and its mutation: the table has some cases in several lines.
    let mut mutated_checks: Option<(&str, Mutation, Vec<Check>)> = None;
    for &(number, mutation, wanted) in MUTATIONS {
        let (_, sound) = sound.iter().find(|(case, _)| *case == number).unwrap();
        // The reference backend is not compared with itself, and so lacks some checks.
        let looked_at = |part: &str| sound.iter().any(|check| check.what.contains(part));
        let (wanted, stale): (Vec<&str>, Vec<&str>) =
            wanted.iter().partition(|part| looked_at(part));
        if backend.name() != Reference.name() {
            wrong.extend(
                stale.iter().map(|part| format!("{number} looks at nothing like {part:?}")),
            );
        }
        if wanted.is_empty() {
            continue;
        }
        let known =
            mutated_checks.take().filter(|(last, of, _)| (*last, *of) == (number, mutation));
        let checks = known.map(|(.., checks)| checks).unwrap_or_else(|| {
            let mutated = MutatedBackend { inner: backend, mutation, count: AtomicU32::new(0) };
            case(number).checks(&mutated).unwrap()
        });
        for part in wanted {
            let missed = checks.iter().any(|check| check.what.contains(part) && !check.holds());
            if !missed {
                let own = checks.iter().filter(|check| check.what.contains(part));
                let own: Vec<String> = own.take(4).map(Check::to_string).collect();
                wrong.push(format!("{number}: {mutation:?} goes unnoticed by {part:?}: {own:?}"));
            }
        }
        mutated_checks = Some((number, mutation, checks));
    }
    for (number, checks) in sound {
        let parts: Vec<&str> = MUTATIONS
            .iter()
            .filter(|(case, ..)| case == number)
            .flat_map(|(_, _, wanted)| wanted.iter().copied())
            .collect();
        for check in checks {
            // One line of code makes this check for all cases; T16 has the mutation.
            let has_mutation = parts.iter().any(|part| check.what.contains(part))
                || check.what.ends_with("every value is finite")
                || (*number == OUT_OF_REACH.0 && check.what == OUT_OF_REACH.1);
            if !has_mutation {
                wrong.push(format!("{number}: no mutation for {:?}", check.what));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// A check that cannot fail proves nothing.
#[test]
fn every_check_can_fail_on_the_cpu_backend() {
    every_check_can_fail(&cpu(), checked_on_cpu());
}

/// The same for the numbers that the reference backend must satisfy.
#[test]
fn every_check_can_fail_on_the_reference() {
    every_check_can_fail(&Reference, checked_on_reference());
}

/// As the table above, by the whole text of each check: no check of the cases of moving actors
/// holds under all of their mutations.
#[test]
fn every_check_of_moving_actors_fails_under_a_mutation() {
    let backend = cpu();
    // A comparison with f64 that fails says what is off, in place of its dB.
    let key = |what: &str| -> String {
        let end = what.find(": as f64").map_or(what.len(), |at| at + ": as f64".len());
        what[..end].to_owned()
    };
    for number in ["T29", "T30"] {
        let sound = case(number).checks(&backend).unwrap();
        assert!(sound.iter().all(Check::holds), "{number}: {sound:?}");
        // T16 checks that values are finite.
        let mut unfailed: Vec<&str> = sound.iter().map(|check| &*check.what).collect();
        unfailed.retain(|what| !what.ends_with("every value is finite"));
        assert!(unfailed.len() >= 4, "{number}: {unfailed:?}");
        for mutation in [NoActors, ActorsOff, FrozenActors, OnlyActors] {
            let mutated = MutatedBackend { inner: &backend, mutation, count: AtomicU32::new(0) };
            let checks = case(number).checks(&mutated).unwrap();
            let failed: Vec<&Check> = checks.iter().filter(|check| !check.holds()).collect();
            eprintln!("{number} {mutation:?}: {} of {} fail", failed.len(), checks.len());
            failed.iter().for_each(|check| eprintln!("    {check}"));
            unfailed.retain(|what| failed.iter().all(|check| key(&check.what) != key(what)));
        }
        assert!(unfailed.is_empty(), "{number}: nothing fails {unfailed:?}");
    }
}

/// A backend with a given name that fails every frame with a given error.
struct Refusing(&'static str, RenderError);

impl Backend for Refusing {
    fn name(&self) -> &'static str {
        self.0
    }

    fn render(
        &self,
        _: &Frame<'_>,
        _: &mut [Target<'_>],
        _: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        Err(self.1.clone())
    }
}

/// The cpu backend in the reference backend's place: it is faster, and keeps the same bounds.
struct InPlaceOfReference(Cpu);

impl Backend for InPlaceOfReference {
    fn name(&self) -> &'static str {
        Reference.name()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.0.render(frame, targets, finished)
    }
}

const TOO_MANY: RenderError = RenderError::TooMany { what: "splats", limit: 65_535 };

#[test]
fn a_refusal_is_a_limit_of_devices_alone_and_where_a_case_names_it() {
    let verdict = |number: &str, name, error| case(number).run(&Refusing(name, error), false);
    let refused = verdict("T28", "gpu", TOO_MANY);
    assert_eq!(refused.verdict, Verdict::Refused);
    assert!(refused.detail.contains("65535"), "{}", refused.detail);
    assert_eq!(verdict("T28", "cpu", TOO_MANY).verdict, Verdict::Missed);
    assert_eq!(verdict("T3", "gpu", TOO_MANY).verdict, Verdict::Missed);
    let lost = RenderError::Device { device: "a card".to_owned(), reason: "lost".to_owned() };
    assert_eq!(verdict("T28", "gpu", lost).verdict, Verdict::Missed);
}

#[test]
#[ignore = "gigabytes of memory: cargo test -p wildcity-stress --test stress t21 -- --ignored"]
fn t21_may_be_refused_by_a_device() {
    let run = |name| case("T21").run(&Refusing(name, TOO_MANY), true).verdict;
    assert_eq!(run("gpu"), Verdict::Refused);
    assert_eq!(run("cpu"), Verdict::Missed);
}

#[test]
fn the_table_says_what_was_refused_and_what_was_drawn_instead() {
    let backends: [Candidate; 2] =
        [Ok(Box::new(InPlaceOfReference(cpu()))), Ok(Box::new(Refusing("gpu", TOO_MANY)))];
    let table = table::run(&[case("T17"), case("T28")], &backends, false, &mut |_, _| {});
    let text = table.to_string();
    let line = |number: &str| text.lines().find(|line| line.starts_with(number)).unwrap();
    assert!(line("T17").starts_with("T17  held (1921 x 1081 px)  MISSED    "), "{text}");
    assert!(line("T28").starts_with("T28  held                   refused   "), "{text}");
    assert!(text.contains(&format!("gpu: {TOO_MANY}")), "{text}");
    assert!(text.ends_with("2 held, 1 refused, 1 missed, 0 not run\n"), "{text}");
}

#[test]
fn too_much_is_refused_and_the_next_frame_is_right() {
    // 400,000 tiles of an image of 10,240 x 10,240 px times 340 walls are more than 2^27 pairs.
    let wall =
        || GaussianSpec { sigma_m: DVec3::splat(1e3), opacity: 0.01, ..GaussianSpec::default() };
    let walls: Vec<GaussianSpec> = (0..340).map(|_| wall()).collect();
    let backend = cpu();
    let profile = RenderProfile::default();
    let view = forward_view([10_240, 10_240], 300.0);
    let small = forward_view([64, 48], 50.0);
    let walls = scene_from_specs(&walls);
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
    // A Gaussian ahead of a camera that looks along +x lies in the middle of its image.
    let east = Pose {
        position_m: DVec3::new(3.0, 0.0, 0.0),
        rotation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
    };
    let view = View { world_from_camera: east, ..forward_view([65, 65], 100.0) };
    let blob = scene_from_specs(&[GaussianSpec {
        mean_m: DVec3::new(8.0, 0.0, 0.0),
        ..GaussianSpec::default()
    }]);
    let profile = RenderProfile::default();
    let image = render_one(&cpu(), &blob, &profile, view);
    agree(&image, &render_one(&Reference, &blob, &profile, view)).unwrap();
    let brightest = image.opacity.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
    assert_eq!(brightest, 32 * 65 + 32);
    assert!((image.depth_m[brightest] - 5.0).abs() < 1e-4);
}
