//! Stage sort: a stable LSD radix sort with 8 bits per pass, of splats by (view, depth) and of
//! touches by macro tile. Twin of `render/cpu/sort.rs`; WGSL: `shaders/sort.wgsl`, and
//! `shaders/sort_ballots.wgsl` for devices with subgroups of 32 or 64 threads.

use wgpu::{BufferUsages, ComputePass, ShaderModule};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, JobRef, Kernel, module};
use super::layout::{DIGITS, SORT_BLOCK};
use super::scan::Scan;
use super::tuning::Scatter;

/// Bits of a digit.
pub(super) const DIGIT_BITS: u32 = DIGITS.ilog2();

/// The kernels of each pass, and the counters between them.
#[derive(Debug)]
pub(super) struct Sort {
    /// One for each digit of 32-bit keys, from the least significant.
    passes: Vec<Pass>,
    offsets: GrowableBuffer,
    ballots: Option<Ballots>,
}

/// What the kernels with ballots need in addition. They sort the keys of splats. Those of touches
/// differ in few bits, so that neighbours stay together anyway: on an H100 they would gain between
/// nothing and a tenth.
#[derive(Debug)]
struct Ballots {
    scan: Kernel,
    /// The number of keys of each digit.
    totals: GrowableBuffer,
}

impl Ballots {
    fn new(device: &Device, module: &ShaderModule) -> Self {
        let mut totals = GrowableBuffer::new(device, "digit totals", BufferUsages::STORAGE);
        totals.reserve(device, 4 * u64::from(DIGITS));
        Self { scan: Kernel::new(device, module, "scan_digits", &[("SHIFT", 0.0)]), totals }
    }
}

#[derive(Debug)]
struct Pass {
    histogram: Kernel,
    scatter: Kernel,
    scatter_masked: Kernel,
}

impl Pass {
    /// The kernels of a digit; `ballots` is another shader for those that move keys.
    fn new(
        device: &Device,
        plain: &ShaderModule,
        ballots: Option<&ShaderModule>,
        digit: u32,
    ) -> Self {
        let shift = [("SHIFT", f64::from(DIGIT_BITS * digit))];
        let kernel = |module, entry| Kernel::new(device, module, entry, &shift);
        Self {
            histogram: kernel(plain, "histogram"),
            scatter: kernel(ballots.unwrap_or(plain), "scatter"),
            scatter_masked: kernel(plain, "scatter_masked"),
        }
    }
}

/// The buffers of a sort. Each pass moves the data from one buffer of a pair to the other.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns<'a> {
    pub(super) keys: &'a [GrowableBuffer; 2],
    /// A value for each key.
    pub(super) values: &'a [GrowableBuffer; 2],
    /// A second value for each key, if there is one.
    pub(super) masks: Option<&'a [GrowableBuffer; 2]>,
}

/// The jobs of a sort.
#[derive(Clone, Copy, Debug)]
pub(super) struct SortJobs<'a> {
    /// All keys, in blocks of [`SORT_BLOCK`].
    pub(super) keys: JobRef<'a>,
    /// The counters of all digits of all blocks.
    pub(super) counters: JobRef<'a>,
}

impl Sort {
    pub(super) fn new(device: &Device) -> Self {
        let plain = module(device, "sort");
        let ballots = match device.tuning().scatter {
            Scatter::Plain => None,
            Scatter::Ballots => Some(module(device, "sort_ballots")),
            Scatter::EmulatedBallots => Some(module(device, "sort_ballots_emulated")),
        };
        let pass = |digit: u32| Pass::new(device, &plain, ballots.as_ref(), digit);
        Self {
            passes: (0..u32::BITS / DIGIT_BITS).map(pass).collect(),
            offsets: GrowableBuffer::new(device, "digit offsets", BufferUsages::STORAGE),
            ballots: ballots.map(|module| Ballots::new(device, &module)),
        }
    }

    /// Makes room to sort `count` keys.
    pub(super) fn reserve(&mut self, device: &Device, scan: &mut Scan, count: u64) {
        let counters = u64::from(DIGITS) * count.div_ceil(u64::from(SORT_BLOCK));
        self.offsets.reserve(device, 4 * counters);
        scan.reserve(device, counters);
    }

    /// Sorts by the lowest `bits` of the keys. Returns which buffer of each pair has the result.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        scan: &Scan,
        jobs: SortJobs<'_>,
        columns: Columns<'_>,
        bits: u32,
    ) -> usize {
        let mut from = 0;
        let Columns { keys, values, masks } = columns;
        // Digits above the highest bit of any key are 0 in all keys, and change no order.
        for Pass { histogram, scatter, scatter_masked } in
            &self.passes[..bits.div_ceil(DIGIT_BITS) as usize]
        {
            let to = 1 - from;
            let counts = [(0, jobs.keys.bind()), (1, self.offsets.bind()), (2, keys[from].bind())];
            histogram.run(device, pass, Groups::Job(jobs.keys), &counts);
            let ballots = self.ballots.as_ref().filter(|_| masks.is_none());
            match ballots {
                Some(Ballots { scan, totals }) => {
                    let resources = [counts[0].clone(), counts[1].clone(), (6, totals.bind())];
                    // One workgroup for each value of a digit.
                    scan.run(device, pass, Groups::Count(DIGITS), &resources);
                }
                None => scan.run(device, pass, jobs.counters, self.offsets.buffer()),
            }
            let moved = [(3, values[from].bind()), (4, keys[to].bind()), (5, values[to].bind())];
            let mut all: Vec<_> = counts.into_iter().chain(moved).collect();
            let kernel = match masks {
                Some(masks) => {
                    all.extend([(6, masks[from].bind()), (7, masks[to].bind())]);
                    scatter_masked
                }
                None => {
                    all.extend(ballots.map(|ballots| (6, ballots.totals.bind())));
                    scatter
                }
            };
            kernel.run(device, pass, Groups::Job(jobs.keys), &all);
            from = to;
        }
        from
    }
}

