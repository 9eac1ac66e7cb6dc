//! LiDAR sweeps on the device.
//!
//! The host finds the candidates of each tile of 16 x 16 beams as the cpu backend does
//! ([`crate::cpu::lidar`]), sector by sector on all cores, and the device compares the beams with
//! them. Both backends do that in f32, so that their ranges differ by rounding alone. WGSL:
//! `shaders/lidar.wgsl`. A sweep takes one turn of the device: see `gpu/mod.rs`.
//!
//! The device has the hits of one sector at a time, up to [`MOST_HITS`] of each beam: 23 MB for 128
//! rows and 64 columns. Submissions run in order, so the next sector overwrites them. A device on
//! which nothing asks for a sweep has neither the kernels nor these buffers.

use std::collections::VecDeque;

use bytemuck::{Pod, Zeroable};
use parking_lot::Mutex;
use rayon::ThreadPool;
use rayon::prelude::*;
use wgpu::{Buffer, BufferUsages, CommandEncoderDescriptor, PollType, SubmissionIndex};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, Kernel, Recorder, module};
use super::layout::WORKGROUP;
use super::read_back::{ReadBack, mapped};
use crate::RenderError;
use crate::cpu::lidar::{
    BodySector, Candidate, Candidates, MOST_COLUMNS, Reach, Sector, best_level,
    most_candidate_bytes, search,
};
use crate::lidar::{Keys, MOST_HITS, Sweep, Task};
use wildcity_scene::geometry::Lidar;

/// As in `lidar.wgsl` (48 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct GpuSector {
    rows: u32,
    width: u32,
    columns: u32,
    first_column: u32,
    first_entry: u32,
    entries: u32,
    most_hits: u32,
    is_first: u32,
    min_range_m: f32,
    max_range_m: f32,
    alpha_cap: f32,
    padding: u32,
}

/// As in `lidar.wgsl` (80 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct GpuCandidate {
    mean_m: [f32; 3],
    log2_opacity: f32,
    whiten_x: [f32; 3],
    reach2: f32,
    whiten_y: [f32; 3],
    nearest_m: f32,
    whiten_z: [f32; 3],
    luminance: f32,
    rows: u32,
    key: u32,
    padding: [u32; 2],
}

/// As in `lidar.wgsl` (64 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct GpuColumn {
    forward: [f32; 3],
    cos_azimuth: f32,
    left: [f32; 3],
    sin_azimuth: f32,
    up: [f32; 3],
    padding: f32,
    origin_m: [f32; 3],
    padding_too: f32,
}

/// As in `lidar.wgsl` (12 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct GpuReturn {
    range_m: f32,
    luminance: f32,
    key: u32,
}

/// Bytes of a hit in `lidar.wgsl`.
const HIT_BYTES: u64 = 16;
/// Bytes of a beam there.
const BEAM_BYTES: u64 = 12;

/// The kernels, their input, and the state of the sector that is compared.
#[derive(Debug)]
pub(super) struct SweepKernels {
    trace: Kernel,
    finish: Kernel,
    sector: GrowableBuffer,
    candidates: GrowableBuffer,
    lists: GrowableBuffer,
    entries: GrowableBuffer,
    columns: GrowableBuffer,
    rows: GrowableBuffer,
    hits: GrowableBuffer,
    beams: GrowableBuffer,
    returns: GrowableBuffer,
    read_back: ReadBack,
    /// The last submissions. The device must be done with the first of [`IN_FLIGHT`] of them before
    /// the next one, so that copies of candidates do not accumulate.
    pending: VecDeque<SubmissionIndex>,
}

/// Submissions that the device may have at once.
const IN_FLIGHT: usize = 4;

/// Candidates of a sector that the device gets at a time, with room for a cluster more. They, and
/// their places in the lists of tiles, are in memory at once, 6 to 23 MB.
const BATCH: usize = 1 << 15;

/// What the device gets of a sector at a time: candidates of one body.
struct Batch {
    candidates: Vec<GpuCandidate>,
    /// For each tile, the place of its first entry; then the number of all.
    lists: Vec<u32>,
    entries: Vec<u32>,
    columns: Vec<GpuColumn>,
    /// Length of the longest list.
    longest: usize,
}

