//! Slabs: the splats of one view in a range of depths, drawn from the nearest slab to the farthest,
//! so that the intermediate buffers are bounded whatever the scene.
//!
//! A pixel blends its splats in order of (depth, global id). A view that is drawn in ranges of that
//! order therefore has the same bytes, if each tile continues from the sums of the previous slab.
//! Depth cuts a view in the same way for every camera: the depths of a cluster's Gaussians are
//! bounded by their distance from the camera, whatever the lens. (Bands of rows would need no sums,
//! but a bound on the rows of a cluster for each lens and shutter, and large splats lie in many
//! bands.) A cluster that reaches into two slabs is projected for both, and each keeps its own
//! splats.
//!
//! The number of splats of a slab is estimated. A slab that has too many is cut into halves.

use std::ops::Range;

use rayon::prelude::*;

use crate::layout::{Cutoffs, Splat};
use wildcity_scene::SemanticClass;
use wildcity_scene::chunk::CLUSTER;

/// Number of steps in which keys of depth are counted.
const STEPS: usize = 4096;

/// A cluster that a view may see.
#[derive(Clone, Copy, Debug)]
struct DepthCluster {
    /// Its index in the chunk.
    number: u32,
    /// Smallest and largest key of depth of its Gaussians, at most.
    first_key: u32,
    last_key: u32,
}

/// The clusters of one view by depth.
#[derive(Debug)]
pub(super) struct DepthClusters {
    /// The clusters, job by job.
    clusters: Vec<DepthCluster>,
    /// End of each job's clusters in `clusters`.
    ends: Vec<usize>,
    first_key: u32,
    /// The end of the keys, exclusive.
    end_key: u32,
    /// Number of keys per step.
    step: u32,
    /// Number of Gaussians up to the end of each step, as if each cluster's were spread evenly over
    /// its depths.
    up_to: Vec<f64>,
}

/// A range of a view's splats in order of (depth, global id).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Cut {
    pub(super) keys: Range<u32>,
    /// Jobs: all, unless splats of one depth are too many.
    jobs: Range<usize>,
}

/// A cut of a view's clusters.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slab<'a> {
    pub(super) cut: &'a Cut,
    pub(super) clusters: &'a DepthClusters,
}

/// The part of a slab in one job.
pub(super) struct SlabOfJob<'a> {
    keys: &'a Range<u32>,
    clusters: &'a [DepthCluster],
}

impl DepthClusters {
    /// The clusters of all jobs of one view: of each job the number of each cluster that the view
    /// may see, and bounds of the depths of its centres, in metres.
    pub(super) fn new<C: Iterator<Item = (usize, [f64; 2])>>(
        jobs: usize,
        visible_clusters: impl Fn(usize) -> C + Sync,
        cutoffs: &Cutoffs,
    ) -> Self {
        // Keys begin at near: a bound that lies nearer would be below 0.
        let key = |depth_m: f64| cutoffs.sort_key(0, (depth_m as f32).max(cutoffs.near_m));
        let cluster = |(number, [least_m, most_m]): (usize, [f64; 2])| DepthCluster {
            number: number as u32,
            first_key: key(least_m),
            last_key: key(most_m),
        };
        let of_job = |job| visible_clusters(job).map(cluster).collect();
        let by_job: Vec<Vec<DepthCluster>> = (0..jobs).into_par_iter().map(of_job).collect();
        let totals = by_job.iter().scan(0, |end, clusters| {
            *end += clusters.len();
            Some(*end)
        });
        let ends = totals.collect();
        Self::counted(by_job.concat(), ends)
    }

    fn counted(clusters: Vec<DepthCluster>, ends: Vec<usize>) -> Self {
        let first_key = clusters.iter().map(|cluster| cluster.first_key).min().unwrap_or(0);
        let last_key = clusters.iter().map(|cluster| cluster.last_key).max().unwrap_or(0);
        // Rounded up, so that the last key is in step 4,095 at most.
        let step = (last_key - first_key) / STEPS as u32 + 1;
        let step_of = |key: u32| ((key - first_key) / step) as usize;
        // The number of Gaussians of each step minus that of the previous one.
        let mut up_to = vec![0.0; STEPS + 1];
        for cluster in &clusters {
            let [first, last] = [cluster.first_key, cluster.last_key].map(step_of);
            let each = CLUSTER as f64 / (last - first + 1) as f64;
            // Differences first, so that a cluster costs two additions however deep it reaches.
            up_to[first] += each;
            up_to[last + 1] -= each;
        }
        // The first running sum gives the number of each step, the second that up to its end.
        for _ in 0..2 {
            let mut sum = 0.0;
            for value in &mut up_to {
                sum += *value;
                *value = sum;
            }
        }
        up_to.truncate(STEPS);
        Self { clusters, ends, first_key, end_key: last_key + 1, step, up_to }
    }

