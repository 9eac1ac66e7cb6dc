//! Every stage alone, on the buffers that the cpu backend left: gpu against cpu and against f64. Each
//! comparison must be able to fail, and to tell the stage that is wrong from those that are not.

use std::sync::LazyLock;

use wildcity_render::compare::psnr::MIN_PSNR_DB;
use wildcity_render::cpu::Cpu;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::hybrid::{HybridBackend, bisect};
use wildcity_render::layout::Cutoffs;
use wildcity_render::stage::{Stage, StageOutputs};
use wildcity_render::{Backend, Frame, RenderError, View};
use wildcity_scene::{RenderProfile, Scene};

use crate::cameras::bent_views;
use crate::definition::{self, Splat};
use crate::gpu::{gpu, gpu_with};
use crate::images::{Image, agree, cpu, render};
use crate::mutations::{LENS_MUTATIONS, MUTATIONS, misty_street, wide_views};
use crate::streets::{demo_street, street, street_views};

/// One frame, what the cpu backend makes of it, and what the definition makes of the same buffers.
struct Truth {
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
    /// What the cpu left after project, sort and bin.
    cpu: [StageOutputs; 3],
    images: Vec<Image>,
    /// By definition, in f64.
    splats: Vec<Splat>,
    /// Like all that follows, of the buffers that the cpu left.
    order: Vec<u32>,
    tiles: Vec<Vec<u32>>,
    pixels: Vec<Image>,
}

/// Seconds of asking every pixel about every splat, so once for all tests.
static TRUTH: LazyLock<Truth> = LazyLock::new(|| Truth::new(&cpu(), 12_000, wide_views()));

/// The same street through every lens, and by shutters that roll.
static BENT: LazyLock<Truth> = LazyLock::new(|| Truth::new(&cpu(), 8_000, bent_views()));

impl Truth {
    fn new(cpu: &Cpu, gaussians: usize, views: Vec<View>) -> Self {
        let scene = Scene::from_gaussians(&misty_street(gaussians));
        let profile = RenderProfile::default();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let stages = Stage::ALL.map(|stage| cpu.run_through(&frame, stage).unwrap().0);
        let of_cpu = definition::splats(&stages[0]);
        let order = definition::sort(&of_cpu);
        Self {
            images: render(cpu, &scene, &profile, &views),
            splats: definition::project(&frame),
            tiles: definition::bin(&of_cpu, &order, &frame),
            pixels: definition::rasterize(&of_cpu, &order, &frame),
            order,
            cpu: stages,
            scene,
            profile,
            views,
        }
    }