impl SweepKernels {
    pub(super) fn new(device: &Device) -> Self {
        let module = module(device, "lidar");
        let input = |label| {
            GrowableBuffer::new(device, label, BufferUsages::STORAGE | BufferUsages::COPY_DST)
        };
        let state = |label| GrowableBuffer::new(device, label, BufferUsages::STORAGE);
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let returned = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        Self {
            trace: Kernel::new(device, &module, "trace", &[]),
            finish: Kernel::new(device, &module, "finish", &[]),
            sector: GrowableBuffer::new(device, "sector", uniform),
            candidates: input("candidates"),
            lists: input("lists of candidates"),
            entries: input("entries of lists"),
            columns: input("LiDAR columns"),
            rows: input("LiDAR rows"),
            hits: state("hits"),
            beams: state("beams"),
            returns: GrowableBuffer::new(device, "returns", returned),
            read_back: ReadBack::new(device),
            pending: VecDeque::new(),
        }
    }

    /// Whether a device can bind the hits and the candidates of a sector, and the returns.
    pub(super) fn fit(binding_bytes: u64, lidar: &Lidar) -> bool {
        let beams = lidar.rows() * lidar.columns().min(MOST_COLUMNS);
        let hits = HIT_BYTES * (beams * MOST_HITS) as u64;
        let returns = (size_of::<GpuReturn>() * lidar.beams()) as u64;
        hits.max(returns).max(most_candidate_bytes(lidar, BATCH) as u64) <= binding_bytes
    }

    /// An upper bound of the memory that the host takes for a sweep, in bytes: its returns, the
    /// candidates of each thread, and the copies of them that the device has not taken.
    pub(super) fn host_bytes(lidar: &Lidar, threads: usize) -> u64 {
        let returns = lidar.beams() * (Sweep::BEAM_BYTES + size_of::<GpuReturn>());
        let threads = threads.min(lidar.columns());
        // Each thread makes a copy, too.
        (returns + (2 * threads + IN_FLIGHT) * most_candidate_bytes(lidar, BATCH)) as u64
    }

    /// The sweep of a LiDAR. The candidates are found in `pool`.
    ///
    /// # Errors
    /// The device fails, or is lost meanwhile.
    pub(super) fn sweep(
        &mut self,
        device: &Device,
        timestamps: &Buffer,
        pool: &ThreadPool,
        task: &Task<'_>,
    ) -> Result<Sweep, RenderError> {
        let sectors = Sector::split(task.view);
        self.begin(device, &sectors, &task.view.lidar);
        let level = best_level();
        let kernels = Mutex::new(&mut *self);
        let free: Mutex<Vec<Candidates>> = Mutex::default();
        pool.install(|| {
            sectors.par_iter().for_each(|sector| {
                let mut candidates = free.lock().pop().unwrap_or_default();
                // Held from the first candidates of the sector to the last.
                let mut held = None;
                search(level, sector, &mut candidates, task, BATCH, |_, seen, candidates| {
                    // Gaussians between two columns are in no list.
                    let Some(batch) = Batch::new(seen, candidates) else { return };
                    let is_first = held.is_none();
                    let kernels = held.get_or_insert_with(|| kernels.lock());
                    kernels.trace(device, &batch, &gpu_sector(task, sector), is_first);
                });
                if let Some(mut kernels) = held {
                    kernels.finish(device, &gpu_sector(task, sector));
                }
                free.lock().push(candidates);
            });
        });
        self.read(device, timestamps, task.view.lidar.beams(), &task.keys)
    }

    /// Makes room for a sweep without any return.
    fn begin(&mut self, device: &Device, sectors: &[Sector], lidar: &Lidar) {
        let rows = lidar.rows();
        let widest = sectors.iter().map(|sector| sector.columns.len()).max().unwrap_or(0);
        self.hits.reserve(device, HIT_BYTES * (rows * widest * MOST_HITS) as u64);
        self.beams.reserve(device, BEAM_BYTES * (rows * widest) as u64);
        self.returns.reserve(device, (size_of::<GpuReturn>() * lidar.beams()) as u64);
        // A LiDAR has a sector at least.
        let angles: Vec<[f32; 4]> =
            sectors[0].rows.angles.iter().map(|angles| angles.map(|value| value as f32)).collect();
        self.rows.fill(device, bytemuck::cast_slice(&angles));
        let descriptor = CommandEncoderDescriptor { label: Some("sweep") };
        let mut encoder = device.device.create_command_encoder(&descriptor);
        // A sector without candidates runs no kernel, and its beams have no returns.
        encoder.clear_buffer(self.returns.buffer(), 0, None);
        device.queue.submit([encoder.finish()]);
    }

