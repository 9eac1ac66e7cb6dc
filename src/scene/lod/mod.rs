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

use fearless_simd::{Level as SimdLevel, dispatch, f32x16, prelude::*};
use glam::DVec3;
use rayon::prelude::*;

use super::chunk::{ActivatedGaussian, Chunk, LANES, column};
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
/// the number of Gaussians too little. One is made at a time; unmerged Gaussians stay in the
/// block.
pub fn levels(block: &Chunk) -> impl Iterator<Item = Level> {
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

/// The state of merging a block into coarser levels. A dense block has millions of Gaussians, so
/// that those which are not merged stay in the block: a node takes 4 bytes, a merged one 80 and its
/// colour in addition, and a Gaussian of level 0 has 4.
struct Merging<'a> {
    /// Level 0. A leaf is one of its Gaussians.
    block: &'a Chunk,
    /// The nodes in Morton order.
    nodes: Vec<NodeRef>,
    /// Those that were merged, in any order; some are unused.
    merged: Vec<MergedNode>,
    /// SH coefficients, `[merged, coefficient, channel]`.
    sh: Vec<f32>,
    /// The unused ones of `merged`.
    unused: Vec<u32>,
    /// Number of floats of one node in `sh`.
    stride: usize,
    /// The node that represents each leaf.
    node_of_leaf: Vec<u32>,
}

/// A node: a leaf, or with [`NodeRef::MERGED`] the one that was merged of several.
#[derive(Clone, Copy)]
struct NodeRef(u32);

/// What a [`NodeRef`] refers to, by its place in the block or in [`Merging::merged`].
enum Referred {
    Leaf(usize),
    Merged(usize),
}

impl NodeRef {
    /// Blocks have fewer leaves: as many would take 120 GB.
    const MERGED: u32 = 1 << 31;

    fn merged(place: usize) -> Self {
        Self(place as u32 | Self::MERGED)
    }

    fn referred(self) -> Referred {
        let place = (self.0 & !Self::MERGED) as usize;
        if self.0 & Self::MERGED == 0 { Referred::Leaf(place) } else { Referred::Merged(place) }
    }
}

#[derive(Clone, Copy)]
struct MergedNode {
    stored: StoredNode,
    /// Largest error over the leaves that it represents, in metres.
    error_m: f64,
}

/// A candidate pair for merging.
struct Pair {
    cost: f64,
    first: usize,
    second: usize,
}

impl<'a> Merging<'a> {
    fn new(block: &'a Chunk) -> Self {
        Self {
            block,
            nodes: (0..block.len() as u32).map(NodeRef).collect(),
            merged: Vec::new(),
            sh: Vec::new(),
            unused: Vec::new(),
            stride: 3 * sh::coefficients(block.sh_degree()),
            node_of_leaf: (0..block.len() as u32).collect(),
        }
    }

    #[inline(always)]
    fn mean_of_leaf_m(&self, leaf: usize) -> DVec3 {
        let [x, y, z] = self.columns(leaf, column::MEAN);
        DVec3::new(f64::from(x), f64::from(y), f64::from(z))
    }

    /// Largest standard deviation of a leaf, in metres.
    #[inline(always)]
    fn sigma_of_leaf_m(&self, leaf: usize) -> f64 {
        let [x, y, z]: [f32; 3] = self.columns(leaf, column::SCALE);
        f64::from(x.max(y).max(z))
    }

    /// Consecutive columns of a leaf.
    #[inline(always)]
    fn columns<const N: usize>(&self, leaf: usize, first: usize) -> [f32; N] {
        let group = &self.block.lane_group(leaf / LANES)[first..first + N];
        let mut values = [0.0; N];
        for (value, lanes) in values.iter_mut().zip(group) {
            *value = lanes.0[leaf % LANES];
        }
        values
    }

    #[inline(always)]
    fn stored_leaf(&self, index: usize) -> StoredNode {
        // The columns of its geometry, in order.
        let [x, y, z, sx, sy, sz, qw, qx, qy, qz, log2_opacity] = self.columns(index, column::MEAN);
        let scale_m = [sx, sy, sz];
        let opacity = f64::from(log2_opacity).exp2();
        let weight = opacity * area_m2(DVec3::from_array(scale_m.map(f64::from)));
        StoredNode {
            mean_m: DVec3::new(f64::from(x), f64::from(y), f64::from(z)),
            scale_m,
            quat_wxyz: [qw, qx, qy, qz],
            weight,
            hidden_weight: weight * hidden_share(opacity),
        }
    }

