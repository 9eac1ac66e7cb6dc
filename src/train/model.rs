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

use glam::{DVec3, Quat, Vec3};
use serde::{Deserialize, Serialize};
use wildcity_render::gradient::ChunkGradients;
use wildcity_scene::chunk::{CLUSTER, LANES, Lanes, column, columns};
use wildcity_scene::random::{mix, to_unit};
use wildcity_scene::{Chunk, Gaussians, LanePages, Scene, sh};

use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;

use crate::settings::Settings;

/// Columns of the parameters: those of a chunk, with logarithms of the scales, quaternions of any
/// length, and logits.
const LN_SCALE: usize = column::SCALE;
const LOGIT: usize = column::LOG2_OPACITY;

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
    /// Gaussians that are drawn and stay as they are.
    fixed: Vec<Arc<Chunk>>,
    /// The chunk of the Gaussians that are trained, and then those of `fixed`.
    scene: Scene,
}

/// The parameters and moments of a model, as a file has them: lane group by lane group.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct ModelState {
    sh_degree: u8,
    count: u64,
    origin_m: [f64; 3],
    values: Vec<f32>,
    moments: [Vec<f32>; 2],
    is_ground: Vec<bool>,
}

/// What one step of Adam needs beside the derivatives.
#[derive(Clone, Debug)]
pub(crate) struct AdamStep {
    /// The learning rate of each column.
    pub(crate) rates: Vec<f32>,
    /// `1 - decay^step` of both moments.
    pub(crate) corrections: [f32; 2],
    /// Derivatives of the mean opacity by an opacity, and of the mean scale by a scale.
    pub(crate) regularisers: [f32; 2],
    /// Noise of the means, in metres by a variance of 1 m².
    pub(crate) noise: f32,
    /// Opacity below which the noise begins.
    pub(crate) least_opacity: f32,
    /// Of the noise of this step.
    pub(crate) seed: u64,
}

/// Decays of Adam's moments.
const DECAYS: [f32; 2] = [0.9, 0.999];

/// Added to the root of the second moment. A derivative by a parameter of one of a million
/// Gaussians is small in all, and 1e-8 would hold it back (gsplat, INRIA).
const EPSILON: f32 = 1e-15;

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
        model.rebuild();
        model
    }

    pub(crate) fn state(&self) -> ModelState {
        let flat = |lanes: &Vec<Lanes>| lanes.iter().flat_map(|Lanes(values)| *values).collect();
        ModelState {
            sh_degree: self.sh_degree,
            count: self.count as u64,
            origin_m: self.origin_m.to_array(),
            values: flat(&self.values),
            moments: self.moments.each_ref().map(flat),
            is_ground: self.is_ground.clone(),
        }
    }

    /// `None` if the numbers of values do not fit each other.
    pub(crate) fn from_state(state: ModelState, fixed: Vec<Arc<Chunk>>) -> Option<Self> {
        let ModelState { sh_degree, count, origin_m, values, moments, is_ground } = state;
        let count = count as usize;
        let is_known = sh_degree <= sh::MAX_DEGREE;
        let wanted = count.div_ceil(LANES).checked_mul(columns(sh_degree) * LANES)?;
        let fits = moments.iter().chain([&values]).all(|values| values.len() == wanted);
        if !is_known || !fits || ![0, count].contains(&is_ground.len()) {
            return None;
        }
        let lanes = |values: Vec<f32>| values.as_chunks().0.iter().map(|v| Lanes(*v)).collect();
        let mut model = Self {
            sh_degree,
            count,
            origin_m: DVec3::from_array(origin_m),
            values: lanes(values),
            moments: moments.map(lanes),
            is_ground,
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
        chunk.rewrite(states, |state, lanes| {
            let mut changes = false;
            for group in 0..state.values.len() / width {
                let Some((by, visible)) = gradients.lane_group(state.first_group + group) else {
                    continue;
                };
                let first_index = (state.first_group + group) * LANES;
                if let Some(lane) = not_finite(by, visible) {
                    faulty.fetch_min(first_index + lane, Relaxed);
                    continue;
                }
                changes = true;
                let range = group * width..(group + 1) * width;
                let values = &mut state.values[range.clone()];
                let moments = [&mut state.first[range.clone()], &mut state.second[range.clone()]];
                adam.apply(values, moments, by, visible);
                adam.add_noise(values, visible, first_index);
                activate(values, &mut lanes[range]);
            }
            changes
        });
        Some(faulty.into_inner()).filter(|&index| index != usize::MAX)
    }

    /// Takes some Gaussians anew: `to[k]` becomes a copy of `sources[k]`, new ones are appended,
    /// and their moments are 0. Then the chunk is built anew.
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
            self.forget(to);
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

impl AdamStep {
    /// Moves the visible Gaussians of a lane group.
    fn apply(&self, values: &mut [Lanes], moments: [&mut [Lanes]; 2], by: &[Lanes], visible: u16) {
        let [first, second] = moments;
        let derivatives = self.raw(values, by);
        let shown: [bool; LANES] = std::array::from_fn(|lane| visible >> lane & 1 == 1);
        for (column, Lanes(derivatives)) in derivatives.iter().enumerate().take(values.len()) {
            let rate = self.rates[column] / self.corrections[0];
            let values = &mut values[column].0;
            let means = &mut first[column].0;
            let squares = &mut second[column].0;
            // All lanes, and then a choice: the compiler makes vector instructions of it.
            for lane in 0..LANES {
                let by = derivatives[lane];
                let mean = DECAYS[0] * means[lane] + (1.0 - DECAYS[0]) * by;
                let square = DECAYS[1] * squares[lane] + (1.0 - DECAYS[1]) * by * by;
                let value =
                    values[lane] - rate * mean / ((square / self.corrections[1]).sqrt() + EPSILON);
                means[lane] = if shown[lane] { mean } else { means[lane] };
                squares[lane] = if shown[lane] { square } else { squares[lane] };
                values[lane] = if shown[lane] { value } else { values[lane] };
            }
        }
    }

    /// The derivatives by parameters before activation, with those of the regularisers.
    fn raw(&self, values: &[Lanes], by: &[Lanes]) -> [Lanes; MAX_COLUMNS] {
        let mut raw = [Lanes([0.0; LANES]); MAX_COLUMNS];
        raw[..by.len()].copy_from_slice(by);
        for lane in 0..LANES {
            let value = |column: usize| values[column].0[lane];
            let square: f32 = (0..4).map(|k| value(column::QUAT + k).powi(2)).sum();
            for lanes in &mut raw[column::QUAT..column::LOG2_OPACITY] {
                lanes.0[lane] /= square.sqrt();
            }
            let opacity = sigmoid(value(LOGIT));
            let [by_opacity, by_scale] = self.regularisers;
            let by_log2 = raw[LOGIT].0[lane];
            raw[LOGIT].0[lane] =
                (1.0 - opacity) * (by_log2 * std::f32::consts::LOG2_E + by_opacity * opacity);
            for k in 0..3 {
                raw[LN_SCALE + k].0[lane] += by_scale * value(LN_SCALE + k).exp();
            }
        }
        raw
    }

    /// Moves visible Gaussians that are nearly transparent at random, along their own shape, so
    /// that they find a place where they show something. (Its authors move all, visible or not.
    /// Those that no view shows any more become transparent by no derivative either, and stay.)
    fn add_noise(&self, values: &mut [Lanes], visible: u16, first_index: usize) {
        if self.noise == 0.0 {
            return;
        }
        for lane in (0..LANES).filter(|lane| visible >> lane & 1 == 1) {
            let value = |column: usize| values[column].0[lane];
            let opacity = sigmoid(value(LOGIT));
            let gate = sigmoid(-100.0 * (opacity - self.least_opacity));
            if gate < 1e-4 {
                continue;
            }
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| value(column::QUAT + k));
            let rotation = Quat::from_xyzw(x, y, z, w).normalize();
            let variance = Vec3::from_array([0, 1, 2].map(|k| (2.0 * value(LN_SCALE + k)).exp()));
            let random = normals(self.seed, first_index + lane);
            let moved = rotation * (variance * (rotation.inverse() * random));
            for (axis, moved) in (moved * gate * self.noise).to_array().into_iter().enumerate() {
                values[column::MEAN + axis].0[lane] += moved;
            }
        }
    }
}

