//! Levels of detail of a block: sets of fewer and fewer Gaussians, each with an upper bound of its
//! error.
//!
//! A level is made from the previous one by merging pairs of neighbours in Morton order, weighted
//! by opacity x area (`merge.rs`). The error of a merged Gaussian is the largest, over all
//! Gaussians of level 0 that it represents, of the distance that the mean moved plus 3 times the
//! decrease of the standard deviation.
//!
//! Levels are merged under a limit of the error and not by halving: limits rise by √2 from 1 mm,
//! each block merges the pairs below the limit, cheapest first, and a level is kept if it has a
//! third fewer Gaussians than the previously kept one. So a single pair that is far apart does not
//! increase the error of a whole level, and the error of a level is close to its limit. There are
//! no random numbers, no threads and no hashing: the same block gives the same levels.

mod merge;

use glam::DVec3;

use super::chunk::{ActivatedGaussian, Chunk, column};
use super::sh;

use merge::{Node, cost, joined};

/// One level of detail of a block.
#[derive(Clone, Debug)]
pub struct Level {
    /// Upper bound, in metres, of how far a Gaussian of level 0 was moved plus 3 times the standard
    /// deviation that it lost; 0 for level 0.
    pub error_m: f32,
    pub chunk: Chunk,
}

/// The finest limit, in metres: about the size of a pixel at 1.8 m with a focal length of 1800 px.
const FINEST_LIMIT_M: f64 = 1.0 / 1024.0;
/// The coarsest limit, in metres: the size of such a pixel at 29 km.
const COARSEST_LIMIT_M: f64 = 16.0;
/// A level is kept if it has at most this share of the Gaussians of the previously kept level. So
/// all levels above 0 together have at most 0.65 / 0.35 = 1.9 times as many as level 0; half of
/// that is usual.
const KEPT_SHARE: f64 = 0.65;
/// Merging stops at this number: a block is one chunk with at least one lane group.
const FEWEST: usize = 16;
/// Number of consecutive Gaussians in Morton order among which pairs are formed.
const GROUP: usize = 64;
/// A partner is searched among this many successors in the order.
const PARTNERS: usize = 16;
/// Largest number of pairing rounds per limit; each round at most halves a block.
const ROUNDS: usize = 8;
/// Largest accepted cost of a merge, as a share of the fields' norm. On the demo street, 0.02 draws
/// as many Gaussians at any tau as 0.2, with 1 dB less noise.
const MOST_COST: f64 = 0.02;
/// Variance that the renderer adds on the screen, in px²: differences that this blur hides have no
/// cost.
const BLUR_PX2: f64 = 0.3;

/// The levels of a block above level 0, each coarser than the previous one; none if merging reduces
/// the number of Gaussians too little.
pub fn levels(block: &Chunk) -> Vec<Level> {
    let mut merging = Merging::new(block);
    let mut kept = Vec::new();
    let mut last = block.len();
    let mut limit_m = FINEST_LIMIT_M;
    // At most 29 limits: from 2^-10 to 2^4 in steps of √2.
    while limit_m <= COARSEST_LIMIT_M && merging.nodes.len() > FEWEST {
        merging.merge_within(limit_m);
        if (merging.nodes.len() as f64) <= KEPT_SHARE * last as f64 {
            last = merging.nodes.len();
            let before_m = kept.last().map_or(0.0, |level: &Level| level.error_m);
            // Not below the level before, because a later merge can bring a mean back; `level` and
            // the reader of a table need rising errors.
            let error_m = merging.error_m().max(before_m);
            kept.push(Level { error_m, chunk: merging.chunk(block) });
        }
        limit_m *= std::f64::consts::SQRT_2;
    }
    kept
}

/// The state of merging a block into coarser levels.
struct Merging {
    nodes: Vec<Node>,
    /// Largest error over the Gaussians of level 0 that each node represents, in metres.
    errors_m: Vec<f64>,
    /// SH coefficients, `[node, coefficient, channel]`.
    sh: Vec<f32>,
    /// Number of floats of one node in `sh`.
    stride: usize,
    /// Mean and largest standard deviation of every Gaussian of level 0 (a leaf), in metres.
    leaves: Vec<(DVec3, f64)>,
    /// The node that represents each leaf.
    node_of_leaf: Vec<u32>,
}

/// A candidate pair for merging.
struct Pair {
    cost: f64,
    first: usize,
    second: usize,
}