    fn frame(&self) -> Frame<'_> {
        Frame { scene: &self.scene, profile: &self.profile, views: &self.views }
    }

    /// The stages of a gpu that are wrong, by name, and what its twins on the cpu and in f64 object to.
    fn wrong(&self, gpu: &Gpu) -> Vec<(&'static str, Objections)> {
        let [project, sort, bin] = &self.cpu;
        let object = |done, last, objections: &dyn Fn(&StageOutputs) -> Objections| {
            match gpu.run_through(&self.frame(), done, last) {
                Ok(found) => objections(&found),
                // A stage that counts wrong may ask for more than there is.
                Err(error @ RenderError::TooMany { .. }) => {
                    [(); 2].map(|()| Some(error.to_string()))
                }
                Err(error) => panic!("{error}"),
            }
        };
        let all = [
            ("project", object(None, Stage::Project, &|found| self.object_to_project(found))),
            ("sort", object(Some(project), Stage::Sort, &|found| self.object_to_sort(found))),
            ("bin", object(Some(sort), Stage::Bin, &|found| self.object_to_bin(found))),
            ("rasterize", self.object_to_rasterize(&self.drawn(gpu, bin))),
        ];
        all.into_iter().filter(|(_, twins)| twins.iter().any(Option::is_some)).collect()
    }

    /// The images that a gpu makes of what was left after a stage.
    fn drawn(&self, gpu: &Gpu, between: &StageOutputs) -> Vec<Image> {
        render(&GoOn { gpu, between }, &self.scene, &self.profile, &self.views)
    }

    fn object_to_project(&self, found: &StageOutputs) -> Objections {
        let splats = definition::splats(found);
        let cpu = definition::splats(&self.cpu[0]);
        [&cpu, &self.splats].map(|truths| {
            let keys = check_keys(found, &Cutoffs::new(&self.profile));
            keys.and_then(|()| self.same_splats(&splats, truths)).err()
        })
    }

    /// Walks along both lists. Truths within 0.01 px of an image's edge may be missing.
    fn same_splats(&self, found: &[Splat], truths: &[Splat]) -> Result<(), String> {
        let mut next = found.iter().enumerate().peekable();
        let (mut exact, mut at_edge) = (0, 0);
        for truth in truths {
            let inside_px = truth.inside_px(&self.views[truth.view].camera);
            let view = &self.views[truth.view];
            match next.peek().filter(|(_, splat)| is_same(splat, truth, view)) {
                Some((index, splat)) => {
                    close(splat, truth, view).map_err(|e| format!("splat {index}: {e}"))?;
                    let is_exact = splat.depth_m == f64::from(truth.depth_m as f32);
                    exact += usize::from(is_exact || view.rolling_shutter.is_some());
                    next.next();
                }
                None if inside_px > 0.01 => {
                    return Err(format!("{truth:?} is missing; in its place is {:?}", next.peek()));
                }
                None => at_edge += usize::from(inside_px > -0.01),
            }
        }
        match next.next() {
            Some(left) => Err(format!("{left:?} is not visible")),
            None if at_edge > 3 => Err(format!("{at_edge} missing at the edge")),
            // The order of surfels of one plane hangs on it.
            None if exact * 1000 < found.len() * 999 => {
                Err(format!("{exact} of {} depths rounded once", found.len()))
            }
            None => Ok(()),
        }
    }

    fn object_to_sort(&self, found: &StageOutputs) -> Objections {
        [self.cpu[1].order.as_ref(), Some(&self.order)].map(|order| {
            let kept = found.keys == self.cpu[0].keys && found.splats == self.cpu[0].splats;
            let is_equal = found.order.as_ref() == order;
            let is_right = kept && is_equal;
            (!is_right).then(|| format!("equal order: {is_equal}, equal splats: {kept}"))
        })
    }

    /// Like the cpu's but for a few roundings; nothing missing that f64 finds, and little in vain.
    fn object_to_bin(&self, found: &StageOutputs) -> Objections {
        let (found, cpu) = (found.tiles.as_ref().unwrap(), self.cpu[2].tiles.as_ref().unwrap());
        let mut ranks = vec![None; self.order.len()];
        for (rank, &place) in self.order.iter().enumerate() {
            ranks[place as usize] = Some(rank);
        }
        let rank = |place: &u32| ranks.get(*place as usize).copied().flatten();
        let lists: Vec<&[u32]> = (0..found.ranges.len()).map(|tile| found.list(tile)).collect();
        let in_order =
            |list: &&[u32]| list.iter().map(rank).is_sorted_by(|a, b| a.is_some() && a < b);
        let listed: usize = lists.iter().map(|list| list.len()).sum();
        let is_sound = lists.len() == self.tiles.len()
            && cpu.ranges.len() == self.tiles.len()
            && listed == found.instances.len();
        if let Some(tile) = lists.iter().position(|list| !in_order(list)) {
            return [(); 2].map(|()| Some(format!("tile {tile} is out of order")));
        }
        if !is_sound {
            let instances = found.instances.len();
            let reason = format!("{} tiles, {listed} of {instances} listed", lists.len());
            return [(); 2].map(|()| Some(reason.clone()));
        }
        let lacks = |list: &[u32], of: &[u32]| {
            let has = |place: &&u32| list.binary_search_by_key(&rank(place), rank).is_ok();
            of.len() - of.iter().filter(has).count()
        };
        let (mut unlike, mut missing, mut needed) = (0, 0, 0);
        for (tile, (list, truth)) in lists.iter().zip(&self.tiles).enumerate() {
            unlike += lacks(list, cpu.list(tile)) + lacks(cpu.list(tile), list);
            missing += lacks(list, truth);
            needed += truth.len();
        }
        let like_cpu = unlike * 10_000 <= listed;
        let by_definition = missing == 0 && listed * 100 <= needed * 101;
        [
            (!like_cpu).then(|| format!("{unlike} of {listed} instances unlike")),
            (!by_definition).then(|| format!("{listed} listed, {missing} of {needed} missing")),
        ]
    }

    fn object_to_rasterize(&self, images: &[Image]) -> Objections {
        [&self.images, &self.pixels].map(|truths| {
            images.iter().zip(truths).find_map(|(image, truth)| agree(image, truth).err())
        })
    }
}

/// What the cpu and f64 object to.
type Objections = [Option<String>; 2];

