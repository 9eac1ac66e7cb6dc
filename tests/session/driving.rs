//! Sessions that drive through the engine: with a small memory budget, and with sections that
//! cannot be read.

use std::sync::Arc;
use std::time::Duration;

use glam::{DQuat, DVec3};
use wildcity_render::cpu::Cpu;
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice, Start};
use wildcity_session::{Engine, EngineSettings, Observation, Scenarios, Session, SessionError};
use wildcity_twin::residency::{Cache, ResidencyError, Resident, SectionRef};

use crate::source::{Fault, Faulty, Place};
use crate::streaming::{PROFILE, demo, eyes, unlimited, views};

/// An engine with its own directory of episodes.
pub(crate) struct Bench {
    pub(crate) engine: Arc<Engine>,
    pub(crate) episodes: tempfile::TempDir,
}

pub(crate) fn bench(cache: Cache) -> Bench {
    bench_with(cache, Arc::new(ForSections(crate::images::cpu())))
}

/// The cpu backend without memory for intermediate buffers, so that small limits apply only to
/// sections. Buffers hold other values before it writes them.
struct ForSections(Cpu);

impl Backend for ForSections {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn detail(&self) -> String {
        self.0.detail()
    }

    fn threads(&self) -> usize {
        self.0.threads()
    }

    fn renders_beside(&self) -> bool {
        self.0.renders_beside()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        // A value that is not written would show.
        for Target { rgb8, depth_m, opacity, normals, instances, semantics, .. } in &mut *targets {
            rgb8.iter_mut().for_each(|image| image.fill(77));
            let maps = [depth_m, opacity, normals].into_iter().flatten();
            maps.for_each(|map| map.fill(f32::NAN));
            instances.iter_mut().for_each(|image| image.fill(77));
            semantics.iter_mut().for_each(|image| image.fill(77));
        }
        self.0.render(frame, targets, finished)
    }
}

pub(crate) fn bench_with(cache: Cache, backend: Arc<dyn wildcity_render::Backend>) -> Bench {
    open_bench(cache, backend, Scenarios::in_dir(""))
}

pub(crate) fn open_bench(
    cache: Cache,
    backend: Arc<dyn wildcity_render::Backend>,
    scenarios: Scenarios,
) -> Bench {
    let episodes = tempfile::tempdir().unwrap();
    let engine = Engine::start(EngineSettings {
        cache,
        episodes: episodes.path().to_owned(),
        scenarios,
        backend,
        step_timeout: wildcity_session::limits::STEP_TIMEOUT,
        repairs: Arc::default(),
        mcap: false,
    });
    Bench { engine: engine.unwrap(), episodes }
}

/// The two cameras of the other tests, as a rig.
pub(crate) fn rig() -> Rig {
    let cameras = views(Pose::IDENTITY).into_iter().zip(["front", "left"]);
    let camera = |(view, name): (wildcity_render::View, &str)| {
        RigCamera::new(name, view.camera, view.world_from_camera)
    };
    Rig::new("pair", cameras.map(camera).collect())
}

impl Bench {
    async fn session(
        &self,
        name: &str,
        deadline: Option<Duration>,
    ) -> Result<Session, SessionError> {
        let options = Open {
            start: Some(Start::from(demo().at(0.0))),
            rig: Some(RigChoice::Full(rig().into())),
            deadline_ms: deadline.map(|deadline| deadline.as_millis() as u64),
            outputs: Outputs::colour(Encoding::Raw),
            ..Open::twin("demo")
        };
        Session::open(self.engine.clone(), name.to_owned(), options).await
    }
}

/// Hashes of a frame's images.
fn hashes(frame: &Observation) -> Vec<blake3::Hash> {
    frame.images.iter().map(|image| image.hash).collect()
}

/// A section that frames from 250 m on need, and earlier ones do not.
fn later_section() -> Place {
    let resident = unlimited().open("demo", None).unwrap();
    let at = |station_m| resident.demand(&eyes(&views(demo().at(station_m))), &PROFILE);
    let early: Vec<SectionRef> = (0..25).flat_map(|k| at(10.0 * f64::from(k))).collect();
    let only_late: Vec<_> = at(250.0).into_iter().filter(|n| !early.contains(n)).collect();
    place(&resident, only_late[0])
}

fn place(resident: &Resident, SectionRef { chunk, section }: SectionRef) -> Place {
    let chunk = &resident.version.manifest.chunks[chunk];
    (chunk.cell, chunk.sections[section].block, chunk.sections[section].level)
}