impl Merging {
    fn new(block: &Chunk) -> Self {
        let stride = 3 * sh::coefficients(block.sh_degree());
        let mut merging = Self {
            nodes: Vec::with_capacity(block.len()),
            errors_m: vec![0.0; block.len()],
            sh: Vec::with_capacity(block.len() * stride),
            stride,
            leaves: Vec::with_capacity(block.len()),
            node_of_leaf: (0..block.len() as u32).collect(),
        };
        for index in 0..block.len() {
            let value = |column| f64::from(block.value(index, column));
            let three = |column| DVec3::new(value(column), value(column + 1), value(column + 2));
            let quat = [0, 1, 2, 3].map(|i| value(column::QUAT + i));
            let opacity = value(column::LOG2_OPACITY).exp2();
            let node = Node::new(three(column::MEAN), three(column::SCALE), quat, opacity);
            merging.leaves.push((node.mean_m, node.sigma_m()));
            merging.nodes.push(node);
            merging.sh.extend((0..stride).map(|k| block.value(index, column::SH + k)));
        }
        merging
    }

    /// Merges pairs until none is left whose error stays within the limit, or the rounds are used
    /// up.
    fn merge_within(&mut self, limit_m: f64) {
        for round in 0..ROUNDS {
            let before = self.nodes.len();
            // Every other round shifts the groups by half, so that pairs cross the borders of the
            // previous round.
            let first = if round % 2 == 0 { GROUP } else { GROUP / 2 };
            let mut partner = vec![None; before];
            let mut start = 0;
            let mut end = first.min(before);
            while start < before {
                self.pair(start..end, limit_m, &mut partner);
                (start, end) = (end, (end + GROUP).min(before));
            }
            if partner.iter().all(Option::is_none) {
                break;
            }
            self.join(&partner);
            // Stop when a round merges fewer than one in fifty.
            if self.nodes.len() * 50 > before * 49 || self.nodes.len() <= FEWEST {
                break;
            }
        }
    }

    /// Chooses disjoint pairs within a group greedily, the cheapest first.
    fn pair(&self, group: std::ops::Range<usize>, limit_m: f64, partner: &mut [Option<u32>]) {
        let mut pairs = Vec::new();
        // Most pairs are too far apart for any merge; comparing squares saves a square root for
        // each. The margin keeps every pair that `price` may accept in spite of rounding.
        // Half the distance is moved by one of the two, so that pairs beyond twice the limit are
        // out: (2 limit)².
        let farthest_m2 = 4.0 * limit_m * limit_m * (1.0 + 1e-9);
        let nodes = &self.nodes[group.clone()];
        // Coordinate by coordinate, so that the distances to all successors are computed by
        // vectors. There is nothing near behind the last node.
        let mut means_m = [[f64::INFINITY; GROUP + PARTNERS]; 3];
        for (place, node) in nodes.iter().enumerate() {
            for (coordinates, from) in means_m.iter_mut().zip(node.mean_m.to_array()) {
                coordinates[place] = from;
            }
        }
        for place in 0..nodes.len() {
            let mut distances_m2 = [0.0; PARTNERS];
            for coordinates in &means_m {
                let from = coordinates[place];
                let successors = &coordinates[place + 1..][..PARTNERS];
                for (distance_m2, to) in distances_m2.iter_mut().zip(successors) {
                    *distance_m2 += (from - to) * (from - to);
                }
            }
            for (ahead, distance_m2) in distances_m2.into_iter().enumerate() {
                if distance_m2 > farthest_m2 {
                    continue;
                }
                let first = group.start + place;
                let second = first + 1 + ahead;
                if let Some(cost) = self.price(first, second, limit_m) {
                    pairs.push(Pair { cost, first, second });
                }
            }
        }
        // Cheapest first. Ties end with the indices, so that the order does not depend on the sort.
        pairs.sort_by(|a, b| {
            a.cost.total_cmp(&b.cost).then((a.first, a.second).cmp(&(b.first, b.second)))
        });
        // A node takes part in at most one merge of a round, because the cost of a second one would
        // be out of date.
        let mut taken = [false; GROUP];
        for Pair { first, second, .. } in pairs {
            let places = [first - group.start, second - group.start];
            if !places.iter().any(|&place| taken[place]) {
                places.iter().for_each(|&place| taken[place] = true);
                partner[first] = Some(second as u32);
            }
        }
    }

    /// The cost of merging two nodes; `None` if the error would exceed the limit or the cost is too
    /// high.
    fn price(&self, first: usize, second: usize, limit_m: f64) -> Option<f64> {
        let (a, b) = (&self.nodes[first], &self.nodes[second]);
        let (error_a, error_b) = (self.errors_m[first], self.errors_m[second]);
        // Quick rejection: one of the two nodes moves by at least half their distance.
        let distance_m = a.mean_m.distance(b.mean_m);
        if 0.5 * distance_m + error_a.min(error_b) > limit_m {
            return None;
        }
        let merged = joined(a, b);
        // A lower bound of the merged node's largest standard deviation: that along the longest
        // axis of the larger node.
        let larger = if a.sigma_m() >= b.sigma_m() { a } else { b };
        let axis = longest_axis(larger);
        let sigma_m = axis.dot(merged.cov_m2 * axis).max(0.0).sqrt();
        let error_m = |node: &Node, error_m: f64| {
            error_m
                + node.mean_m.distance(merged.mean_m)
                + 3.0 * (node.sigma_m() - sigma_m).max(0.0)
        };
        let within = error_m(a, error_a).max(error_m(b, error_b)) <= limit_m;
        if !within {
            return None;
        }
        let colours = [self.colour(first), self.colour(second)];
        // The limit stands for the size of a pixel at the distance at which this level is drawn, so
        // that the blur of the renderer is 0.3 limit².
        let cost = cost(a, b, &merged, colours, BLUR_PX2 * limit_m * limit_m);
        (cost <= MOST_COST).then_some(cost)
    }

