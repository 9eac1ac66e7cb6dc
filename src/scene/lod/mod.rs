//! Levels of detail of a block: sets of fewer and fewer Gaussians, each with an upper bound of its
//! error.
//!
//! A level is made from the previous one by merging pairs of neighbours in Morton order, weighted
//! by opacity x area (`merge.rs`). The error of a merged Gaussian is the largest, over all
//! Gaussians of level 0 that it represents, of the distance that the mean moved plus 3 times the
//! decrease of the standard deviation; or how far beyond their edges it is seen, if that is more
//! (`Node::beyond_edge`). Without the latter, a stack of faint Gaussians on one spot, of which
//! only the tips are drawn, became one large opaque one without an error.
//!
//! Levels are merged under a limit of the error and not by halving: limits rise by √2 from 1 mm,
//! each block merges the pairs below the limit, cheapest first, and a level is kept if it has a
//! third fewer Gaussians than the previously kept one. So a single pair that is far apart does not
//! increase the error of a whole level, and the error of a level is close to its limit. There are
//! no random numbers, no threads and no hashing: the same block gives the same levels.

mod merge;

use glam::DVec3;
use rayon::prelude::*;

use super::chunk::{ActivatedGaussian, Chunk, column};
use super::{SemanticClass, sh};

use merge::{Node, StoredNode, area_m2, cost, hidden_share, joined};