    /// Compares the beams of a sector with a batch of candidates; the first batch begins it.
    fn trace(&mut self, device: &Device, batch: &Batch, sector: &GpuSector, is_first: bool) {
        self.candidates.fill(device, bytemuck::cast_slice(&batch.candidates));
        self.lists.fill(device, bytemuck::cast_slice(&batch.lists));
        self.entries.fill(device, bytemuck::cast_slice(&batch.entries));
        self.columns.fill(device, bytemuck::cast_slice(&batch.columns));
        let at_once = device.max_traced_candidates() as usize;
        // A software device leaves long loops early, so long lists take several dispatches.
        for first in (0..batch.longest).step_by(at_once) {
            let sector = GpuSector {
                first_entry: first as u32,
                entries: at_once.min(batch.longest - first) as u32,
                is_first: u32::from(is_first && first == 0),
                ..*sector
            };
            let tiles = batch.lists.len() as u32 - 1;
            self.run(device, &sector, |kernels, recorder| {
                let resources = [
                    (0, kernels.sector.bind()),
                    (1, kernels.candidates.bind()),
                    (2, kernels.lists.bind()),
                    (3, kernels.entries.bind()),
                    (4, kernels.columns.bind()),
                    (5, kernels.rows.bind()),
                    (6, kernels.hits.bind()),
                    (7, kernels.beams.bind()),
                ];
                let mut pass = recorder.stage("trace");
                kernels.trace.run(device, &mut pass, Groups::Count(tiles), &resources);
            });
        }
    }

    /// Writes the returns of a sector whose candidates have all been compared.
    fn finish(&mut self, device: &Device, sector: &GpuSector) {
        self.run(device, sector, |kernels, recorder| {
            let resources = [
                (0, kernels.sector.bind()),
                (6, kernels.hits.bind()),
                (7, kernels.beams.bind()),
                (8, kernels.returns.bind()),
            ];
            let groups = Groups::Count((sector.rows * sector.width).div_ceil(WORKGROUP));
            let mut pass = recorder.stage("finish");
            kernels.finish.run(device, &mut pass, groups, &resources);
        });
    }

    /// Submits a kernel of a sector.
    fn run(
        &mut self,
        device: &Device,
        sector: &GpuSector,
        record: impl FnOnce(&Self, &mut Recorder),
    ) {
        self.sector.fill(device, bytemuck::bytes_of(sector));
        let mut recorder = Recorder::new(device, None);
        record(self, &mut recorder);
        if self.pending.len() == IN_FLIGHT {
            let timeout = Some(device.frame_timeout());
            let wait = PollType::Wait { submission_index: self.pending.pop_front(), timeout };
            // A device that fails or does not answer is noticed when the returns are read.
            let _ = device.device.poll(wait);
        }
        self.pending.push_back(device.queue.submit([recorder.encoder.finish()]));
    }

    fn read(
        &mut self,
        device: &Device,
        timestamps: &Buffer,
        beams: usize,
        keys: &Keys,
    ) -> Result<Sweep, RenderError> {
        let bytes = (size_of::<GpuReturn>() * beams) as u64;
        let recorder = Recorder::new(device, None);
        let sources = [(self.returns.buffer(), bytes)];
        let (_, submission) = self.read_back.submit(device, recorder, &sources, timestamps);
        self.read_back.map(device, submission)?;
        // Submissions run in order, so these are done as well as the last one, which was waited
        // for.
        self.pending.clear();
        let mut sweep = Sweep::empty(beams);
        {
            let pages = self.read_back.pages(device)?;
            // The page may be larger than this sweep.
            let found: &[GpuReturn] = mapped(device, &pages[0][..bytes as usize])?;
            for (at, found) in found.iter().enumerate().filter(|(_, found)| found.range_m > 0.0) {
                sweep.range_m[at] = found.range_m;
                sweep.intensity[at] = found.luminance;
                sweep.instance[at] = keys.instance(found.key);
                sweep.gaussian[at] = found.key;
            }
        }
        self.read_back.unmap();
        Ok(sweep)
    }
}

/// A sector without any entries.
fn gpu_sector(task: &Task<'_>, sector: &Sector) -> GpuSector {
    GpuSector {
        rows: task.view.lidar.rows() as u32,
        width: sector.columns.len() as u32,
        columns: task.view.lidar.columns() as u32,
        first_column: sector.columns.start as u32,
        most_hits: MOST_HITS as u32,
        min_range_m: sector.min_range_m,
        max_range_m: sector.max_range_m,
        alpha_cap: task.profile.alpha_cap as f32,
        ..GpuSector::zeroed()
    }
}

