//! Each stage by itself, on the outputs of the cpu backend's previous stage: gpu against cpu and
//! against f64. Mutation tests check that each comparison can fail, and that it distinguishes the
//! wrong stage from the right ones.

use std::sync::{LazyLock, OnceLock};

use wildcity_render::compare::psnr::MIN_PSNR_DB;
use wildcity_render::cpu::Cpu;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::hybrid::{HybridBackend, bisect};
use wildcity_render::layout::Cutoffs;
use wildcity_render::stage::{Stage, StageOutputs};
use wildcity_render::{Backend, Frame, RenderError, View};
use wildcity_scene::{RenderProfile, Scene};

use crate::cameras::lens_views;
use crate::definition::{self, Splat};
use crate::gpu::{gpu, gpu_with, gpu_with_tuning};
use crate::images::{Image, agree, cpu, render};
use crate::mutations::{
    LENS_MUTATIONS, MUTATIONS, Mutation, far_of_lens_mutation, misty_street,
    shaders_with_lens_mutations, wide_views,
};
use crate::shared_gpu;
use crate::streets::{demo_street, street, street_views};
use crate::tuning::PLAIN;

/// One frame, the outputs of the cpu backend's stages, and those of the definition on the same
/// input.
struct Truth {
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
    /// The outputs of the cpu's stages project, sort, and bin.
    cpu: [StageOutputs; 3],
    images: Vec<Image>,
    /// The definition's splats, in f64.
    splats: Vec<Splat>,
    /// The definition's order of the cpu's splats.
    order: Vec<u32>,
    /// The definition's lists of the cpu's splats.
    tiles: OnceLock<Vec<Vec<u32>>>,
    /// The definition's images of the cpu's splats.
    pixels: OnceLock<Vec<Image>>,
}

/// The same instance for all tests.
static TRUTH: LazyLock<Truth> = LazyLock::new(|| Truth::new(&cpu(), 7_000, wide_views(), 0.0));

/// A street with every lens and with rolling shutters.
struct LensTruths {
    /// Always by six points.
    points: Truth,
    /// With expansions of the lenses wherever they are within a pixel of six points.
    expanded: Truth,
}

impl LensTruths {
    fn new(gaussians: usize) -> Self {
        let by = |lens_error_px| Truth::new(&cpu(), gaussians, lens_views(), lens_error_px);
        Self { points: by(0.0), expanded: by(1.0) }
    }

    /// How many expansions may differ from the cpu's.
    fn most_off(&self) -> usize {
        self.expanded.cpu[0].splats.len() / 500
    }

    /// Whether a gpu's projections differ from the cpu's and from the definition's.
    fn wrong_points(&self, gpu: &Gpu, far: f32) -> [bool; 2] {
        let found = self.points.projected(gpu, far.into());
        self.points.compare_project(&found).map(|difference| difference.is_some())
    }

    /// How many of a gpu's expansions differ from the cpu's.
    fn off_expanded(&self, gpu: &Gpu, far: f32) -> usize {
        self.expanded.far_from_cpu(&self.expanded.projected(gpu, far.into()))
    }

    /// Whether both twins, or the expansions, show a fault.
    fn detect(&self, gpu: &Gpu, far: f32) -> bool {
        self.wrong_points(gpu, far) == [true; 2] || self.off_expanded(gpu, far) > self.most_off()
    }
}

impl Truth {
    fn new(cpu: &Cpu, gaussians: usize, views: Vec<View>, lens_error_px: f64) -> Self {
        let scene = Scene::from_gaussians(&misty_street(gaussians));
        let profile = RenderProfile { lens_error_px, ..RenderProfile::default() };
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let stages = Stage::ALL.map(|stage| cpu.run_through(&frame, stage).unwrap().0);
        let of_cpu = definition::splats(&stages[0]);
        let order = definition::sort(&of_cpu);
        Self {
            images: render(cpu, &scene, &profile, &views),
            splats: definition::project(&frame),
            tiles: OnceLock::new(),
            pixels: OnceLock::new(),
            order,
            cpu: stages,
            scene,
            profile,
            views,
        }
    }