fn check_keys(found: &StageOutputs, cutoffs: &Cutoffs) -> Result<(), String> {
    let splats = definition::splats(found);
    for (splat, (&key, of)) in splats.iter().zip(found.keys.iter().zip(&found.splats)) {
        let truth = cutoffs.sort_key(splat.view, of.depth_m);
        if key != truth {
            return Err(format!("key {key:#x} of a splat of key {truth:#x}"));
        }
    }
    Ok(())
}

/// The rest of a frame as a backend.
struct GoOn<'a> {
    gpu: &'a Gpu,
    between: &'a StageOutputs,
}

impl Backend for GoOn<'_> {
    fn name(&self) -> &'static str {
        "the rest on the gpu"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [wildcity_render::Target<'_>],
        finished: wildcity_render::OnViewDone<'_>,
    ) -> Result<wildcity_render::FrameStats, wildcity_render::RenderError> {
        self.gpu.resume(self.between, frame, targets, finished)
    }
}

/// How far a camera-space x or y may be off, in metres, as a share of the depth: a sum of f32, of
/// which three products lose half a step at 64 m, where the centres of a chunk end: 3 x 1.9e-6 m.
fn slope_bound(truth: &Splat) -> f64 {
    6e-6 / truth.depth_m
}

/// One step of f32. While a shutter rolls, a camera goes 0.9 m here, and the row that sees a point is known
/// to a millionth of that.
fn depth_bound_m(truth: &Splat, view: &View) -> f64 {
    1.2e-7 * truth.depth_m + if view.rolling_shutter.is_some() { 1e-6 } else { 0.0 }
}

/// Whether two splats can only be the same Gaussian's.
fn is_same(a: &Splat, b: &Splat, view: &View) -> bool {
    let near_px = 0.05 + slope_bound(b) * (b.mean_px[0].abs() + b.mean_px[1].abs());
    let near = |k: usize| (a.mean_px[k] - b.mean_px[k]).abs() <= near_px;
    a.view == b.view
        && (a.depth_m - b.depth_m).abs() <= depth_bound_m(b, view)
        && near(0)
        && near(1)
}

fn close(found: &Splat, truth: &Splat, view: &View) -> Result<(), String> {
    let [l0, l1, l2] = truth.factor;
    let step = slope_bound(truth);
    let mean = |k: usize| 2e-3 + step * (truth.mean_px[k].abs() + 200.0);
    // Mist around the camera is six points all over the image of a lens.
    let wide = if view.is_static_pinhole() { 1e-5 } else { 1e-4 };
    let reach = |k: usize| 1e-3 + (wide + 2.0 * step) * truth.reach_px[k];
    let factor = |of: f64| (1e-4 + 2.0 * step) * of;
    let numbers = [
        ("depth_m", found.depth_m, truth.depth_m, depth_bound_m(truth, view)),
        ("mean_px x", found.mean_px[0], truth.mean_px[0], mean(0)),
        ("mean_px y", found.mean_px[1], truth.mean_px[1], mean(1)),
        ("reach_px x", found.reach_px[0], truth.reach_px[0], reach(0)),
        ("reach_px y", found.reach_px[1], truth.reach_px[1], reach(1)),
        ("l0", found.factor[0], l0, factor(l0)),
        ("l1", found.factor[1], l1, factor(l0 + l1.abs())),
        ("l2", found.factor[2], l2, factor(l2)),
        ("log2_opacity", found.log2_opacity, truth.log2_opacity, 1e-5),
        ("red", found.rgb[0], truth.rgb[0], 2e-4),
        ("green", found.rgb[1], truth.rgb[1], 2e-4),
        ("blue", found.rgb[2], truth.rgb[2], 2e-4),
    ];
    for (name, found, truth, bound) in numbers {
        let is_close = (found - truth).abs() <= bound;
        if !is_close {
            return Err(format!("{name} {found}, truly {truth}"));
        }
    }
    Ok(())
}

#[test]
fn each_stage_does_what_its_twins_do() {
    let truth = &*TRUTH;
    assert_eq!(truth.wrong(&gpu()), []);
}