/// The first visible lane with a derivative that is not finite, or whose square is not.
fn not_finite(by: &[Lanes], visible: u16) -> Option<usize> {
    let is_finite =
        |lane: usize| by.iter().all(|lanes| (lanes.0[lane] * lanes.0[lane]).is_finite());
    (0..LANES).find(|&lane| visible >> lane & 1 == 1 && !is_finite(lane))
}

/// Columns at the largest degree.
const MAX_COLUMNS: usize = columns(sh::MAX_DEGREE);

/// Three numbers of a normal distribution, by a seed and a Gaussian (Box and Muller 1958).
fn normals(seed: u64, index: usize) -> Vec3 {
    let bits = |k: u64| mix(seed ^ mix(4 * index as u64 + k));
    let pair = |k: u64| {
        // Never 0, of which there is no logarithm.
        let radius = (-2.0 * (1.0 - to_unit(bits(k))).ln()).sqrt();
        let angle = std::f64::consts::TAU * to_unit(bits(k + 1));
        [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32]
    };
    let [x, y] = pair(0);
    let [z, _] = pair(2);
    Vec3::new(x, y, z)
}

/// Writes the activated values of a lane group.
fn activate(values: &[Lanes], lanes: &mut [Lanes]) {
    lanes.copy_from_slice(values);
    for k in 0..3 {
        for value in &mut lanes[column::SCALE + k].0 {
            *value = value.exp();
        }
    }
    for lane in 0..LANES {
        let square: f32 = (0..4).map(|k| values[column::QUAT + k].0[lane].powi(2)).sum();
        for k in 0..4 {
            lanes[column::QUAT + k].0[lane] /= square.sqrt();
        }
        // log2 of the sigmoid, without the loss of a small exponential.
        let logit = values[LOGIT].0[lane];
        let ln = logit.min(0.0) - (-logit.abs()).exp().ln_1p();
        lanes[column::LOG2_OPACITY].0[lane] = ln * std::f32::consts::LOG2_E;
    }
}

fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The settings' learning rates, column by column.
pub(crate) fn rates(settings: &Settings, mean: f32, sh_degree: u8, all: usize) -> Vec<f32> {
    let trained = columns(sh_degree);
    let rate = |column: usize| match column {
        column::MEAN..LN_SCALE => mean,
        LN_SCALE..column::QUAT => settings.rates.ln_scale,
        column::QUAT..LOGIT => settings.rates.quat,
        LOGIT => settings.rates.logit,
        // The constant coefficient, of three colours.
        11..14 => settings.rates.sh,
        // Degrees that are not trained yet stay as they are.
        column if column < trained => settings.rates.sh_rest,
        _ => 0.0,
    };
    (0..all).map(rate).collect()
}