    fn tiles(&self) -> &[Vec<u32>] {
        self.tiles.get_or_init(|| {
            definition::bin(&definition::splats(&self.cpu[0]), &self.order, &self.frame())
        })
    }

    /// Testing every splat against every pixel takes seconds.
    fn pixels(&self) -> &[Image] {
        self.pixels.get_or_init(|| {
            definition::rasterize(&definition::splats(&self.cpu[0]), &self.order, &self.frame())
        })
    }

    fn frame(&self) -> Frame<'_> {
        Frame { scene: &self.scene, profile: &self.profile, views: &self.views }
    }

    /// The names of a gpu's wrong stages, with their differences from the twins on the cpu and in
    /// f64.
    fn wrong(&self, gpu: &Gpu) -> Vec<(&'static str, Differences)> {
        let [project, sort, bin] = &self.cpu;
        let compare = |done, last, differences: &dyn Fn(&StageOutputs) -> Differences| {
            match gpu.run_through(&self.frame(), done, last) {
                Ok(found) => differences(&found),
                // A stage that counts wrong may need more than there is room for.
                Err(error @ RenderError::TooMany { .. }) => {
                    [(); 2].map(|()| Some(error.to_string()))
                }
                Err(error) => panic!("{error}"),
            }
        };
        let all = [
            ("project", compare(None, Stage::Project, &|found| self.compare_project(found))),
            ("sort", compare(Some(project), Stage::Sort, &|found| self.compare_sort(found))),
            ("bin", compare(Some(sort), Stage::Bin, &|found| self.compare_bin(found))),
            ("rasterize", self.compare_rasterize(&self.drawn(gpu, bin))),
        ];
        all.into_iter().filter(|(_, twins)| twins.iter().any(Option::is_some)).collect()
    }

    /// A gpu's projections, with another `far`.
    fn projected(&self, gpu: &Gpu, far: f64) -> StageOutputs {
        let profile = RenderProfile { far, ..self.profile };
        let frame = Frame { profile: &profile, ..self.frame() };
        gpu.run_through(&frame, None, Stage::Project).unwrap()
    }

    /// The images that a gpu draws from the outputs of a stage.
    fn drawn(&self, gpu: &Gpu, between: &StageOutputs) -> Vec<Image> {
        render(&ResumedGpu { gpu, between }, &self.scene, &self.profile, &self.views)
    }

    fn compare_project(&self, found: &StageOutputs) -> Differences {
        let splats = definition::splats(found);
        let cpu = definition::splats(&self.cpu[0]);
        [&cpu, &self.splats].map(|truths| {
            let keys = check_keys(found, &Cutoffs::new(&self.profile));
            keys.and_then(|()| self.same_splats(&splats, truths)).err()
        })
    }

    /// How many of the cpu's splats the gpu's are not close to. Where the bound is reached, one
    /// backend may expand a Gaussian and the other project six points of it.
    fn far_from_cpu(&self, found: &StageOutputs) -> usize {
        let splats = definition::splats(found);
        let mut rest = splats.as_slice();
        let mut far = 0;
        for truth in definition::splats(&self.cpu[0]) {
            let view = &self.views[truth.view];
            // At the edge of an image one of both may lack a splat.
            let ahead = &rest[..rest.len().min(4)];
            match ahead.iter().position(|splat| is_same(splat, &truth, view)) {
                Some(index) => {
                    far += index + usize::from(close(&rest[index], &truth, view).is_err());
                    rest = &rest[index + 1..];
                }
                None => far += 1,
            }
        }
        far + rest.len()
    }

    /// Compares two lists in order. Expected splats within 0.01 px of an image's edge may be
    /// missing.
    fn same_splats(&self, found: &[Splat], truths: &[Splat]) -> Result<(), String> {
        let mut next = found.iter().enumerate().peekable();
        let mut exact = 0;
        let mut at_edge = 0;
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
            // The order of surfels of one plane depends on it.
            None if exact * 1000 < found.len() * 999 => {
                Err(format!("{exact} of {} depths rounded once", found.len()))
            }
            None => Ok(()),
        }
    }

    fn compare_sort(&self, found: &StageOutputs) -> Differences {
        [self.cpu[1].order.as_ref(), Some(&self.order)].map(|order| {
            let kept = found.keys == self.cpu[0].keys && found.splats == self.cpu[0].splats;
            let is_equal = found.order.as_ref() == order;
            let is_right = kept && is_equal;
            (!is_right).then(|| format!("equal order: {is_equal}, equal splats: {kept}"))
        })
    }

    /// The lists must equal the cpu's except for a few roundings. They must contain all splats that
    /// f64 finds, and at most 1 % more.
    fn compare_bin(&self, found: &StageOutputs) -> Differences {
        let found = found.tiles.as_ref().unwrap();
        let cpu = self.cpu[2].tiles.as_ref().unwrap();
        let mut ranks = vec![None; self.order.len()];
        for (rank, &splat) in self.order.iter().enumerate() {
            ranks[splat as usize] = Some(rank);
        }
        let rank = |splat: &u32| ranks.get(*splat as usize).copied().flatten();
        let lists: Vec<&[u32]> = (0..found.ranges.len()).map(|tile| found.list(tile)).collect();
        let in_order =
            |list: &&[u32]| list.iter().map(rank).is_sorted_by(|a, b| a.is_some() && a < b);
        let listed: usize = lists.iter().map(|list| list.len()).sum();
        let is_sound = lists.len() == self.tiles().len()
            && cpu.ranges.len() == self.tiles().len()
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
            let has = |splat: &&u32| list.binary_search_by_key(&rank(splat), rank).is_ok();
            of.len() - of.iter().filter(has).count()
        };
        let mut unlike = 0;
        let mut missing = 0;
        let mut needed = 0;
        for (tile, (list, truth)) in lists.iter().zip(self.tiles()).enumerate() {
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

    fn compare_rasterize(&self, images: &[Image]) -> Differences {
        [&self.images[..], self.pixels()].map(|truths| {
            images.iter().zip(truths).find_map(|(image, truth)| agree(image, truth).err())
        })
    }
}