/// One level of detail of a block.
#[derive(Clone, Debug)]
pub struct Level {
    /// Upper bound, in metres, of how far a Gaussian of level 0 was moved plus 3 times the standard
    /// deviation that it lost, and of how far beyond its edge it is seen; 0 for level 0.
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
/// The partner of a Gaussian that stays as it is.
const NO_PARTNER: u32 = u32::MAX;
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
/// the number of Gaussians too little. One is made at a time, and the block is no longer needed.
pub fn levels(block: &Chunk) -> impl Iterator<Item = Level> + use<> {
    let mut merging = Merging::new(block);
    let mut last = block.len();
    let mut before_m = 0.0_f32;
    let mut limit_m = FINEST_LIMIT_M;
    std::iter::from_fn(move || {
        // At most 29 limits: from 2^-10 to 2^4 in steps of √2.
        while limit_m <= COARSEST_LIMIT_M && merging.nodes.len() > FEWEST {
            merging.merge_within(limit_m);
            limit_m *= std::f64::consts::SQRT_2;
            if (merging.nodes.len() as f64) <= KEPT_SHARE * last as f64 {
                last = merging.nodes.len();
                // Not below the level before, because a later merge can bring a mean back; `level`
                // and the reader of a table need rising errors.
                before_m = merging.error_m().max(before_m);
                return Some(Level { error_m: before_m, chunk: merging.chunk() });
            }
        }
        None
    })
}

/// The state of merging a block into coarser levels: 80 bytes per Gaussian, its colour, and 20
/// bytes per Gaussian of level 0.
struct Merging {
    cell: [i32; 2],
    origin_m: DVec3,
    sh_degree: u8,
    nodes: Vec<StoredNode>,
    /// Largest error over the Gaussians of level 0 that each node represents, in metres.
    errors_m: Vec<f64>,
    /// SH coefficients, `[node, coefficient, channel]`.
    sh: Vec<f32>,
    /// Number of floats of one node in `sh`.
    stride: usize,
    /// Mean (x, y, z) and largest standard deviation of every Gaussian of level 0 (a leaf), in
    /// metres.
    leaves: Vec<[f32; 4]>,
    /// The node that represents each leaf.
    node_of_leaf: Vec<u32>,
    /// The class and the weight of each leaf, if the block has classes.
    leaf_classes: Option<Vec<(SemanticClass, f32)>>,
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
            cell: block.cell(),
            origin_m: block.origin_m(),
            sh_degree: block.sh_degree(),
            nodes: Vec::with_capacity(block.len()),
            errors_m: vec![0.0; block.len()],
            sh: Vec::with_capacity(block.len() * stride),
            stride,
            leaves: Vec::with_capacity(block.len()),
            node_of_leaf: (0..block.len() as u32).collect(),
            leaf_classes: block.classes().map(|classes| Vec::with_capacity(classes.len())),
        };
        for index in 0..block.len() {
            let value = |column| block.value(index, column);
            let three = |column| [0, 1, 2].map(|axis| value(column + axis));
            let scale_m = three(column::SCALE);
            let [x, y, z] = three(column::MEAN);
            let opacity = f64::from(value(column::LOG2_OPACITY)).exp2();
            let weight = opacity * area_m2(DVec3::from_array(scale_m.map(f64::from)));
            if let (Some(all), Some(classes)) = (&mut merging.leaf_classes, block.classes()) {
                all.push((classes[index], weight as f32));
            }
            merging.leaves.push([x, y, z, scale_m[0].max(scale_m[1]).max(scale_m[2])]);
            merging.nodes.push(StoredNode {
                mean_m: DVec3::from_array([x, y, z].map(f64::from)),
                scale_m,
                quat_wxyz: [0, 1, 2, 3].map(|i| value(column::QUAT + i)),
                weight,
                hidden_weight: weight * hidden_share(opacity),
            });
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
            let mut partner = vec![NO_PARTNER; before];
            let (of_first, others) = partner.split_at_mut(first.min(before));
            self.pair(0, limit_m, of_first);
            // In parallel: groups are independent, and a dense block is merged alone.
            others.par_chunks_mut(GROUP).enumerate().for_each(|(group, partner)| {
                self.pair(first + group * GROUP, limit_m, partner);
            });
            if partner.iter().all(|&partner| partner == NO_PARTNER) {
                break;
            }
            self.join(&partner);
            // Stop when a round merges fewer than one in fifty.
            if self.nodes.len() * 50 > before * 49 || self.nodes.len() <= FEWEST {
                break;
            }
        }
    }

    /// Chooses disjoint pairs within the group that begins at a node greedily, the cheapest first.
    /// Writes the second of each pair to the place of the first.
    fn pair(&self, start: usize, limit_m: f64, partner: &mut [u32]) {
        let mut pairs = Vec::new();
        // Most pairs are too far apart for any merge; comparing squares saves a square root for
        // each. The margin keeps every pair that `price` may accept in spite of rounding.
        // Half the distance is moved by one of the two, so that pairs beyond twice the limit are
        // out: (2 limit)².
        let farthest_m2 = 4.0 * limit_m * limit_m * (1.0 + 1e-9);
        let stored = &self.nodes[start..start + partner.len()];
        let nodes: Vec<Node> = stored.iter().map(StoredNode::node).collect();
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
                let second = place + 1 + ahead;
                if let Some(cost) = self.price(&nodes, start, [place, second], limit_m) {
                    pairs.push(Pair { cost, first: place, second });
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
            if !taken[first] && !taken[second] {
                taken[first] = true;
                taken[second] = true;
                partner[first] = (start + second) as u32;
            }
        }
    }

    /// The cost of merging two nodes of the group that begins at `start`; `None` if the error would
    /// exceed the limit or the cost is too high.
    fn price(
        &self,
        nodes: &[Node],
        start: usize,
        [first, second]: [usize; 2],
        limit_m: f64,
    ) -> Option<f64> {
        let (a, b) = (&nodes[first], &nodes[second]);
        let (error_a, error_b) = (self.errors_m[start + first], self.errors_m[start + second]);
        // Quick rejection, which most pairs of a dense block meet: by how far each moves, and by a
        // standard deviation that no axis of the merged node exceeds. The margin keeps every pair
        // that the test below may accept in spite of rounding.
        let distance_m = a.mean_m.distance(b.mean_m);
        let share = if a.weight + b.weight > 0.0 { b.weight / (a.weight + b.weight) } else { 0.5 };
        let sigma_a = a.sigma_m();
        let sigma_b = b.sigma_m();
        let widest_m = ((1.0 - share) * sigma_a * sigma_a
            + share * (sigma_b * sigma_b + (1.0 - share) * distance_m * distance_m))
            .sqrt();
        let at_least_a = error_a + share * distance_m + 3.0 * (sigma_a - widest_m).max(0.0);
        let at_least_b = error_b + (1.0 - share) * distance_m + 3.0 * (sigma_b - widest_m).max(0.0);
        if at_least_a.max(at_least_b) > limit_m * (1.0 + 1e-9) {
            return None;
        }
        let merged = joined(a, b);
        // A lower bound of the merged node's largest standard deviation: that along the longest
        // axis of the larger node.
        let larger = if sigma_a >= sigma_b { a } else { b };
        let axis = longest_axis(larger);
        let sigma_m = axis.dot(merged.cov_m2 * axis).max(0.0).sqrt();
        let error_m = |node: &Node, error_m: f64| {
            error_m
                + node.mean_m.distance(merged.mean_m)
                + 3.0 * (node.sigma_m() - sigma_m).max(0.0)
        };
        // As if the merged node had the area of the two, and grew only along that axis: across it,
        // it may have more area, be less opaque, and end sooner.
        let area_m2 = (area_m2(a.scale_m) * (1.0 - share) + area_m2(b.scale_m) * share)
            * (sigma_m / larger.sigma_m()).max(1.0);
        let beyond_m = merged.beyond_edge(area_m2) * sigma_m;
        let within = error_m(a, error_a).max(error_m(b, error_b)).max(beyond_m) <= limit_m;
        if !within {
            return None;
        }
        let colours = [self.colour(start + first), self.colour(start + second)];
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
    fn join(&mut self, partner: &[u32]) {
        let count = self.nodes.len();
        let mut place = vec![u32::MAX; count];
        let mut is_new = Vec::with_capacity(count);
        let mut end = 0;
        for node in 0..count {
            if place[node] != u32::MAX {
                continue;
            }
            place[node] = end as u32;
            let is_merged = partner[node] != NO_PARTNER;
            // An unmerged node keeps its error. That of a merged one is computed from its leaves
            // below, which is less than the sum of the bounds.
            let mut error_m = self.errors_m[node];
            let mut stored = self.nodes[node];
            if is_merged {
                let second = partner[node] as usize;
                place[second] = end as u32;
                let mut joint = joined(&stored.node(), &self.nodes[second].node());
                joint.diagonalise();
                error_m = joint.beyond_edge(area_m2(joint.scale_m)) * joint.sigma_m();
                stored = joint.stored();
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
            self.nodes[end] = stored;
            self.sh.copy_within(node * self.stride..(node + 1) * self.stride, end * self.stride);
            self.errors_m[end] = error_m;
            is_new.push(is_merged);
            end += 1;
        }
        self.nodes.truncate(end);
        self.sh.truncate(end * self.stride);
        self.errors_m.truncate(end);
        // Leaves are followed through all merges, so that an error is measured against level 0 and
        // not against the level before.
        for (node, leaf) in self.node_of_leaf.iter_mut().zip(&self.leaves) {
            *node = place[*node as usize];
            if !is_new[*node as usize] {
                continue;
            }
            let [x, y, z, sigma_m] = leaf.map(f64::from);
            let joint = &self.nodes[*node as usize];
            let lost_m = (sigma_m - joint.sigma_m()).max(0.0);
            let error_m = joint.mean_m.distance(DVec3::new(x, y, z)) + 3.0 * lost_m;
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

    fn chunk(&self) -> Chunk {
        let Self { cell, origin_m, sh_degree, .. } = *self;
        let mut chunk = Chunk::new(cell, origin_m, sh_degree, self.nodes.len());
        for (node, sh) in self.nodes.iter().zip(self.sh.chunks_exact(self.stride)) {
            let opacity = node.opacity();
            chunk.push_activated(&ActivatedGaussian {
                mean_m: node.mean_m.as_vec3().to_array(),
                scale_m: node.scale_m,
                quat_wxyz: node.quat_wxyz,
                // Also false for the NaN of a node without extent.
                log2_opacity: if opacity > 0.0 { opacity.log2() as f32 } else { f32::NEG_INFINITY },
                sh,
            });
        }
        chunk.with_classes(self.classes())
    }

    /// The class of each node: that with the greatest weight among the Gaussians of level 0 that it
    /// represents; the first of equal ones.
    fn classes(&self) -> Option<Vec<SemanticClass>> {
        // Of leaves and not of the nodes that were merged, among which a class that is in few of
        // each may lose although it is in most of all.
        let leaves = self.leaf_classes.as_ref()?;
        let mut weights = vec![[0.0_f32; SemanticClass::ALL.len()]; self.nodes.len()];
        // In the order of leaves, so that sums are the same every time.
        for (&node, &(class, weight)) in self.node_of_leaf.iter().zip(leaves) {
            // A Gaussian without extent has no weight, and counts where it is alone.
            weights[node as usize][usize::from(class.value())] += weight.max(f32::MIN_POSITIVE);
        }
        let heaviest = |weights: &[f32; SemanticClass::ALL.len()]| {
            let mut best = SemanticClass::None;
            for class in SemanticClass::ALL {
                if weights[usize::from(class.value())] > weights[usize::from(best.value())] {
                    best = class;
                }
            }
            best
        };
        Some(weights.iter().map(heaviest).collect())
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