/// What is wrong with a lens is seen where lenses are projected; no other stage has its shader.
#[test]
fn a_slip_in_a_lens_fails_its_projection() {
    assert_eq!(BENT.wrong(&gpu()), []);
    let noticed = |(part, text): &&(&str, &str)| {
        let broken = Shaders::default().with_mutation("project_bent", part, text);
        let broken = gpu_with(broken.unwrap_or_else(|| panic!("{part:?} has no place")));
        let found = broken.run_through(&BENT.frame(), None, Stage::Project).unwrap();
        BENT.object_to_project(&found).iter().all(Option::is_some)
    };
    let unnoticed: Vec<&(&str, &str)> =
        LENS_MUTATIONS.iter().filter(|slip| !noticed(slip)).collect();
    assert!(unnoticed.is_empty(), "{unnoticed:#?}");
}

#[test]
fn a_slip_fails_its_own_stage_alone_and_the_bisection_names_it() {
    let (cpu, truth) = (cpu(), &*TRUTH);
    for slip in MUTATIONS {
        let broken = Shaders::default().with_mutation(slip.shader, slip.part, slip.text);
        let broken = gpu_with(broken.unwrap_or_else(|| panic!("{slip:?} has no place")));
        let wrong = truth.wrong(&broken);
        let names: Vec<&str> = wrong.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, slip.stages, "{slip:?}: {wrong:?}");
        let both = wrong.iter().all(|(_, twins)| twins.iter().all(Option::is_some));
        assert!(both, "{slip:?} is seen by one twin alone: {wrong:?}");
        let bisection = bisect(&cpu, &broken, &truth.frame()).unwrap();
        // Where several stages are wrong, the last one keeps the image wrong for longest. Depth is
        // not compared.
        let is_depth = slip.part.starts_with("sums.depth");
        let last = slip.stages.last().copied().filter(|_| !is_depth);
        assert_eq!(bisection.wrong(), last, "{slip:?}: {bisection:?}");
    }
}

/// Some 115 dB on this street: no whole image tells.
#[test]
fn depths_that_are_not_rounded_once_are_seen() {
    let truth = &*TRUTH;
    let broken = Shaders::default().with_mutation("project", "exact_m.x + exact_m.y", "exact_m.x");
    let broken = gpu_with(broken.unwrap());
    let wrong = truth.wrong(&broken);
    let [("project", twins)] = &wrong[..] else { panic!("{wrong:?}") };
    assert!(twins.iter().all(Option::is_some), "{wrong:?}");
}

#[test]
fn a_healthy_gpu_is_right_from_every_stage_on() {
    let street = street(30_000, 3, 5);
    let (demo, demo_views) = demo_street();
    for (gaussians, views) in [(street, &street_views()[..]), (demo, &demo_views[..])] {
        let (scene, profile) = (Scene::from_gaussians(&gaussians), RenderProfile::default());
        let frame = Frame { scene: &scene, profile: &profile, views };
        let bisection = bisect(&cpu(), &gpu(), &frame).unwrap();
        assert_eq!(bisection.psnr_db.len(), 4);
        assert!(bisection.psnr_db.iter().all(|(_, db)| *db >= MIN_PSNR_DB), "{bisection:?}");
        assert_eq!(bisection.wrong(), None);
    }
}

/// With every output, growing buffers, and another frame before that must leave nothing behind.
#[test]
fn a_hybrid_draws_what_the_cpu_draws() {
    let scene = Scene::from_gaussians(&street(100_000, 1, 43));
    let (profile, views) = (RenderProfile::default(), street_views());
    let truths = render(&cpu(), &scene, &profile, &views);
    let other = Scene::from_gaussians(&street(3_000, 1, 44));
    // Listens to what the others cause too.
    let _watched = gpu();
    for stage in Stage::ALL {
        let hybrid = HybridBackend::new(cpu(), Gpu::new(&AdapterChoice::Best, 0).unwrap(), stage);
        render(&hybrid, &other, &profile, &views[..2]);
        let images = render(&hybrid, &scene, &profile, &views);
        for (view, (image, truth)) in images.iter().zip(&truths).enumerate() {
            agree(image, truth).unwrap_or_else(|e| panic!("{stage:?}, view {view}: {e}"));
        }
        render(&hybrid, &Scene::default(), &profile, &views);
    }
}

#[test]
fn a_gpu_that_hands_over_to_itself_changes_nothing() {
    let truth = &*TRUTH;
    let gpu = gpu();
    let images = render(&gpu, &truth.scene, &truth.profile, &truth.views);
    for stage in Stage::ALL {
        let between = gpu.run_through(&truth.frame(), None, stage).unwrap();
        assert_eq!(between.last_stage(), stage);
        assert!(truth.drawn(&gpu, &between) == images, "{stage:?}");
    }
}
