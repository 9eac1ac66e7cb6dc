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