/// The first difference from the cpu and from f64, if any.
type Differences = [Option<String>; 2];

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

/// A backend that draws the rest of a frame from the outputs of a stage.
struct ResumedGpu<'a> {
    gpu: &'a Gpu,
    between: &'a StageOutputs,
}

impl Backend for ResumedGpu<'_> {
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

/// Largest error of a camera-space x or y, in metres, divided by the depth. It is a sum of f32 with
/// three products, each of which loses half a step at 64 m, the largest coordinate in a chunk: 3 x
/// 1.9e-6 m.
fn slope_bound(truth: &Splat) -> f64 {
    6e-6 / truth.depth_m
}

/// Largest error of a depth: one step of f32. With a rolling shutter the camera moves 0.9 m here,
/// and the row that sees a point is known to a millionth of that.
fn depth_bound_m(truth: &Splat, view: &View) -> f64 {
    1.2e-7 * truth.depth_m + if view.rolling_shutter.is_some() { 1e-6 } else { 0.0 }
}

/// Whether two splats are so close that they must be of the same Gaussian.
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
    // Large Gaussians around the camera have sigma points all over the image of a lens.
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

/// A fault of a lens must be detected in stage project; no other stage uses that shader. Most
/// faults show in few Gaussians: the others need the whole street, which takes longer.
#[test]
fn a_mutation_of_a_lens_fails_its_projection() {
    let street = LensTruths::new(8_000);
    let few = LensTruths::new(1_000);
    let shipped = shared_gpu();
    assert_eq!(street.points.wrong(&shipped), []);
    let far = street.expanded.profile.far as f32;
    let (off, most) = (street.off_expanded(&shipped, far), street.most_off());
    assert!(off <= most, "{off} expansions differ from the cpu's, of {most} that may");

    let broken = gpu_with(shaders_with_lens_mutations());
    let without = far_of_lens_mutation(LENS_MUTATIONS.len());
    for truths in [&few, &street] {
        assert_eq!(truths.wrong_points(&broken, without), [false; 2], "without a mutation");
        let off = truths.off_expanded(&broken, without);
        assert!(off <= truths.most_off(), "without a mutation");
    }
    let is_detected = |number: usize| {
        let far = far_of_lens_mutation(number);
        few.detect(&broken, far) || street.detect(&broken, far)
    };
    let all = LENS_MUTATIONS.iter().enumerate();
    let undetected: Vec<_> = all.filter(|(number, _)| !is_detected(*number)).collect();
    assert!(undetected.is_empty(), "{undetected:#?}");
}

