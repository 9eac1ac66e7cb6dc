//! Compute kernels (compiled entry points of shaders), and the passes that run them.

use bytemuck::NoUninit;
use parking_lot::Mutex;
use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindGroupLayout, BindingResource, Buffer,
    BufferBinding, BufferSize, CommandEncoder, CommandEncoderDescriptor, ComputePass,
    ComputePassDescriptor, ComputePassTimestampWrites, ComputePipeline, ComputePipelineDescriptor,
    PipelineCompilationOptions, QuerySet, QuerySetDescriptor, QueryType, ShaderModule,
    ShaderModuleDescriptor, ShaderSource,
};

use super::device::Device;
use super::layout::{Job, JobSlot, MAX_GROUPS};

/// One entry point of a shader, with its override constants set.
#[derive(Debug)]
pub(super) struct Kernel {
    label: &'static str,
    pipeline: ComputePipeline,
    layout: BindGroupLayout,
    /// The bind groups of recent runs, the latest one last. Most frames bind what the frame before
    /// did: making a bind group takes the host as long as recording a dispatch.
    bind_groups: Mutex<Vec<(Vec<BoundBuffer>, BindGroup)>>,
}

/// Most bind groups that a kernel keeps. The prefix sum has one for each of its nine runs.
const BIND_GROUPS: usize = 16;

/// Part of a buffer at a binding number. Buffers that look alike differ.
#[derive(Clone, Debug, PartialEq)]
struct BoundBuffer {
    binding: u32,
    buffer: Buffer,
    offset: u64,
    size: Option<BufferSize>,
}

impl BoundBuffer {
    /// `None` for other resources than buffers.
    fn new(binding: u32, resource: &BindingResource<'_>) -> Option<Self> {
        match resource {
            BindingResource::Buffer(BufferBinding { buffer, offset, size }) => {
                Some(Self { binding, buffer: (*buffer).clone(), offset: *offset, size: *size })
            }
            _ => None,
        }
    }

    fn is(&self, (binding, resource): &(u32, BindingResource<'_>)) -> bool {
        matches!(
            resource,
            BindingResource::Buffer(BufferBinding { buffer, offset, size })
                if self.binding == *binding
                    && self.buffer == **buffer
                    && self.offset == *offset
                    && self.size == *size
        )
    }
}

/// Number of workgroups of a kernel.
#[derive(Clone, Copy, Debug)]
pub(super) enum Groups<'a> {
    /// A number that the host knows.
    Count(u32),
    /// The number in a job: `plan.wgsl` computes it on the device.
    Job(JobRef<'a>),
}

/// A job in the buffer of jobs.
#[derive(Clone, Copy, Debug)]
pub(super) struct JobRef<'a> {
    /// The buffer of [`JobSlot`]s.
    pub(super) jobs: &'a Buffer,
    /// Index of the slot.
    pub(super) slot: u64,
}

impl<'a> JobRef<'a> {
    /// The job as a shader's resource.
    pub(super) fn bind(self) -> BindingResource<'a> {
        slot_binding(self.jobs, self.slot, size_of::<Job>())
    }
}