    /// The whole of the view.
    pub(super) fn keys(&self) -> Range<u32> {
        self.first_key..self.end_key
    }

    /// The cut that begins at a key and has about the given number of Gaussians, and their
    /// estimated number.
    pub(super) fn next(&self, first_key: u32, gaussians: f64) -> (Cut, f64) {
        let first_step = (first_key.saturating_sub(self.first_key) / self.step) as usize;
        // Gaussians of nearer steps: these are drawn already.
        let before = first_step.checked_sub(1).map_or(0.0, |step| self.up_to[step.min(STEPS - 1)]);
        let filled = self.up_to.partition_point(|&up_to| up_to <= before + gaussians);
        // One step at least, so that every cut makes progress; `halves` takes care of a full step.
        let end_step = filled.max(first_step + 1);
        let end_key = if end_step >= STEPS {
            self.end_key
        } else {
            // Ends of steps, so that the next cut begins where a step does.
            self.first_key + end_step as u32 * self.step
        };
        let estimated = self.up_to[end_step.min(STEPS) - 1] - before;
        (Cut { keys: first_key..end_key, jobs: 0..self.ends.len() }, estimated)
    }

    fn job_clusters(&self, job: usize) -> &[DepthCluster] {
        let start = job.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.clusters[start..self.ends[job]]
    }
}

impl Cut {
    /// Two cuts in its place, the nearer one first; `None` if it has one depth and one job.
    pub(super) fn halves(&self) -> Option<[Self; 2]> {
        let Self { keys, jobs } = self;
        if keys.len() > 1 {
            let middle = keys.start + (keys.end - keys.start) / 2;
            let cut = |keys| Self { keys, jobs: jobs.clone() };
            // Half-open ranges: no splat is in both halves, and none is lost.
            return Some([cut(keys.start..middle), cut(middle..keys.end)]);
        }
        if jobs.len() > 1 {
            // Within one depth the order is that of global ids, and so of jobs.
            let middle = jobs.start.midpoint(jobs.end);
            let cut = |jobs| Self { keys: keys.clone(), jobs };
            return Some([cut(jobs.start..middle), cut(middle..jobs.end)]);
        }
        None
    }
}

impl<'a> Slab<'a> {
    /// The jobs that may have splats in it.
    pub(super) fn jobs(&self) -> impl Iterator<Item = usize> {
        let Cut { keys, jobs } = self.cut;
        let touches = |&job: &usize| {
            self.clusters.job_clusters(job).iter().any(|cluster| cluster.touches(keys))
        };
        jobs.clone().filter(touches)
    }

    pub(super) fn job(&self, job: usize) -> SlabOfJob<'a> {
        SlabOfJob { keys: &self.cut.keys, clusters: self.clusters.job_clusters(job) }
    }
}

impl DepthCluster {
    fn touches(&self, keys: &Range<u32>) -> bool {
        self.first_key < keys.end && self.last_key >= keys.start
    }
}

impl SlabOfJob<'_> {
    /// Whether a cluster of the chunk may have splats in it.
    pub(super) fn touches(&self, number: usize) -> bool {
        let number = number as u32;
        // Clusters are listed in the order of their numbers; one that is not seen is missing.
        let found = self.clusters.binary_search_by_key(&number, |cluster| cluster.number);
        found.is_ok_and(|index| self.clusters[index].touches(self.keys))
    }

    /// Drops the splats from `start` on that are not in it, and their classes, if there are any.
    #[inline(always)]
    pub(super) fn keep(
        &self,
        cutoffs: &Cutoffs,
        splats: &mut Vec<Splat>,
        classes: &mut Vec<SemanticClass>,
        start: usize,
    ) {
        let has_classes = !classes.is_empty();
        let mut end = start;
        // In place and in order: `end` is never ahead of `index`.
        for index in start..splats.len() {
            if self.keys.contains(&cutoffs.sort_key(0, splats[index].depth_m)) {
                splats[end] = splats[index];
                if has_classes {
                    classes[end] = classes[index];
                }
                end += 1;
            }
        }
        splats.truncate(end);
        // Without classes there is nothing to truncate.
        classes.truncate(end);
    }
}
