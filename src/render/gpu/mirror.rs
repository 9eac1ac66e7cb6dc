//! The mirror: what is resident in main memory, encoded for the device and uploaded once.
//!
//! A cluster of 256 Gaussians is a header of 32 words and then word after word, 256 side by side:
//! mean and scale (f32 x 3 each), opacity (f32), a quaternion in 64 bits, and colour as two 16-bit
//! fractions per word of the cluster's largest value: 60.5 B per Gaussian at degree 1.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Weak};

use rayon::prelude::*;
use wgpu::{Buffer, BufferUsages};

use super::device::Device;
use super::layout::{CLUSTER_HEADER_WORDS, GEOMETRY_WORDS};
use crate::scene::chunk::{CLUSTER, column};
use crate::scene::{Chunk, Scene, sh};

/// Clusters encoded at a time: at most 2^11 of 34 kB, so that staging memory stays below 70 MB.
const UPLOAD_CLUSTERS: u32 = 1 << 11;

/// Opacity of what must never be seen, as a base-2 logarithm. WGSL may assume that no number is
/// infinite, so minus infinity does not travel.
const INVISIBLE: f32 = -1e30;

/// All chunks on one device.
#[derive(Debug, Default)]
pub(super) struct Mirror {
    pages: Vec<Option<Page>>,
    /// By address, which is a chunk's own for as long as the weak pointer lives.
    resident: BTreeMap<usize, Resident>,
}

/// One buffer: a binding is limited, so a scene may need several.
#[derive(Debug)]
struct Page {
    sh_degree: u8,
    buffer: Buffer,
    clusters: u32,
    free: Vec<Range<u32>>,
}

#[derive(Debug)]
struct Resident {
    chunk: Weak<Chunk>,
    runs: Vec<Run>,
}

/// Consecutive clusters of a chunk on one page.
#[derive(Clone, Debug)]
pub(super) struct Run {
    /// Which page.
    pub(super) page: usize,
    /// Its clusters of the page.
    pub(super) clusters: Range<u32>,
}

impl Mirror {
    /// Makes a scene resident. What main memory has dropped is dropped here too.
    pub(super) fn hold(&mut self, device: &Device, scene: &Scene) {
        let missing: Vec<&Arc<Chunk>> = {
            let is_missing = |chunk: &&Arc<Chunk>| !self.resident.contains_key(&address(chunk));
            scene.chunks.iter().filter(is_missing).collect()
        };
        self.drop_dead();
        if missing.is_empty() {
            return;
        }
        // A dead chunk's address may have been taken by another chunk only after it was dropped
        // here, since the weak pointer keeps the allocation: what was not missing still is not.
        let mut needed: u32 = missing.iter().map(|chunk| chunk.clusters().len() as u32).sum();
        for chunk in missing {
            let mut runs = Vec::new();
            let mut rest = chunk.clusters().len() as u32;
            while rest > 0 {
                let run = match self.take(chunk.sh_degree(), rest) {
                    Some(run) => run,
                    None => self.take_from_new_page(device, chunk.sh_degree(), rest, needed),
                };
                let count = run.clusters.end - run.clusters.start;
                rest -= count;
                needed -= count;
                runs.push(run);
            }
            self.upload(device, chunk, &runs);
            let resident = Resident { chunk: Arc::downgrade(chunk), runs };
            self.resident.insert(address(chunk), resident);
        }
    }

    /// Where a chunk's clusters lie, in order. Empty unless [`Mirror::hold`] has seen it.
    pub(super) fn runs(&self, chunk: &Arc<Chunk>) -> &[Run] {
        self.resident.get(&address(chunk)).map_or(&[], |resident| &resident.runs)
    }

    /// The buffer of a page.
    pub(super) fn page(&self, page: usize) -> Option<&Buffer> {
        self.pages.get(page)?.as_ref().map(|page| &page.buffer)
    }

    /// Pages, those that are gone included.
    pub(super) fn pages(&self) -> usize {
        self.pages.len()
    }

    /// Device memory held, in bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.pages.iter().flatten().map(|page| page.buffer.size()).sum()
    }

    fn drop_dead(&mut self) {
        let pages = &mut self.pages;
        self.resident.retain(|_, resident| {
            let lives = resident.chunk.strong_count() > 0;
            if !lives {
                for run in &resident.runs {
                    if let Some(page) = &mut pages[run.page] {
                        page.free(run.clusters.clone());
                    }
                }
            }
            lives
        });
        for slot in pages {
            if slot.as_ref().is_some_and(Page::is_unused) {
                *slot = None;
            }
        }
    }

    /// Takes up to `most` consecutive clusters of a page of this degree.
    fn take(&mut self, sh_degree: u8, most: u32) -> Option<Run> {
        self.pages.iter_mut().enumerate().find_map(|(index, slot)| {
            let page = slot.as_mut().filter(|page| page.sh_degree == sh_degree)?;
            Some(Run { page: index, clusters: page.take(most)? })
        })
    }

    /// Adds a page for `needed` clusters, or as many as one binding holds, and takes up to `most`.
    fn take_from_new_page(
        &mut self,
        device: &Device,
        sh_degree: u8,
        most: u32,
        needed: u32,
    ) -> Run {
        let bytes = cluster_words(sh_degree) as u64 * 4;
        let clusters = u64::from(needed).clamp(1, device.binding_bytes() / bytes) as u32;
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = device.buffer("gaussians", bytes * u64::from(clusters), usage);
        let taken = 0..most.min(clusters);
        let mut page = Page { sh_degree, buffer, clusters, free: Vec::new() };
        if taken.end < clusters {
            page.free.push(taken.end..clusters);
        }
        let index = self.pages.iter().position(Option::is_none).unwrap_or(self.pages.len());
        if index == self.pages.len() {
            self.pages.push(None);
        }
        self.pages[index] = Some(page);
        Run { page: index, clusters: taken }
    }

    fn upload(&self, device: &Device, chunk: &Chunk, runs: &[Run]) {
        let words = cluster_words(chunk.sh_degree());
        let mut next = 0;
        for Run { page, clusters } in runs {
            let Some(buffer) = self.page(*page) else { continue };
            for first in clusters.clone().step_by(UPLOAD_CLUSTERS as usize) {
                let count = UPLOAD_CLUSTERS.min(clusters.end - first) as usize;
                let mut block = vec![0; count * words];
                block.par_chunks_exact_mut(words).enumerate().for_each(|(k, cluster)| {
                    encode(chunk, next + k, cluster);
                });
                next += count;
                let offset = u64::from(first) * words as u64 * 4;
                device.write_now(buffer, offset, bytemuck::cast_slice(&block));
            }
        }
    }
}

