//! A compiled entry point of a shader, and the passes that run it.

use wgpu::{
    BindGroupDescriptor, BindGroupEntry, BindGroupLayout, BindingResource, Buffer, BufferBinding,
    BufferSize, CommandEncoder, CommandEncoderDescriptor, ComputePass, ComputePassDescriptor,
    ComputePassTimestampWrites, ComputePipeline, ComputePipelineDescriptor,
    PipelineCompilationOptions, QuerySet, QuerySetDescriptor, QueryType, ShaderModule,
    ShaderModuleDescriptor, ShaderSource,
};

use super::device::Device;
use super::layout::{JobSlot, MAX_GROUPS};
use super::shaders::Shaders;

/// One entry point, specialised.
#[derive(Debug)]
pub(super) struct Kernel {
    label: &'static str,
    pipeline: ComputePipeline,
    layout: BindGroupLayout,
}

/// How many groups of a kernel run.
#[derive(Clone, Copy, Debug)]
pub(super) enum Groups<'a> {
    /// As many as the host knows.
    Count(u32),
    /// As many as `plan.wgsl` wrote into this slot.
    Job(&'a Buffer, u64),
}

impl Kernel {
    /// Compiles an entry point; what the shader has wrong is told by [`Device::check`].
    pub(super) fn new(
        device: &Device,
        module: &ShaderModule,
        entry: &'static str,
        constants: &[(&str, f64)],
    ) -> Self {
        device.count_pipeline();
        let pipeline = device.device.create_compute_pipeline(&ComputePipelineDescriptor {
            label: Some(entry),
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
        Self { label: entry, pipeline, layout }
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
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bind_group, &[]);
        match groups {
            Groups::Count(count) => {
                // As `plan.wgsl` folds: rows of at most 65,535, of about equal length.
                let rows = count.div_ceil(MAX_GROUPS).max(1);
                pass.dispatch_workgroups(count.div_ceil(rows), rows, 1);
            }
            Groups::Job(jobs, slot) => {
                // The groups lie behind the length.
                pass.dispatch_workgroups_indirect(jobs, slot * SLOT_BYTES + 4);
            }
        }
    }
}

/// Distance of slots that are bound one at a time.
pub(super) const SLOT_BYTES: u64 = size_of::<JobSlot>() as u64;

/// One slot of a buffer of slots.
pub(super) fn slot(buffer: &Buffer, slot: u64, bytes: usize) -> BindingResource<'_> {
    BindingResource::Buffer(BufferBinding {
        buffer,
        offset: slot * SLOT_BYTES,
        size: BufferSize::new(bytes as u64),
    })
}

/// Compiles a stage's shader; what is wrong with it is told by [`Device::check`].
pub(super) fn module(device: &Device, shaders: &Shaders, name: &str) -> ShaderModule {
    device.device.create_shader_module(ShaderModuleDescriptor {
        label: Some(name),
        source: ShaderSource::Wgsl(shaders.get(name).into()),
    })
}

/// The stages of a frame on their way to the device, and the clock beside them.
#[derive(Debug)]
pub(super) struct Recorder {
    pub(super) encoder: CommandEncoder,
    clock: Option<QuerySet>,
    stages: Vec<&'static str>,
}

/// Most stages of a frame.
pub(super) const MAX_STAGES: u32 = 8;

/// Bytes of all ticks: before and after each stage.
pub(super) const TICKS_BYTES: u64 = 2 * 8 * MAX_STAGES as u64;

/// A clock for all stages of a frame, where the device has one.
pub(super) fn clock(device: &Device) -> Option<QuerySet> {
    device.tick_ns().map(|_| {
        device.device.create_query_set(&QuerySetDescriptor {
            label: Some("stages"),
            ty: QueryType::Timestamp,
            count: 2 * MAX_STAGES,
        })
    })
}

impl Recorder {
    /// An empty frame, timed by `clock` where the device has one.
    pub(super) fn new(device: &Device, clock: Option<QuerySet>) -> Self {
        let encoder = device
            .device
            .create_command_encoder(&CommandEncoderDescriptor { label: Some("frame") });
        Self { encoder, clock, stages: Vec::new() }
    }

    /// Starts a stage: what runs in the pass is on its account.
    pub(super) fn stage(&mut self, name: &'static str) -> ComputePass<'_> {
        let first = 2 * self.stages.len() as u32;
        self.stages.push(name);
        let clock = self.clock.as_ref().filter(|_| first < 2 * MAX_STAGES);
        let timestamp_writes = clock.map(|query_set| ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let descriptor = ComputePassDescriptor { label: Some(name), timestamp_writes };
        self.encoder.begin_compute_pass(&descriptor)
    }

    /// Copies the ticks to `ticks`, and tells the stages' names in order.
    pub(super) fn finish_stages(&mut self, ticks: &Buffer) -> Vec<&'static str> {
        if let Some(clock) = &self.clock {
            self.encoder.resolve_query_set(clock, 0..2 * self.stages.len() as u32, ticks, 0);
        }
        std::mem::take(&mut self.stages)
    }
}