impl Batch {
    /// `None` if no tile has a candidate.
    fn new(seen: &BodySector<'_>, candidates: &Candidates) -> Option<Self> {
        let longest = candidates.lists.iter().map(Vec::len).max().filter(|longest| *longest > 0)?;
        let mut lists = vec![0];
        let mut count = 0;
        for entries in &candidates.lists {
            count += entries.len() as u32;
            // The list of a tile ends where that of the next one begins.
            lists.push(count);
        }
        Some(Self {
            candidates: candidates
                .list
                .iter()
                .zip(&candidates.reaches)
                .map(|(candidate, reach)| GpuCandidate::new(candidate, reach))
                .collect(),
            lists,
            entries: candidates.lists.concat(),
            columns: seen.sector.columns.clone().map(|at| column(seen, at)).collect(),
            longest,
        })
    }
}

impl GpuCandidate {
    fn new(candidate: &Candidate, reach: &Reach) -> Self {
        let Candidate { mean_m, whiten, log2_opacity, reach2, luminance, key } = *candidate;
        let [xx, xy, xz, yx, yy, yz, zx, zy, zz] = whiten;
        let [first, end] = reach.rows.map(u32::from);
        Self {
            mean_m,
            log2_opacity,
            whiten_x: [xx, xy, xz],
            reach2,
            whiten_y: [yx, yy, yz],
            nearest_m: reach.nearest_m,
            whiten_z: [zx, zy, zz],
            luminance,
            // A LiDAR has at most 256 rows, so both numbers fit 16 bits.
            rows: first | end << 16,
            key,
            padding: [0; 2],
        }
    }
}

/// A column as a body sees it.
fn column(seen: &BodySector<'_>, column: usize) -> GpuColumn {
    let pose = &seen.poses[column - seen.sector.columns.start];
    let axes = pose.rotation_matrix();
    let [cos_azimuth, sin_azimuth] = seen.sector.azimuth(column).map(|value| value as f32);
    GpuColumn {
        forward: axes.x_axis.as_vec3().to_array(),
        cos_azimuth,
        left: axes.y_axis.as_vec3().to_array(),
        sin_azimuth,
        up: axes.z_axis.as_vec3().to_array(),
        padding: 0.0,
        origin_m: seen.relative_to_middle(pose.position_m).as_vec3().to_array(),
        padding_too: 0.0,
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use naga::{Module, TypeInner};

    use super::*;
    use crate::gpu::shaders::Shaders;

    /// Offsets of the fields of a struct, and its size.
    fn layout(module: &Module, name: &str) -> (Vec<usize>, u64) {
        let named = |(_, ty): &(_, &naga::Type)| ty.name.as_deref() == Some(name);
        match &module.types.iter().find(named).unwrap().1.inner {
            TypeInner::Struct { members, span } => {
                let offsets = members.iter().map(|member| member.offset as usize);
                (offsets.collect(), u64::from(*span))
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn structs_are_those_of_the_shader() {
        let module = naga::front::wgsl::parse_str(Shaders::default().get("lidar")).unwrap();
        macro_rules! check {
            ($rust:ident, $wgsl:literal, $($field:ident),+) => {
                let offsets = vec![$(offset_of!($rust, $field)),+];
                assert_eq!(layout(&module, $wgsl), (offsets, size_of::<$rust>() as u64));
            };
        }
        check!(
            GpuSector,
            "Sector",
            rows,
            width,
            columns,
            first_column,
            first_entry,
            entries,
            most_hits,
            is_first,
            min_range_m,
            max_range_m,
            alpha_cap,
            padding
        );
        check!(
            GpuCandidate,
            "Candidate",
            mean_m,
            log2_opacity,
            whiten_x,
            reach2,
            whiten_y,
            nearest_m,
            whiten_z,
            luminance,
            rows,
            key,
            padding
        );
        check!(
            GpuColumn,
            "Column",
            forward,
            cos_azimuth,
            left,
            sin_azimuth,
            up,
            padding,
            origin_m,
            padding_too
        );
        check!(GpuReturn, "Return", range_m, luminance, key);
        assert_eq!(layout(&module, "Hit").1, HIT_BYTES);
        assert_eq!(layout(&module, "Beam").1, BEAM_BYTES);
    }
}
