//! Stage sort, of splats by (view, depth) and of touches by macro tile: a stable radix sort, 8 bits a
//! pass. Twin of `render/cpu/sort.rs`; WGSL: `shaders/sort.wgsl`.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, module, slot};
use super::layout::{DIGITS, Job, SORT_BLOCK};
use super::scan::Scan;
use super::shaders::Shaders;

/// Bits of a digit.
pub(super) const DIGIT_BITS: u32 = DIGITS.ilog2();

/// The kernels of each pass, and the counters between them.
#[derive(Debug)]
pub(super) struct Sort {
    /// By the digit's number.
    passes: Vec<Pass>,
    offsets: Growing,
}

#[derive(Debug)]
struct Pass {
    histogram: Kernel,
    scatter: Kernel,
    scatter_masked: Kernel,
}

/// What is sorted, to and fro between two buffers each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns<'a> {
    /// What it is sorted by.
    pub(super) keys: &'a [Growing; 2],
    /// What goes with each key.
    pub(super) values: &'a [Growing; 2],
    /// What goes with it beside, perhaps.
    pub(super) masks: Option<&'a [Growing; 2]>,
}

impl Sort {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let module = module(device, shaders, "sort");
        let pass = |digit: u32| {
            let constants = [("SHIFT", f64::from(DIGIT_BITS * digit))];
            let kernel = |entry| Kernel::new(device, &module, entry, &constants);
            Pass {
                histogram: kernel("histogram"),
                scatter: kernel("scatter"),
                scatter_masked: kernel("scatter_masked"),
            }
        };
        Self {
            passes: (0..u32::BITS / DIGIT_BITS).map(pass).collect(),
            offsets: Growing::new(device, "digit offsets", BufferUsages::STORAGE),
        }
    }

    /// Makes room to sort `count` keys.
    pub(super) fn reserve(&mut self, device: &Device, scan: &mut Scan, count: u64) {
        let counters = u64::from(DIGITS) * count.div_ceil(u64::from(SORT_BLOCK));
        self.offsets.reserve(device, 4 * counters);
        scan.reserve(device, counters);
    }

    /// Sorts by the lowest `bits` of the keys. Returns which of the two buffers has the result.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        scan: &Scan,
        (jobs, sort, digits): (&Buffer, u64, u64),
        columns: Columns<'_>,
        bits: u32,
    ) -> usize {
        let mut from = 0;
        let Columns { keys, values, masks } = columns;
        for Pass { histogram, scatter, scatter_masked } in
            &self.passes[..bits.div_ceil(DIGIT_BITS) as usize]
        {
            let to = 1 - from;
            let counts = [
                (0, slot(jobs, sort, size_of::<Job>())),
                (1, self.offsets.bind()),
                (2, keys[from].bind()),
            ];
            histogram.run(device, pass, Groups::Job(jobs, sort), &counts);
            scan.run(device, pass, (jobs, digits), self.offsets.buffer());
            let moved = [(3, values[from].bind()), (4, keys[to].bind()), (5, values[to].bind())];
            let mut all: Vec<_> = counts.into_iter().chain(moved).collect();
            let kernel = match masks {
                Some(masks) => {
                    all.extend([(6, masks[from].bind()), (7, masks[to].bind())]);
                    scatter_masked
                }
                None => scatter,
            };
            kernel.run(device, pass, Groups::Job(jobs, sort), &all);
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
    use crate::gpu::kernel::Recorder;
    use crate::gpu::layout::{JobSlot, MAX_GROUPS, SCAN_BLOCK};

    /// Bits of the keys.
    const BITS: u32 = 31;

    /// Stress case T21: as many keys as a binding holds, 2^25 on lavapipe, and 70 million at most.
    #[test]
    fn t21_as_many_keys_as_a_binding_holds() {
        let device = Device::open(&AdapterChoice::Best, u64::MAX)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers");
        let count = (device.binding_bytes() / 4).min(70_000_000) as u32;
        // Half a million values in all four digits, so that 64 keys and more are equal.
        let key = |i: u32| (i.wrapping_mul(0x9E37_79B9) ^ i >> 7) & 0x700F_F0FF;
        let keys: Vec<u32> = (0..count).map(key).collect();
        let (sorted_keys, sorted_values) = sort_on(&device, &keys);
        let mut truth: Vec<u32> = (0..count).collect();
        truth.sort_by_key(|&i| key(i));
        assert!(sorted_values == truth, "the order is another, or not stable");
        assert!(truth.iter().zip(&sorted_keys).all(|(&i, &sorted)| sorted == key(i)));
    }

    /// Keys and their indices, sorted by the device.
    fn sort_on(device: &Device, unsorted: &[u32]) -> (Vec<u32>, Vec<u32>) {
        let shaders = Shaders::default();
        let (mut scan, mut sort) = (Scan::new(device, &shaders), Sort::new(device, &shaders));
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        let bytes = 4 * unsorted.len() as u64;
        let pair = || {
            let mut pair = [Growing::new(device, "to", usage), Growing::new(device, "fro", usage)];
            pair.iter_mut().for_each(|words| words.reserve(device, bytes));
            pair
        };
        let (keys, values) = (pair(), pair());
        for (number, block) in unsorted.chunks(1 << 22).enumerate() {
            let first = (number << 22) as u32;
            let places: Vec<u32> = (first..first + block.len() as u32).collect();
            device.write_now(keys[0].buffer(), 4 * u64::from(first), bytemuck::cast_slice(block));
            device.write_now(
                values[0].buffer(),
                4 * u64::from(first),
                bytemuck::cast_slice(&places),
            );
        }
        let count = unsorted.len() as u32;
        sort.reserve(device, &mut scan, bytes / 4);
        let slots = [job(count, SORT_BLOCK), job(DIGITS * count.div_ceil(SORT_BLOCK), SCAN_BLOCK)];
        let jobs = device.buffer("jobs", 512, usage | BufferUsages::INDIRECT);
        device.write_now(&jobs, 0, bytemuck::cast_slice(&slots));

        let mut recorder = Recorder::new(device, None);
        let mut pass = recorder.stage("sort");
        let data = Columns { keys: &keys, values: &values, masks: None };
        let sorted = sort.run(device, &mut pass, &scan, (&jobs, 0, 1), data, BITS);
        drop(pass);
        let read = [keys[sorted].buffer(), values[sorted].buffer()].map(|from| {
            let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
            let to = device.buffer("read back", bytes, usage);
            recorder.encoder.copy_buffer_to_buffer(from, 0, &to, 0, bytes);
            to
        });
        device.queue.submit([recorder.encoder.finish()]);
        let [keys, values] = read.map(|buffer| words(device, &buffer));
        device.check().unwrap();
        (keys, values)
    }

    /// As `plan.wgsl` writes it.
    fn job(length: u32, per_group: u32) -> JobSlot {
        let groups = length.div_ceil(per_group);
        let rows = groups.div_ceil(MAX_GROUPS).max(1);
        let job = Job { length, groups: [groups.div_ceil(rows), rows, 1] };
        JobSlot { job, pad: [[0; 4]; 15] }
    }

    fn words(device: &Device, buffer: &Buffer) -> Vec<u32> {
        buffer.slice(..).map_async(MapMode::Read, |mapped| mapped.unwrap());
        device.device.poll(PollType::wait_indefinitely()).unwrap();
        let view = buffer.slice(..).get_mapped_range().unwrap();
        bytemuck::pod_collect_to_vec(&view)
    }
}