#[tokio::test(flavor = "multi_thread")]
async fn at_thirty_metres_a_second_no_frame_waits_after_the_first_seconds() {
    let all = unlimited().open("demo", None).unwrap();
    let lens = wildcity_twin::residency::RigExtent {
        views: 2,
        focal_px: 70.0,
        least_focal_px: 40.0,
        radius_m: 1.7,
    };
    let limit_bytes = all.worst_case_bytes(lens) * 3 / 2;
    assert!(limit_bytes < all.total_bytes() / 2, "otherwise all of it would fit");
    let bench = bench(Cache::limited(demo().catalog(), Some(limit_bytes)));
    let mut session = bench.session("a", None).await.unwrap();
    let mut waited = Vec::new();
    for step in 0..180 {
        // The agent takes 25 ms for a step of 0.1 s, so that it drives at 120 m/s in real time.
        tokio::time::sleep(Duration::from_millis(25)).await;
        let frame = session.step(demo().at(3.0 * f64::from(step)), false).await.unwrap();
        assert!(frame.residency.held_bytes <= limit_bytes);
        assert_eq!(frame.residency.limit_bytes, limit_bytes);
        waited.push(frame.residency.waited_for);
    }
    assert!(waited[20..].iter().all(|&sections| sections == 0), "{waited:?}");
    let stats = bench.engine.residency();
    assert!(stats.evictions > 0, "{stats:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hint_is_loaded_before_the_ego_is_there() {
    let source = Arc::new(Faulty::new(demo().catalog()));
    let bench = bench(Cache::with_source(demo().catalog(), source.clone(), None));
    let mut session = bench.session("a", None).await.unwrap();
    session.reset(0, None).await.unwrap();
    let there = demo().at(400.0);
    session.prefetch(vec![there]).unwrap();
    let began = std::time::Instant::now();
    let resident = session.resident().clone();
    // Wait until all of it was requested and has been loaded; a jump there must then wait for
    // nothing.
    let needed = resident.demand(&eyes(&views(there)), &PROFILE);
    let begun = || needed.iter().all(|&one| source.reads(place(&resident, one)) > 0);
    while !begun() || resident.stats().loads < source.all_reads() {
        assert!(began.elapsed() < crate::streaming::TEST_TIMEOUT);
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let frame = session.step(there, false).await.unwrap();
    assert_eq!(frame.residency.waited_for, 0);
    let frame = session.step(demo().at(550.0), false).await.unwrap();
    assert!(frame.residency.waited_for > 0 && !frame.residency.waited.is_zero());
    let far = Pose { position_m: DVec3::ZERO, rotation: DQuat::IDENTITY };
    for count in [0, wildcity_session::limits::PREFETCH_POSES + 1] {
        let refused = session.prefetch(vec![far; count]).unwrap_err();
        assert!(matches!(refused, SessionError::OutOfRange { field: "poses", .. }), "{refused}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_section_that_breaks_stops_its_session_until_it_is_healed() {
    let truth = bench(unlimited());
    let mut healthy = truth.session("healthy", None).await.unwrap();
    for fault in [Fault::Damaged, Fault::Hangs] {
        let source = Arc::new(Faulty::new(demo().catalog()));
        source.break_section(later_section(), fault);
        let bench = bench(Cache::with_source(demo().catalog(), source.clone(), None));
        let deadline = Some(Duration::from_millis(600));
        let mut driver = bench.session("driver", deadline).await.unwrap();
        let mut other = bench.session("other", deadline).await.unwrap();
        let mut stopped_at = None;
        for step in 0..40_u32 {
            let pose = demo().at(10.0 * f64::from(step));
            match driver.step(pose, false).await {
                Ok(frame) => {
                    let wanted = healthy.observe(vec![pose]).await.unwrap();
                    assert_eq!(hashes(&frame), hashes(&wanted), "step {step}");
                }
                Err(error) => {
                    match (fault, error) {
                        (Fault::Damaged, SessionError::Residency(error)) => {
                            assert!(matches!(error, ResidencyError::Load { .. }), "{error}");
                        }
                        (_, SessionError::Residency(error)) => {
                            assert!(matches!(error, ResidencyError::TimedOut { .. }), "{error}");
                        }
                        (_, error) => panic!("{error}"),
                    }
                    stopped_at = Some(step);
                    break;
                }
            }
        }
        // The failed step has not happened, and other sessions drive on.
        let stopped_at = stopped_at.expect("the section was never needed");
        assert_eq!(driver.episode().step(), u64::from(stopped_at));
        other.step(demo().at(0.0), false).await.unwrap();
        source.heal();
        for step in stopped_at..40 {
            let pose = demo().at(10.0 * f64::from(step));
            let frame = driver.step(pose, false).await.unwrap();
            let wanted = healthy.observe(vec![pose]).await.unwrap();
            assert_eq!(hashes(&frame), hashes(&wanted), "step {step}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_that_waits_for_a_disk_does_not_delay_other_sessions() {
    let source = Arc::new(Faulty::new(demo().catalog()));
    let place = later_section();
    source.break_section(place, Fault::Hangs);
    let bench = bench(Cache::with_source(demo().catalog(), source.clone(), None));
    let mut waiting = bench.session("waiting", None).await.unwrap();
    let mut other = bench.session("other", None).await.unwrap();
    let stuck = tokio::spawn(async move { waiting.step(demo().at(250.0), false).await.map(drop) });
    tokio::task::block_in_place(|| source.await_read(place));
    for step in 0..5 {
        other.step(demo().at(f64::from(step)), false).await.unwrap();
    }
    assert!(!stuck.is_finished());
    source.heal();
    stuck.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_preload_takes_no_memory_from_a_session_that_drives() {
    let all = unlimited().open("demo", None).unwrap();
    let probe = bench(unlimited());
    let limit_bytes = probe.session("probe", None).await.unwrap().reserved_bytes();
    let source = Arc::new(Faulty::new(demo().catalog()));
    let bench = bench(Cache::with_source(demo().catalog(), source.clone(), Some(limit_bytes)));
    let mut driver = bench.session("driver", None).await.unwrap();
    for station_m in [0.0, 3.0, 6.0] {
        driver.step(demo().at(station_m), false).await.unwrap();
    }
    let far = (0..8).map(|k| eyes(&views(demo().at(250.0 + 40.0 * f64::from(k))))).collect();
    assert!(crate::streaming::need_bytes(&all, demo().at(250.0)) > limit_bytes / 4);
    bench.engine.preload("demo", 1, far).await.unwrap();
    let frame = driver.observe(vec![demo().at(6.0)]).await.unwrap();
    assert_eq!(frame.residency.waited_for, 0);

    // Nor does it delay frames while a section does not arrive.
    source.break_section(later_section(), Fault::Hangs);
    let engine = bench.engine.clone();
    let far = vec![eyes(&views(demo().at(250.0)))];
    let preloading = tokio::spawn(async move { engine.preload("demo", 1, far).await });
    for station_m in [9.0, 20.0, 40.0] {
        driver.step(demo().at(station_m), false).await.unwrap();
    }
    source.heal();
    preloading.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_does_not_fit_is_refused_until_another_closes() {
    let all = unlimited().open("demo", None).unwrap();
    let probe = bench(unlimited());
    let reserved_bytes = probe.session("probe", None).await.unwrap().reserved_bytes();
    assert!(2 * reserved_bytes < all.total_bytes());
    // The renderer's intermediate buffers count once.
    let bench = bench(Cache::limited(demo().catalog(), Some(reserved_bytes * 11 / 10)));
    let first = bench.session("first", None).await.unwrap();
    let refused = bench.session("second", None).await.unwrap_err();
    assert!(refused.to_string().contains(&reserved_bytes.to_string()), "{refused}");
    first.close(wildcity_session::Outcome::Completed).await;
    bench.session("second", None).await.unwrap();
}

/// A budget without room for all views of a frame at once: the frame is drawn view by view, with
/// the same images.
#[tokio::test(flavor = "multi_thread")]
async fn a_frame_is_drawn_in_parts_before_its_session_is_refused() {
    let truth = bench(unlimited());
    let mut whole = truth.session("whole", None).await.unwrap();
    assert_eq!(whole.reservation().views_at_once(), wildcity_twin::residency::Viewpoint::MAX);
    let limit_bytes = whole.reserved_bytes() - 1;
    let bench = bench(Cache::limited(demo().catalog(), Some(limit_bytes)));
    let mut session = bench.session("parts", None).await.unwrap();
    assert_eq!(session.reservation().views_at_once(), 1);
    assert!(session.reserved_bytes() < limit_bytes);
    for step in 0..6 {
        let pose = demo().at(60.0 * f64::from(step));
        let frame = session.step(pose, false).await.unwrap();
        let wanted = whole.step(pose, false).await.unwrap();
        assert_eq!(hashes(&frame), hashes(&wanted), "step {step}");
        assert!(frame.residency.held_bytes <= limit_bytes);
    }
    // There is a limit below which no view fits.
    drop(session);
    let by_view_bytes = bench.session("again", None).await.unwrap().reserved_bytes();
    let less = crate::driving::bench(Cache::limited(demo().catalog(), Some(by_view_bytes - 1)));
    let refused = less.session("refused", None).await.unwrap_err();
    assert!(refused.to_string().contains(&by_view_bytes.to_string()), "{refused}");
}

/// The renderer's intermediate buffers stay within the reserved memory, whose size the budget
/// determines.
#[tokio::test(flavor = "multi_thread")]
async fn a_session_reserves_what_its_frames_hold() {
    let mut reserved = Vec::new();
    for limit_bytes in [1 << 29, 1 << 30] {
        let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
        let backend = Arc::new(crate::images::cpu());
        let bench = bench_with(cache, backend.clone());
        let session = bench.session("a", None).await.unwrap();
        let frame = session.reservation().frame();
        let views = views(demo().at(0.0));
        assert!(frame.stages >= backend.frame_bytes(&views, &PROFILE), "{frame:?}");
        assert!(frame.images > 0 && frame.stages > limit_bytes / 8, "{frame:?}");
        assert!(frame.alone() + session.reservation().scene_bytes() == session.reserved_bytes());
        assert_eq!(session.reserved_bytes(), bench.engine.residency().reserved_bytes);
        reserved.push(frame.stages);
    }
    assert_eq!(reserved[1] - reserved[0], (1 << 29) / 8, "an eighth of the budget");
}