    fn stored(&self, node: usize) -> StoredNode {
        match self.nodes[node].referred() {
            Referred::Leaf(leaf) => self.stored_leaf(leaf),
            Referred::Merged(merged) => self.merged[merged].stored,
        }
    }

    fn mean_m(&self, node: usize) -> DVec3 {
        match self.nodes[node].referred() {
            Referred::Leaf(leaf) => self.mean_of_leaf_m(leaf),
            Referred::Merged(merged) => self.merged[merged].stored.mean_m,
        }
    }

    /// Largest error over the leaves that a node represents, in metres.
    fn node_error_m(&self, node: usize) -> f64 {
        match self.nodes[node].referred() {
            Referred::Leaf(_) => 0.0,
            Referred::Merged(merged) => self.merged[merged].error_m,
        }
    }

    /// An SH coefficient of a node, of one channel.
    fn coefficient(&self, node: NodeRef, k: usize) -> f32 {
        match node.referred() {
            Referred::Leaf(leaf) => self.block.value(leaf, column::SH + k),
            Referred::Merged(merged) => self.sh[merged * self.stride + k],
        }
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
        let near = self.near_pairs(start, limit_m, partner.len());
        if near.is_empty() {
            return;
        }
        // Nodes and what is computed from them, where they are needed: few nodes have a near one.
        let mut priced = PricedNodes::new(start, partner.len());
        let mut pairs = Vec::new();
        for [first, second] in near {
            if let Some(cost) = self.price(&mut priced, [first, second], limit_m) {
                pairs.push(Pair { cost, first, second });
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

    /// The pairs of a group of `count` nodes that are near enough for a merge within a limit, by
    /// their places in the group.
    fn near_pairs(&self, start: usize, limit_m: f64, count: usize) -> Vec<[usize; 2]> {
        // Coordinate by coordinate, so that the distances to all successors are computed by
        // vectors. There is nothing near behind the last node.
        let mut means_m = [[f32::INFINITY; GROUP + PARTNERS]; 3];
        let mut largest_m = 0.0_f64;
        for place in 0..count {
            let mean_m = self.mean_m(start + place);
            largest_m = largest_m.max(mean_m.abs().max_element());
            for (coordinates, from) in means_m.iter_mut().zip(mean_m.to_array()) {
                coordinates[place] = from as f32;
            }
        }
        // Half the distance is moved by one of the two, so that pairs beyond twice the limit are
        // out. Rounding to f32 changes a difference of two coordinates by 2 ε of the largest one,
        // and so the distance by less than 4; squares and sums by less than 8 ε of their own size.
        let rounding = f64::from(f32::EPSILON);
        let farthest_m = (2.0 * limit_m + 4.0 * rounding * largest_m) * (1.0 + 8.0 * rounding);
        let farthest_m2 = (farthest_m * farthest_m) as f32;
        let mut near = Vec::new();
        dispatch!(SimdLevel::new(), simd => simd.vectorize(
            #[inline(always)]
            || add_near(simd, &means_m, count, farthest_m2, &mut near)
        ));
        near
    }

    /// The cost of merging two nodes of a group; `None` if the error would exceed the limit or the
    /// cost is too high.
    fn price(
        &self,
        priced: &mut PricedNodes,
        [first, second]: [usize; 2],
        limit_m: f64,
    ) -> Option<f64> {
        let stored_a = *priced.stored(self, first);
        let stored_b = *priced.stored(self, second);
        let error_a = self.node_error_m(priced.start + first);
        let error_b = self.node_error_m(priced.start + second);
        // Quick rejection, which most pairs of a dense block meet: by how far each moves, and by a
        // standard deviation that no axis of the merged node exceeds. The margin keeps every pair
        // that the test below may accept in spite of rounding.
        let distance_m = stored_a.mean_m.distance(stored_b.mean_m);
        let total = stored_a.weight + stored_b.weight;
        let share = if total > 0.0 { stored_b.weight / total } else { 0.5 };
        let sigma_a = stored_a.sigma_m();
        let sigma_b = stored_b.sigma_m();
        let widest_m = ((1.0 - share) * sigma_a * sigma_a
            + share * (sigma_b * sigma_b + (1.0 - share) * distance_m * distance_m))
            .sqrt();
        let at_least_a = error_a + share * distance_m + 3.0 * (sigma_a - widest_m).max(0.0);
        let at_least_b = error_b + (1.0 - share) * distance_m + 3.0 * (sigma_b - widest_m).max(0.0);
        if at_least_a.max(at_least_b) > limit_m * (1.0 + 1e-9) {
            return None;
        }
        priced.compute(first);
        priced.compute(second);
        let Some(a) = &priced.nodes[first] else { return None };
        let Some(b) = &priced.nodes[second] else { return None };
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
        let colours = [first, second].map(|place| self.colour(priced.start + place));
        // The limit stands for the size of a pixel at the distance at which this level is drawn, so
        // that the blur of the renderer is 0.3 limit².
        let cost = cost(a, b, &merged, colours, BLUR_PX2 * limit_m * limit_m);
        (cost <= MOST_COST).then_some(cost)
    }

    /// Colour of the DC coefficients, without the part that depends on the direction.
    fn colour(&self, node: usize) -> DVec3 {
        let dc = |channel: usize| f64::from(self.coefficient(self.nodes[node], channel));
        let colour = |channel: usize| (dc(channel) * sh::C0 + 0.5).max(0.0);
        DVec3::new(colour(0), colour(1), colour(2))
    }

    /// Merges every node with its partner, compacting the nodes in place.
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
            if is_merged {
                let second = partner[node] as usize;
                place[second] = end as u32;
                self.nodes[node] = self.join_pair(node, second);
            }
            // `end` never exceeds `node`, so no unread entry is overwritten: the second of a pair
            // comes later.
            self.nodes[end] = self.nodes[node];
            is_new.push(is_merged);
            end += 1;
        }
        self.nodes.truncate(end);
        // Leaves are followed through all merges, so that an error is measured against level 0 and
        // not against the level before.
        for leaf in 0..self.node_of_leaf.len() {
            let node = place[self.node_of_leaf[leaf] as usize];
            self.node_of_leaf[leaf] = node;
            if !is_new[node as usize] {
                continue;
            }
            let Referred::Merged(merged) = self.nodes[node as usize].referred() else { continue };
            let mean_m = self.mean_of_leaf_m(leaf);
            let sigma_m = self.sigma_of_leaf_m(leaf);
            let MergedNode { stored, error_m: largest } = &mut self.merged[merged];
            let lost_m = (sigma_m - stored.sigma_m()).max(0.0);
            let error_m = stored.mean_m.distance(mean_m) + 3.0 * lost_m;
            *largest = largest.max(error_m);
        }
    }

    /// Merges two nodes. The error of the merged one is only how far it is seen beyond its edges:
    /// that of its leaves, which is less than the sum of the bounds, is computed from them.
    fn join_pair(&mut self, first: usize, second: usize) -> NodeRef {
        let [a, b] = [first, second].map(|node| self.stored(node));
        let mut joint = joined(&a.node(), &b.node());
        joint.diagonalise();
        let error_m = joint.beyond_edge(area_m2(joint.scale_m)) * joint.sigma_m();
        let total = joint.weight;
        let share = if total > 0.0 { b.weight / total } else { 0.5 };
        let from = [first, second].map(|node| self.nodes[node]);
        let into = self.place_for(from);
        for k in 0..self.stride {
            let [a, b] = from.map(|node| f64::from(self.coefficient(node, k)));
            self.sh[into * self.stride + k] = (a + share * (b - a)) as f32;
        }
        self.merged[into] = MergedNode { stored: joint.stored(), error_m };
        NodeRef::merged(into)
    }

    /// The place in `merged` of a node that is merged of two: that of one of them, or an unused
    /// one, or a new one.
    fn place_for(&mut self, from: [NodeRef; 2]) -> usize {
        use Referred::{Leaf, Merged};
        let end = self.merged.len();
        let place = match from.map(NodeRef::referred) {
            [Merged(a), Merged(b)] => {
                self.unused.push(b as u32);
                a
            }
            [Merged(one), Leaf(_)] | [Leaf(_), Merged(one)] => one,
            [Leaf(_), Leaf(_)] => self.unused.pop().map_or(end, |unused| unused as usize),
        };
        if place == end {
            self.merged.push(MergedNode { stored: StoredNode::default(), error_m: 0.0 });
            self.sh.resize(self.merged.len() * self.stride, 0.0);
        }
        place
    }

    /// The largest error of all nodes, rounded up to f32.
    fn error_m(&self) -> f32 {
        let errors_m = (0..self.nodes.len()).map(|node| self.node_error_m(node));
        let largest = errors_m.fold(0.0_f64, f64::max);
        // The cast rounds to nearest, possibly down; the next number up is an upper bound again.
        (largest as f32).next_up()
    }

    fn chunk(&self) -> Chunk {
        let block = self.block;
        let sh_degree = block.sh_degree();
        let mut chunk = Chunk::new(block.cell(), block.origin_m(), sh_degree, self.nodes.len());
        let mut sh = vec![0.0; self.stride];
        for (index, &node) in self.nodes.iter().enumerate() {
            let stored = self.stored(index);
            for (k, coefficient) in sh.iter_mut().enumerate() {
                *coefficient = self.coefficient(node, k);
            }
            let opacity = stored.opacity();
            chunk.push_activated(&ActivatedGaussian {
                mean_m: stored.mean_m.as_vec3().to_array(),
                scale_m: stored.scale_m,
                quat_wxyz: stored.quat_wxyz,
                // Also false for the NaN of a node without extent.
                log2_opacity: if opacity > 0.0 { opacity.log2() as f32 } else { f32::NEG_INFINITY },
                sh: &sh,
            });
        }
        chunk.with_classes(self.classes())
    }

    /// The class of each node: that with the greatest weight among the Gaussians of level 0 that it
    /// represents; the first of equal ones.
    fn classes(&self) -> Option<Vec<SemanticClass>> {
        // Of leaves and not of the nodes that were merged, among which a class that is in few of
        // each may lose although it is in most of all.
        let classes = self.block.classes()?;
        let mut weights = vec![[0.0_f32; SemanticClass::ALL.len()]; self.nodes.len()];
        // In the order of leaves, so that sums are the same every time.
        for (leaf, (&node, class)) in self.node_of_leaf.iter().zip(classes).enumerate() {
            let weight = self.stored_leaf(leaf).weight as f32;
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

/// Appends the pairs of places whose distance is at most that of `farthest_m2`, rounded up, among
/// the first `count`: of each place with the [`PARTNERS`] after it.
#[inline(always)]
fn add_near<S: Simd>(
    simd: S,
    means_m: &[[f32; GROUP + PARTNERS]; 3],
    count: usize,
    farthest_m2: f32,
    near: &mut Vec<[usize; 2]>,
) {
    let farthest_m2 = f32x16::splat(simd, farthest_m2);
    for place in 0..count {
        let squares = means_m.each_ref().map(|coordinates| {
            let successors = f32x16::from_slice(simd, &coordinates[place + 1..][..PARTNERS]);
            let apart_m = successors - f32x16::splat(simd, coordinates[place]);
            apart_m * apart_m
        });
        let [x, y, z] = squares;
        let mut within = (x + y + z).simd_le(farthest_m2).to_bitmask();
        while within != 0 {
            near.push([place, place + 1 + within.trailing_zeros() as usize]);
            within &= within - 1;
        }
    }
}

/// The nodes of a group, each computed when a pair needs it.
struct PricedNodes {
    /// The first node of the group.
    start: usize,
    stored: Vec<Option<StoredNode>>,
    nodes: Vec<Option<Node>>,
}

impl PricedNodes {
    fn new(start: usize, count: usize) -> Self {
        Self { start, stored: vec![None; count], nodes: vec![None; count] }
    }

    #[inline(always)]
    fn stored(&mut self, merging: &Merging<'_>, place: usize) -> &StoredNode {
        self.stored[place].get_or_insert_with(|| merging.stored(self.start + place))
    }

    /// Computes the node of a stored one.
    #[inline(always)]
    fn compute(&mut self, place: usize) {
        if self.nodes[place].is_none() {
            self.nodes[place] = self.stored[place].map(|stored| stored.node());
        }
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