impl Kernel {
    /// Compiles an entry point. [`Device::check`] reports errors of the shader.
    pub(super) fn new(
        device: &Device,
        module: &ShaderModule,
        entry: &'static str,
        constants: &[(&str, f64)],
    ) -> Self {
        device.count_pipeline();
        let pipeline = device.device.create_compute_pipeline(&ComputePipelineDescriptor {
            label: Some(entry),
            // Derived from the shader: exactly the bindings that this entry point uses must be
            // given to `run`.
            layout: None,
            module,
            entry_point: Some(entry),
            compilation_options: PipelineCompilationOptions {
                constants,
                // Every shader writes its workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Self { label: entry, pipeline, layout, bind_groups: Mutex::default() }
    }

    /// Runs the kernel in a pass, with these resources by binding number.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        groups: Groups<'_>,
        resources: &[(u32, BindingResource<'_>)],
    ) {
        device.count_dispatch();
        let bind_group = self.bind_group(device, resources);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bind_group, &[]);
        match groups {
            Groups::Count(count) => {
                let [columns, rows, layers] = fold_groups(count);
                pass.dispatch_workgroups(columns, rows, layers);
            }
            Groups::Job(JobRef { jobs, slot }) => {
                // The numbers of workgroups follow the job's length.
                pass.dispatch_workgroups_indirect(jobs, slot * SLOT_BYTES + 4);
            }
        }
    }

    /// The bind group of these resources, that of an earlier run if there is one. Buffers that were
    /// destroyed since are never bound again, so that their bind groups are forgotten in time.
    fn bind_group(&self, device: &Device, resources: &[(u32, BindingResource<'_>)]) -> BindGroup {
        let mut kept = self.bind_groups.lock();
        let is_same = |bound: &[BoundBuffer]| {
            bound.len() == resources.len()
                && bound.iter().zip(resources).all(|(bound, resource)| bound.is(resource))
        };
        if let Some(index) = kept.iter().rposition(|(bound, _)| is_same(bound)) {
            let found = kept.remove(index);
            let bind_group = found.1.clone();
            kept.push(found);
            return bind_group;
        }
        let entries: Vec<BindGroupEntry<'_>> = resources
            .iter()
            .map(|(binding, resource)| BindGroupEntry {
                binding: *binding,
                resource: resource.clone(),
            })
            .collect();
        let bind_group = device.device.create_bind_group(&BindGroupDescriptor {
            label: Some(self.label),
            layout: &self.layout,
            entries: &entries,
        });
        let bound = resources.iter().map(|(binding, from)| BoundBuffer::new(*binding, from));
        // `None` if a resource is no buffer: such a group is used once and not kept.
        if let Some(bound) = bound.collect() {
            if kept.len() == BIND_GROUPS {
                // The first one has not been used for the longest time.
                kept.remove(0);
            }
            kept.push((bound, bind_group.clone()));
        }
        bind_group
    }
}

/// Folds workgroups into rows of at most [`MAX_GROUPS`], of about equal length, as `job` in
/// `plan.wgsl` does. The last row may have surplus workgroups, which do nothing.
pub(super) fn fold_groups(count: u32) -> [u32; 3] {
    // A count of 0 makes one row without columns, which dispatches nothing.
    let rows = count.div_ceil(MAX_GROUPS).max(1);
    [count.div_ceil(rows), rows, 1]
}

/// Distance of slots that are bound one at a time, in bytes.
pub(super) const SLOT_BYTES: u64 = size_of::<JobSlot>() as u64;

/// The first `bytes` of one slot of a buffer of slots, as a shader's resource.
pub(super) fn slot_binding(buffer: &Buffer, slot: u64, bytes: usize) -> BindingResource<'_> {
    BindingResource::Buffer(BufferBinding {
        buffer,
        offset: slot * SLOT_BYTES,
        size: BufferSize::new(bytes as u64),
    })
}

/// The content of a buffer with one value per slot.
pub(super) fn slots(values: impl Iterator<Item = impl NoUninit>) -> Vec<u8> {
    let mut bytes = Vec::new();
    for value in values {
        let end = bytes.len() + SLOT_BYTES as usize;
        bytes.extend_from_slice(bytemuck::bytes_of(&value));
        // No kernel sees the padding: a binding of a slot ends with the value.
        bytes.resize(end, 0);
    }
    bytes
}

/// Compiles a shader. [`Device::check`] reports its errors.
pub(super) fn module(device: &Device, shader: &str) -> ShaderModule {
    device.device.create_shader_module(ShaderModuleDescriptor {
        label: Some(shader),
        source: ShaderSource::Wgsl(device.shaders().get(shader).into()),
    })
}

/// A shader whose kernels exist in up to `N` variants, each compiled when it is first needed.
#[derive(Debug)]
pub(super) struct LazyShader<K, const N: usize> {
    shader: &'static str,
    module: Option<ShaderModule>,
    /// In boxes: 96 of them by value, in 15 shaders, would not fit the stack of a thread.
    variants: [Option<Box<K>>; N],
}

impl<K, const N: usize> LazyShader<K, N> {
    /// Nothing is compiled yet.
    pub(super) fn new(shader: &'static str) -> Self {
        Self { shader, module: None, variants: [const { None }; N] }
    }

    /// Compiles the module now, so that [`Device::check`] reports its errors before the first
    /// frame.
    pub(super) fn with_module(mut self, device: &Device) -> Self {
        self.module = Some(module(device, self.shader));
        self
    }

    /// The kernels of a variant, a number below `N`; `compile` makes them from the module.
    pub(super) fn variant(
        &mut self,
        device: &Device,
        variant: usize,
        compile: impl FnOnce(&ShaderModule) -> K,
    ) -> &K {
        let module = self.module.get_or_insert_with(|| module(device, self.shader));
        self.variants[variant].get_or_insert_with(|| Box::new(compile(module)))
    }

    /// The kernels of a variant that was compiled before.
    pub(super) fn compiled(&self, variant: usize) -> Option<&K> {
        self.variants[variant].as_deref()
    }
}

/// Records the stages of a frame and times them.
#[derive(Debug)]
pub(super) struct Recorder {
    pub(super) encoder: CommandEncoder,
    timestamps: Option<QuerySet>,
    stages: Vec<&'static str>,
}

/// Most stages of a frame.
pub(super) const MAX_STAGES: u32 = 8;

/// Bytes of all timestamps: one before and one after each stage.
pub(super) const TIMESTAMP_BYTES: u64 = 2 * 8 * MAX_STAGES as u64;

/// Timestamp queries for all stages of a frame; `None` if the device has no clock.
pub(super) fn timestamps(device: &Device) -> Option<QuerySet> {
    device.tick_ns().map(|_| {
        device.device.create_query_set(&QuerySetDescriptor {
            label: Some("stages"),
            ty: QueryType::Timestamp,
            count: 2 * MAX_STAGES,
        })
    })
}

impl Recorder {
    /// An empty frame, timed if there are `timestamps`.
    pub(super) fn new(device: &Device, timestamps: Option<QuerySet>) -> Self {
        let encoder = device
            .device
            .create_command_encoder(&CommandEncoderDescriptor { label: Some("frame") });
        Self { encoder, timestamps, stages: Vec::new() }
    }

    /// Starts a stage: the time of everything in the pass is the stage's.
    pub(super) fn stage(&mut self, name: &'static str) -> ComputePass<'_> {
        let first = 2 * self.stages.len() as u32;
        self.stages.push(name);
        let timestamps = self.timestamps.as_ref().filter(|_| first < 2 * MAX_STAGES);
        let timestamp_writes = timestamps.map(|query_set| ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let descriptor = ComputePassDescriptor { label: Some(name), timestamp_writes };
        self.encoder.begin_compute_pass(&descriptor)
    }

    /// Copies the timestamps to a buffer. Returns the names of the stages in order.
    pub(super) fn finish_stages(&mut self, timestamps: &Buffer) -> Vec<&'static str> {
        if let Some(queries) = &self.timestamps {
            // Further stages have no timestamps.
            let count = 2 * (self.stages.len() as u32).min(MAX_STAGES);
            self.encoder.resolve_query_set(queries, 0..count, timestamps, 0);
        }
        std::mem::take(&mut self.stages)
    }
}
