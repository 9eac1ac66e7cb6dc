//! The Gaussians that are trained: their parameters before activation, Adam's two moments, and the
//! chunk that the renderer draws.
//!
//! Parameters and moments have the layout of a [`Chunk`] (16 Gaussians to a lane group), so that
//! one pass takes a group's derivatives, moves its parameters, and writes its activated values.
//! **What no view of a step shows costs nothing:** a group without a visible Gaussian is not
//! touched (gsplat's selective Adam).
//!
//! A Gaussian takes four times its columns: at degree 1 368 B, and 92 B of gradients. While the
//! number grows, another 184 B for the old chunk and the new one.

mod adam_step;
mod saved;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;

use fearless_simd::{Level, Simd, dispatch};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use wildcity_render::gradient::ChunkGradients;
use wildcity_scene::chunk::{CLUSTER, LANES, Lanes, column, columns, morton};
use wildcity_scene::{Chunk, Gaussians, LanePages, Scene, SemanticClass, sh};

pub(crate) use adam_step::{AdamStep, rates};
use adam_step::{LN_SCALE, LOGIT, not_finite, quat_lengths, sigmoid};
use saved::Flat;
pub(crate) use saved::{ModelState, SavedModel};

/// The Gaussians of a training run.
#[derive(Debug)]
pub struct Model {
    sh_degree: u8,
    count: usize,
    /// Of the means, in the world.
    origin_m: DVec3,
    values: Vec<Lanes>,
    /// Adam's moving means of the derivatives, and of their squares.
    moments: [Vec<Lanes>; 2],
    /// Whether each Gaussian is of the ground; empty if none is.
    is_ground: Vec<bool>,
    /// The class of each Gaussian, or of what it is a copy of. Training changes none.
    classes: Option<Vec<SemanticClass>>,
    /// Gaussians that are drawn and stay as they are.
    fixed: Vec<Arc<Chunk>>,
    /// The chunk of the Gaussians that are trained, and then those of `fixed`.
    scene: Scene,
}

/// What a Gaussian of a degree takes while the number grows, in bytes: parameters, two moments,
/// gradients, the chunk, and a new one with what it is made of.
pub const fn peak_bytes(sh_degree: u8) -> usize {
    7 * 4 * columns(sh_degree)
}

/// The parameters, moments and derivatives of one cluster.
struct ClusterState<'a> {
    first_group: usize,
    values: &'a mut [Lanes],
    first: &'a mut [Lanes],
    second: &'a mut [Lanes],
}

impl Model {
    /// Gaussians to begin with, in the degree of the settings or in their own, if it is higher.
    /// Their values have been checked ([`wildcity_scene::validate`]).
    pub(crate) fn new(
        mut gaussians: Gaussians,
        is_ground: Vec<bool>,
        sh_degree: u8,
        fixed: Vec<Arc<Chunk>>,
    ) -> Self {
        gaussians.raise_sh_degree(sh_degree);
        let count = gaussians.len();
        let mut sum = DVec3::ZERO;
        for mean_m in &gaussians.means_m {
            sum += DVec3::from_array(*mean_m);
        }
        // f32 is exact to 30 µm at 500 m from here.
        let origin_m = (sum / count.max(1) as f64).round();
        let mut model = Self {
            sh_degree: gaussians.sh_degree,
            count: 0,
            origin_m,
            values: Vec::new(),
            moments: [Vec::new(), Vec::new()],
            is_ground: Vec::new(),
            classes: gaussians.classes.take(),
            fixed,
            scene: Scene::default(),
        };
        model.resize(count);
        for i in 0..count {
            let mean_m = DVec3::from_array(gaussians.means_m[i]) - origin_m;
            model.set(i, column::MEAN, &mean_m.as_vec3().to_array());
            model.set(i, LN_SCALE, &gaussians.ln_scales[i]);
            // In f64: squares of an f32 near its limits overflow or vanish in f32.
            let quat = gaussians.quats_wxyz[i].map(f64::from);
            let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
            model.set(i, column::QUAT, &quat.map(|q| (q / length) as f32));
            model.set(i, LOGIT, &[gaussians.logit_opacities[i]]);
            model.set(i, column::SH, gaussians.sh_at(i));
        }
        model.is_ground = is_ground;
        model.sort();
        model
    }