impl Page {
    fn take(&mut self, most: u32) -> Option<Range<u32>> {
        let range = self.free.first_mut()?;
        let taken = range.start..range.end.min(range.start + most);
        range.start = taken.end;
        if range.start == range.end {
            self.free.remove(0);
        }
        Some(taken)
    }

    fn free(&mut self, range: Range<u32>) {
        let place = self.free.partition_point(|free| free.start < range.start);
        self.free.insert(place, range);
        self.free.dedup_by(|next, before| {
            let adjoins = before.end == next.start;
            if adjoins {
                before.end = next.end;
            }
            adjoins
        });
    }

    fn is_unused(&self) -> bool {
        self.free.first() == Some(&(0..self.clusters))
    }
}

fn address(chunk: &Arc<Chunk>) -> usize {
    Arc::as_ptr(chunk) as usize
}

/// Words of a cluster of a degree.
fn cluster_words(sh_degree: u8) -> usize {
    let color = (3 * sh::coefficients(sh_degree)).div_ceil(2);
    CLUSTER_HEADER_WORDS as usize + CLUSTER * (GEOMETRY_WORDS as usize + color)
}

/// Encodes cluster `index` of a chunk; places without a Gaussian are invisible.
fn encode(chunk: &Chunk, index: usize, words: &mut [u32]) {
    let values = 3 * sh::coefficients(chunk.sh_degree());
    let (header, columns) = words.split_at_mut(CLUSTER_HEADER_WORDS as usize);
    let first = index * CLUSTER;
    let count = (chunk.len() - first).min(CLUSTER);
    let largest = |range: Range<usize>| {
        let of = |i| range.clone().map(move |c| chunk.value(first + i, column::SH + c).abs());
        (0..count).flat_map(of).fold(0.0, f32::max).max(f32::MIN_POSITIVE)
    };
    let scales = [largest(0..3), largest(3..values)];
    header[..2].copy_from_slice(&scales.map(f32::to_bits));
    let (geometry, colors) = columns.split_at_mut(CLUSTER * GEOMETRY_WORDS as usize);
    geometry[CLUSTER * 6 + count..CLUSTER * 7].fill(INVISIBLE.to_bits());
    for i in 0..count {
        let value = |column| chunk.value(first + i, column);
        let mut set = |word: usize, bits| geometry[CLUSTER * word + i] = bits;
        for axis in 0..3 {
            set(axis, value(column::MEAN + axis).to_bits());
            set(3 + axis, value(column::SCALE + axis).to_bits());
        }
        set(6, value(column::LOG2_OPACITY).max(INVISIBLE).to_bits());
        let [low, high] = quat_bits([0, 1, 2, 3].map(|k| value(column::QUAT + k)));
        set(7, low);
        set(8, high);
        let fraction = |j: usize| {
            let scale = scales[usize::from(j >= 3)];
            if j < values { (value(column::SH + j) / scale * 32_767.0).round() as i16 } else { 0 }
        };
        for j in (0..values).step_by(2) {
            let (low, high) = (fraction(j) as u16, fraction(j + 1) as u16);
            colors[CLUSTER * (j / 2) + i] = u32::from(low) | u32::from(high) << 16;
        }
    }
}

/// A unit quaternion in 62 bits: which component is the largest, and the other three, at most √½,
/// in 20 bits each. Off by at most 7e-7: a needle of 10,000 px moves by less than 0.01 px. (With
/// 16 bits for each of four it would move by 0.2 px.)
fn quat_bits(wxyz: [f32; 4]) -> [u32; 2] {
    let mut index = 0;
    for k in 1..4 {
        if wxyz[k].abs() > wxyz[index].abs() {
            index = k;
        }
    }
    // q and -q are one rotation, so the largest can be made positive.
    let sign = f64::from(wxyz[index].signum());
    let steps = |value: f32| {
        let share = sign * f64::from(value) * std::f64::consts::SQRT_2 * 0.5 + 0.5;
        (share.clamp(0.0, 1.0) * 1_048_575.0).round() as u64
    };
    let small = (0..4).filter(|&k| k != index).map(|k| steps(wxyz[k]));
    let bits = small.enumerate().fold((index as u64) << 60, |bits, (k, s)| bits | s << (20 * k));
    [bits as u32, (bits >> 32) as u32]
}