    /// Colour of the DC coefficients, without the part that depends on the direction.
    fn colour(&self, node: usize) -> DVec3 {
        let dc = &self.sh[node * self.stride..node * self.stride + 3];
        let colour = |channel: usize| (f64::from(dc[channel]) * sh::C0 + 0.5).max(0.0);
        DVec3::new(colour(0), colour(1), colour(2))
    }

    /// Merges every node with its partner, compacting all arrays in place.
    fn join(&mut self, partner: &[Option<u32>]) {
        let count = self.nodes.len();
        let mut place = vec![u32::MAX; count];
        let mut is_new = Vec::with_capacity(count);
        let mut end = 0;
        for node in 0..count {
            if place[node] != u32::MAX {
                continue;
            }
            place[node] = end as u32;
            let mut joint = self.nodes[node];
            if let Some(second) = partner[node] {
                let second = second as usize;
                place[second] = end as u32;
                joint = joined(&self.nodes[node], &self.nodes[second]);
                joint.diagonalise();
                let total = joint.weight;
                let share = if total > 0.0 { self.nodes[second].weight / total } else { 0.5 };
                for k in 0..self.stride {
                    let (a, b) =
                        (self.sh[node * self.stride + k], self.sh[second * self.stride + k]);
                    let mixed = f64::from(a) + share * (f64::from(b) - f64::from(a));
                    self.sh[node * self.stride + k] = mixed as f32;
                }
            }
            // `end` never exceeds `node`, so no unread entry is overwritten: the second of a pair
            // comes later.
            self.nodes[end] = joint;
            self.sh.copy_within(node * self.stride..(node + 1) * self.stride, end * self.stride);
            // An unmerged node keeps its error. That of a merged one is computed from its leaves
            // below, which is less than the sum of the bounds.
            self.errors_m[end] = if partner[node].is_some() { 0.0 } else { self.errors_m[node] };
            is_new.push(partner[node].is_some());
            end += 1;
        }
        self.nodes.truncate(end);
        self.sh.truncate(end * self.stride);
        self.errors_m.truncate(end);
        // Leaves are followed through all merges, so that an error is measured against level 0 and
        // not against the level before.
        for (node, (mean_m, sigma_m)) in self.node_of_leaf.iter_mut().zip(&self.leaves) {
            *node = place[*node as usize];
            if !is_new[*node as usize] {
                continue;
            }
            let joint = &self.nodes[*node as usize];
            let lost_m = (sigma_m - joint.sigma_m()).max(0.0);
            let error_m = joint.mean_m.distance(*mean_m) + 3.0 * lost_m;
            let largest = &mut self.errors_m[*node as usize];
            *largest = largest.max(error_m);
        }
    }

    /// The largest error of all nodes, rounded up to f32.
    fn error_m(&self) -> f32 {
        let largest = self.errors_m.iter().fold(0.0_f64, |all, &error| all.max(error));
        // The cast rounds to nearest, possibly down; the next number up is an upper bound again.
        (largest as f32).next_up()
    }

    fn chunk(&self, block: &Chunk) -> Chunk {
        let count = self.nodes.len();
        let mut chunk = Chunk::new(block.cell(), block.origin_m(), block.sh_degree(), count);
        for (node, sh) in self.nodes.iter().zip(self.sh.chunks_exact(self.stride)) {
            let opacity = node.opacity();
            chunk.push_activated(&ActivatedGaussian {
                mean_m: node.mean_m.as_vec3().to_array(),
                scale_m: node.scale_m.as_vec3().to_array(),
                quat_wxyz: node.quat_wxyz().map(|q| q as f32),
                // Also false for the NaN of a node without extent.
                log2_opacity: if opacity > 0.0 { opacity.log2() as f32 } else { f32::NEG_INFINITY },
                sh,
            });
        }
        chunk
    }
}

fn longest_axis(node: &Node) -> DVec3 {
    let DVec3 { x, y, z } = node.scale_m;
    if x >= y && x >= z {
        node.axes.x_axis
    } else if y >= z {
        node.axes.y_axis
    } else {
        node.axes.z_axis
    }
}