    pub(crate) fn saved(&self) -> SavedModel<'_> {
        SavedModel {
            sh_degree: self.sh_degree,
            count: self.count as u64,
            origin_m: self.origin_m.to_array(),
            values: Flat(&self.values),
            moments: self.moments.each_ref().map(|lanes| Flat(lanes)),
            is_ground: &self.is_ground,
            classes: self.classes.as_ref().map(|all| all.iter().map(|one| one.value()).collect()),
        }
    }

    /// `None` if the numbers of values do not fit each other.
    pub(crate) fn from_state(state: ModelState, fixed: Vec<Arc<Chunk>>) -> Option<Self> {
        let ModelState { sh_degree, count, origin_m, values, moments, is_ground, classes } = state;
        let count = count as usize;
        let is_known = sh_degree <= sh::MAX_DEGREE;
        // The count is read from a file, and may be any number.
        let wanted = count.div_ceil(LANES).checked_mul(columns(sh_degree) * LANES)?;
        let fits = moments.iter().chain([&values]).all(|values| values.len() == wanted);
        if !is_known || !fits || ![0, count].contains(&is_ground.len()) {
            return None;
        }
        let classes = match classes {
            None => None,
            Some(all) if all.len() == count => {
                let all = all.into_iter().map(SemanticClass::for_gaussian);
                Some(all.collect::<Option<Vec<_>>>()?)
            }
            Some(_) => return None,
        };
        let lanes = |values: Vec<f32>| values.as_chunks().0.iter().map(|v| Lanes(*v)).collect();
        let mut model = Self {
            sh_degree,
            count,
            origin_m: DVec3::from_array(origin_m),
            values: lanes(values),
            moments: moments.map(lanes),
            is_ground,
            classes,
            fixed,
            scene: Scene::default(),
        };
        model.rebuild();
        Some(model)
    }

    /// Number of Gaussians of the run.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether the run has no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The scene that the renderer draws.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The Gaussians before activation.
    pub fn to_gaussians(&self) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(self.sh_degree, self.count);
        for i in 0..self.count {
            let mean_m = Vec3::from_array(self.get(i, column::MEAN)).as_dvec3() + self.origin_m;
            gaussians.means_m.push(mean_m.to_array());
            gaussians.ln_scales.push(self.get(i, LN_SCALE));
            gaussians.quats_wxyz.push(self.get(i, column::QUAT));
            let [logit] = self.get(i, LOGIT);
            gaussians.logit_opacities.push(logit);
            let values = 3 * sh::coefficients(self.sh_degree);
            gaussians.sh.extend((0..values).map(|k| self.get::<1>(i, column::SH + k)[0]));
        }
        gaussians.classes.clone_from(&self.classes);
        gaussians
    }

    /// The degree of the spherical harmonics.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Moves the visible Gaussians by their derivatives. Returns the index of a Gaussian with a
    /// derivative that is not finite; the Gaussians of its lane group stay as they are.
    pub(crate) fn step(&mut self, gradients: &ChunkGradients, adam: &AdamStep) -> Option<usize> {
        let faulty = AtomicUsize::new(usize::MAX);
        let width = columns(self.sh_degree);
        let of_cluster = CLUSTER / LANES * width;
        let [first, second] = &mut self.moments;
        let values = self.values.chunks_mut(of_cluster);
        let moments = first.chunks_mut(of_cluster).zip(second.chunks_mut(of_cluster));
        let states: Vec<ClusterState<'_>> = values
            .zip(moments)
            .enumerate()
            .map(|(cluster, (values, (first, second)))| ClusterState {
                first_group: cluster * (CLUSTER / LANES),
                values,
                first,
                second,
            })
            .collect();
        // In place, unless a caller has kept a reference to the chunk: then this is a copy.
        let chunk = self.scene.chunks.first_mut().map(Arc::make_mut)?;
        // All levels of instructions give the same numbers: none fuses a product with a sum.
        let level = Level::new();
        chunk.rewrite(states, |state, lanes| {
            let mut changes = false;
            for group in 0..state.values.len() / width {
                let Some((by, visible)) = gradients.lane_group(state.first_group + group) else {
                    continue;
                };
                let first_index = (state.first_group + group) * LANES;
                let range = group * width..(group + 1) * width;
                let values = &mut state.values[range.clone()];
                let moments = [&mut state.first[range.clone()], &mut state.second[range.clone()]];
                let lanes = &mut lanes[range];
                let moved = dispatch!(level, simd => simd.vectorize(
                    #[inline(always)]
                    || {
                        if let Some(lane) = not_finite(by, visible) {
                            return Err(first_index + lane);
                        }
                        adam.apply(values, lanes, moments, by, visible);
                        adam.add_noise(values, visible, first_index);
                        activate(values, lanes);
                        Ok(())
                    }
                ));
                match moved {
                    Ok(()) => changes = true,
                    Err(index) => {
                        // The least index of all, whichever thread finds one first.
                        faulty.fetch_min(index, Relaxed);
                    }
                }
            }
            changes
        });
        Some(faulty.into_inner()).filter(|&index| index != usize::MAX)
    }

    /// Takes some Gaussians anew: `to[k]` becomes a copy of `sources[k]`, new ones are appended,
    /// and their moments are 0. Then all are sorted.
    pub(crate) fn copy(&mut self, sources: &[usize], to: &[usize]) {
        let width = columns(self.sh_degree);
        let most = to.iter().map(|&index| index + 1).max().unwrap_or(0);
        self.resize(self.count.max(most));
        for (&source, &to) in sources.iter().zip(to) {
            for column in 0..width {
                let value = self.values[source / LANES * width + column].0[source % LANES];
                self.values[to / LANES * width + column].0[to % LANES] = value;
            }
            if self.has_ground() {
                self.is_ground[to] = self.is_ground[source];
            }
            if let Some(classes) = &mut self.classes {
                classes[to] = classes[source];
            }
            self.forget(to);
        }
        self.sort();
    }

    /// Sorts the Gaussians by place and builds the chunk anew. Neighbours share clusters then, so
    /// that a view passes over most clusters, and a step over the lane groups that it does not
    /// show; copies at the end would make clusters as large as the scene.
    fn sort(&mut self) {
        let place = |index: usize| morton(&self.get(index, column::MEAN).map(f64::from));
        let mut order: Vec<(u64, usize)> =
            (0..self.count).into_par_iter().map(|index| (place(index), index)).collect();
        // No two keys are equal, so that the order is the same at any number of threads.
        order.par_sort_unstable();
        let width = columns(self.sh_degree);
        let sorted = |lanes: &[Lanes]| {
            let mut to = vec![Lanes([0.0; LANES]); lanes.len()];
            to.par_chunks_exact_mut(width).zip(order.par_chunks(LANES)).for_each(|(to, order)| {
                for (lane, &(_, from)) in order.iter().enumerate() {
                    let group = &lanes[from / LANES * width..][..width];
                    for (to, from_lanes) in to.iter_mut().zip(group) {
                        to.0[lane] = from_lanes.0[from % LANES];
                    }
                }
            });
            to
        };
        self.values = sorted(&self.values);
        self.moments = self.moments.each_ref().map(|moments| sorted(moments));
        if self.has_ground() {
            self.is_ground = order.iter().map(|&(_, from)| self.is_ground[from]).collect();
        }
        if let Some(classes) = &mut self.classes {
            *classes = order.iter().map(|&(_, from)| classes[from]).collect();
        }
        self.rebuild();
    }

    /// Forgets the moments of a Gaussian.
    pub(crate) fn forget(&mut self, index: usize) {
        let width = columns(self.sh_degree);
        for moments in &mut self.moments {
            for lanes in &mut moments[index / LANES * width..][..width] {
                lanes.0[index % LANES] = 0.0;
            }
        }
    }

    /// Whether some Gaussians are of the ground.
    pub(crate) fn has_ground(&self) -> bool {
        !self.is_ground.is_empty()
    }

    /// Whether a Gaussian is of the ground, or a copy of one that is.
    pub(crate) fn is_ground(&self, index: usize) -> bool {
        self.has_ground() && self.is_ground[index]
    }

    /// The peak opacity of a Gaussian.
    pub(crate) fn opacity(&self, index: usize) -> f32 {
        let [logit] = self.get(index, LOGIT);
        sigmoid(logit)
    }

    /// Sets the opacity of a Gaussian, and multiplies its scales.
    pub(crate) fn reshape(&mut self, index: usize, opacity: f32, factor: f32) {
        self.set(index, LOGIT, &[(opacity / (1.0 - opacity)).ln()]);
        let ln_scale = self.get::<3>(index, LN_SCALE);
        self.set(index, LN_SCALE, &ln_scale.map(|ln| ln + factor.ln()));
    }

    /// Parameters in consecutive columns of a Gaussian.
    pub(crate) fn get<const N: usize>(&self, index: usize, first: usize) -> [f32; N] {
        let group = index / LANES * columns(self.sh_degree);
        std::array::from_fn(|k| self.values[group + first + k].0[index % LANES])
    }

    fn set(&mut self, index: usize, first: usize, values: &[f32]) {
        let group = index / LANES * columns(self.sh_degree);
        for (lanes, &value) in self.values[group + first..].iter_mut().zip(values) {
            lanes.0[index % LANES] = value;
        }
    }

    fn resize(&mut self, count: usize) {
        let lanes = count.div_ceil(LANES) * columns(self.sh_degree);
        let zero = Lanes([0.0; LANES]);
        self.values.resize(lanes, zero);
        for moments in &mut self.moments {
            moments.resize(lanes, zero);
        }
        if self.has_ground() {
            self.is_ground.resize(count, false);
        }
        if let Some(classes) = &mut self.classes {
            classes.resize(count, SemanticClass::Unlabelled);
        }
        self.count = count;
    }

    /// Writes all Gaussians to a chunk of their number.
    fn rebuild(&mut self) {
        let width = columns(self.sh_degree);
        let mut lanes = vec![Lanes([0.0; LANES]); self.values.len()];
        let groups = lanes.chunks_exact_mut(width).zip(self.values.chunks_exact(width));
        groups.for_each(|(lanes, values)| activate(values, lanes));
        let mut pages = LanePages::new(width, None);
        pages.extend_from_slice(&lanes);
        let chunk = Chunk::from_lanes([0, 0], self.origin_m, self.sh_degree, self.count, pages);
        let mut chunks = vec![Arc::new(chunk)];
        chunks.extend_from_slice(&self.fixed);
        self.scene = Scene { chunks, ..Scene::default() };
    }
}

/// Writes the activated values of a lane group.
#[inline(always)]
fn activate(values: &[Lanes], lanes: &mut [Lanes]) {
    lanes.copy_from_slice(values);
    for k in 0..3 {
        for value in &mut lanes[column::SCALE + k].0 {
            *value = value.exp();
        }
    }
    let lengths = quat_lengths(values);
    for Lanes(quats) in &mut lanes[column::QUAT..column::QUAT + 4] {
        for (quat, length) in quats.iter_mut().zip(lengths) {
            *quat /= length;
        }
    }
    for (to, logit) in lanes[column::LOG2_OPACITY].0.iter_mut().zip(values[LOGIT].0) {
        // log2 of the sigmoid, without the loss of a small exponential.
        let ln = logit.min(0.0) - (-logit.abs()).exp().ln_1p();
        *to = ln * std::f32::consts::LOG2_E;
    }
}