#[cfg(test)]
mod tests {
    use wgpu::{Buffer, MapMode, PollType};

    use super::*;
    use crate::gpu::AdapterChoice;
    use crate::gpu::kernel::{Recorder, fold_groups};
    use crate::gpu::layout::{Job, JobSlot, SCAN_BLOCK};
    use crate::gpu::shaders::Shaders;
    use crate::gpu::tuning::Tuning;

    /// Bits of the keys.
    const BITS: u32 = 31;

    /// Stress case T21: as many keys as a binding holds, 2^25 on lavapipe, and 70 million at most.
    #[test]
    fn t21_as_many_keys_as_a_binding_holds() {
        let device = opened(None);
        check(&device, (device.binding_bytes() / 4).min(70_000_000) as u32);
    }

    /// More blocks than the prefix sum of a digit takes in one round. Other numbers leave part of a
    /// block.
    #[test]
    fn t21_with_ballots() {
        let scatter = Scatter::EmulatedBallots;
        let tuning = Tuning { long_tile_splats: u32::MAX, scatter };
        let device = opened(Some(tuning));
        for count in [(256 + 30) * SORT_BLOCK + 77, 3 * SORT_BLOCK, 33, 1] {
            check(&device, count);
        }
    }

    fn opened(tuning: Option<Tuning>) -> Device {
        Device::open(&AdapterChoice::Best, &Shaders::default(), u64::MAX, tuning)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers")
    }

    fn check(device: &Device, count: u32) {
        // Half a million distinct keys that differ in all four digits, so that 64 keys and more are
        // equal.
        let key = |i: u32| (i.wrapping_mul(0x9E37_79B9) ^ i >> 7) & 0x700F_F0FF;
        let keys: Vec<u32> = (0..count).map(key).collect();
        let (sorted_keys, sorted_values) = sort_on(device, &keys);
        let mut truth: Vec<u32> = (0..count).collect();
        truth.sort_by_key(|&i| key(i));
        assert!(sorted_values == truth, "the order is wrong or not stable");
        assert!(truth.iter().zip(&sorted_keys).all(|(&i, &sorted)| sorted == key(i)));
    }

    /// Keys and their indices, as the device sorts them.
    fn sort_on(device: &Device, unsorted: &[u32]) -> (Vec<u32>, Vec<u32>) {
        let mut scan = Scan::new(device);
        let mut sort = Sort::new(device);
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        let bytes = 4 * unsorted.len() as u64;
        let pair = || {
            let mut pair = ["even passes", "odd passes"]
                .map(|label| GrowableBuffer::new(device, label, usage));
            pair.iter_mut().for_each(|words| words.reserve(device, bytes));
            pair
        };
        let keys = pair();
        let values = pair();
        for (number, block) in unsorted.chunks(1 << 22).enumerate() {
            let first = (number << 22) as u32;
            let indices: Vec<u32> = (first..first + block.len() as u32).collect();
            device.write_now(keys[0].buffer(), 4 * u64::from(first), bytemuck::cast_slice(block));
            device.write_now(
                values[0].buffer(),
                4 * u64::from(first),
                bytemuck::cast_slice(&indices),
            );
        }
        let count = unsorted.len() as u32;
        sort.reserve(device, &mut scan, bytes / 4);
        let counters = DIGITS * count.div_ceil(SORT_BLOCK);
        let slots = [job(count, SORT_BLOCK), job(counters, SCAN_BLOCK)];
        let jobs = device.buffer("jobs", 512, usage | BufferUsages::INDIRECT);
        device.write_now(&jobs, 0, bytemuck::cast_slice(&slots));

        let mut recorder = Recorder::new(device, None);
        let mut pass = recorder.stage("sort");
        let data = Columns { keys: &keys, values: &values, masks: None };
        let job = |slot| JobRef { jobs: &jobs, slot };
        let sort_jobs = SortJobs { keys: job(0), counters: job(1) };
        let sorted = sort.run(device, &mut pass, &scan, sort_jobs, data, BITS);
        drop(pass);
        let read = [keys[sorted].buffer(), values[sorted].buffer()].map(|from| {
            let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
            let to = device.buffer("read back", bytes, usage);
            recorder.encoder.copy_buffer_to_buffer(from, 0, &to, 0, bytes);
            to
        });
        device.queue.submit([recorder.encoder.finish()]);
        // Buffers are larger than a few keys.
        let [keys, values] = read.map(|buffer| words(device, &buffer)[..unsorted.len()].to_vec());
        device.check().unwrap();
        (keys, values)
    }

    /// A slot as `plan.wgsl` writes it.
    fn job(length: u32, per_group: u32) -> JobSlot {
        let job = Job { length, groups: fold_groups(length.div_ceil(per_group)) };
        JobSlot { job, pad: [[0; 4]; 15] }
    }

    fn words(device: &Device, buffer: &Buffer) -> Vec<u32> {
        buffer.slice(..).map_async(MapMode::Read, |mapped| mapped.unwrap());
        device.device.poll(PollType::wait_indefinitely()).unwrap();
        let view = buffer.slice(..).get_mapped_range().unwrap();
        bytemuck::pod_collect_to_vec(&view)
    }
}