#[test]
fn a_mutation_fails_its_own_stage_alone_and_the_bisection_names_it() {
    let cpu = cpu();
    let truth = &*TRUTH;
    for mutation in MUTATIONS {
        let Mutation { shader, original, replacement, stages } = *mutation;
        let broken = Shaders::default().with_mutation(shader, original, replacement);
        let broken = broken.unwrap_or_else(|| panic!("{mutation:?}: the shader has no such text"));
        // Other kernels would run on hardware: `tuning.rs` breaks those.
        let broken = gpu_with_tuning(broken, PLAIN);
        let wrong = truth.wrong(&broken);
        let names: Vec<&str> = wrong.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, stages, "{mutation:?}: {wrong:?}");
        let both = wrong.iter().all(|(_, twins)| twins.iter().all(Option::is_some));
        assert!(both, "{mutation:?}: only one twin detects it: {wrong:?}");
        let bisection = bisect(&cpu, &broken, &truth.frame()).unwrap();
        // If several stages are wrong, the image stays wrong until the last of them runs on the
        // cpu. The bisection does not compare depth.
        let is_depth = original.starts_with("sums.depth");
        let last = stages.last().copied().filter(|_| !is_depth);
        assert_eq!(bisection.wrong(), last, "{mutation:?}: {bisection:?}");
    }
}

/// Wrong rounding changes the image of this street to 115 dB only, which no comparison of images
/// detects.
#[test]
fn depths_that_are_not_rounded_once_are_detected() {
    let truth = &*TRUTH;
    let broken = Shaders::default().with_mutation("project", "exact_m.x + exact_m.y", "exact_m.x");
    let broken = gpu_with(broken.unwrap());
    let wrong = truth.wrong(&broken);
    let [("project", twins)] = &wrong[..] else { panic!("{wrong:?}") };
    assert!(twins.iter().all(Option::is_some), "{wrong:?}");
}

#[test]
fn a_correct_gpu_is_right_from_every_stage_on() {
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

/// With all outputs, with buffers that grow, and after another frame, of which nothing may remain.
#[test]
fn a_hybrid_draws_what_the_cpu_draws() {
    let scene = Scene::from_gaussians(&street(100_000, 1, 43));
    let (profile, views) = (RenderProfile::default(), street_views());
    let truths = render(&cpu(), &scene, &profile, &views);
    let other = Scene::from_gaussians(&street(3_000, 1, 44));
    // It also watches the log for errors of the other devices.
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
fn a_gpu_that_resumes_from_its_own_outputs_draws_the_same() {
    let truth = &*TRUTH;
    let gpu = gpu();
    let images = render(&gpu, &truth.scene, &truth.profile, &truth.views);
    for stage in Stage::ALL {
        let between = gpu.run_through(&truth.frame(), None, stage).unwrap();
        assert_eq!(between.last_stage(), stage);
        assert!(truth.drawn(&gpu, &between) == images, "{stage:?}");
    }
}
