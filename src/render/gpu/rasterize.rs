//! Stage rasterize: blends the splats of each tile front to back, and writes the requested pixels.
//!
//! Twin of `render/cpu/rasterize.rs`; WGSL: `shaders/rasterize.wgsl`, `shaders/resolve.wgsl`. Tiles
//! with long lists: `long_tiles.rs`.

use std::ops::Range;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use wgpu::{
    BindingResource, BufferBinding, BufferSize, BufferUsages, CommandEncoder, ComputePass,
    ShaderModule,
};

use super::background::{Background, BackgroundShader};
use super::bin::Bin;
use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, Kernel, LazyShader, slot_binding, slots};
use super::layout::{Owner, Span};
use super::lens::Lenses;
use super::long_tiles::LongTiles;
use super::plan::Plan;
use super::project::SplatBuffers;
use super::resolve::{Outputs, Planes};
use crate::{Frame, RenderError};
use wildcity_scene::sky::{CubeMap, DrawableSky};

/// The stage with one kind of background; one kernel for each combination of planes.
type Shader = LazyShader<TileKernels, { Planes::VARIANTS }>;

/// The kernels that write pixels.
#[derive(Debug)]
struct TileKernels {
    blend: Kernel,
    /// Writes those of long lists, if they have a kernel of their own.
    finish: Option<Kernel>,
}

impl TileKernels {
    fn new(device: &Device, module: &ShaderModule, planes: Planes) -> Self {
        let has_long_tiles = device.tuning().has_long_tiles();
        let long = ("LONG_TILES", f64::from(u8::from(has_long_tiles)));
        let constants: Vec<_> = planes.constants().into_iter().chain([long]).collect();
        let finish = || Kernel::new(device, module, "finish", &constants);
        Self {
            blend: Kernel::new(device, module, "main", &constants),
            finish: has_long_tiles.then(finish),
        }
    }
}

/// The kernels of the stage, and its output.
#[derive(Debug)]
pub(super) struct Rasterize {
    shaders: BackgroundShaders,
    /// For frames with instance ids; created with the first of them.
    instances: Option<Instances>,
    /// For frames with classes; created with the first of them.
    semantics: Option<BackgroundShaders>,
    /// For frames with a background or with appearances; created with the first of them.
    background: Option<Background>,
    /// The background of frames that have appearances only.
    black: Option<Arc<CubeMap>>,
    /// Whether the current frame uses `background`.
    has_background: bool,
    /// `None` on devices on which all tiles have the same kernel.
    long_tiles: Option<LongTiles>,
    /// A place for each tile where a shader asks for it and there is none.
    no_places: GrowableBuffer,
    spans: GrowableBuffer,
    /// Pixels, tile after tile, page after page.
    pages: Vec<GrowableBuffer>,
}

/// The kernels and the input of instance ids.
#[derive(Debug)]
struct Instances {
    shaders: BackgroundShaders,
    owners: GrowableBuffer,
}

/// The stage with each kind of background.
#[derive(Debug)]
struct BackgroundShaders {
    no_background: Shader,
    map: Shader,
    network: Shader,
    map_lens: Shader,
    network_lens: Shader,
}

impl Instances {
    fn new(device: &Device) -> Self {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let shaders = BackgroundShaders {
            no_background: Shader::new("instances"),
            map: Shader::new("instances_map"),
            network: Shader::new("instances_network"),
            map_lens: Shader::new("instances_map_lens"),
            network_lens: Shader::new("instances_network_lens"),
        };
        Self { shaders, owners: GrowableBuffer::new(device, "owners", usage) }
    }
}

impl BackgroundShaders {
    /// Of frames with classes.
    fn with_classes() -> Self {
        Self {
            no_background: Shader::new("owners"),
            map: Shader::new("owners_map"),
            network: Shader::new("owners_network"),
            map_lens: Shader::new("owners_map_lens"),
            network_lens: Shader::new("owners_network_lens"),
        }
    }
}

/// The part of the output that a region writes.
#[derive(Clone, Debug)]
pub(super) struct TileOutput {
    /// The values of each pixel.
    pub(super) planes: Planes,
    /// The tiles of the region.
    pub(super) tiles: Range<u32>,
    /// Tiles of a page.
    pub(super) tiles_per_page: u32,
}

/// The input of [`Rasterize::run`].
#[derive(Clone, Copy, Debug)]
pub(super) struct RasterizeInputs<'a> {
    pub(super) plan: &'a Plan,
    pub(super) splats: &'a SplatBuffers,
    pub(super) bin: &'a Bin,
    pub(super) lenses: &'a Lenses,
    /// The owners of the splats, in order of cluster views.
    pub(super) owners: &'a [Owner],
    /// For each cluster view, the index of its first splat.
    pub(super) first_splats: &'a GrowableBuffer,
    /// The owner of each splat, in frames with classes.
    pub(super) splat_owners: Option<&'a GrowableBuffer>,
}

impl Rasterize {
    pub(super) fn new(device: &Device) -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        Self {
            shaders: BackgroundShaders {
                no_background: Shader::new("rasterize").with_module(device),
                map: Shader::new("rasterize_map"),
                network: Shader::new("rasterize_network"),
                map_lens: Shader::new("rasterize_map_lens"),
                network_lens: Shader::new("rasterize_network_lens"),
            },
            instances: None,
            semantics: None,
            background: None,
            black: None,
            has_background: false,
            long_tiles: device.tuning().has_long_tiles().then(|| LongTiles::new(device)),
            no_places: GrowableBuffer::new(device, "no long tiles", BufferUsages::STORAGE),
            spans: GrowableBuffer::new(device, "tile spans", uniform),
            pages: Vec::new(),
        }
    }

    /// Uploads the background of a frame and the appearances of its cameras, if there is either.
    ///
    /// # Errors
    /// The sky cannot be drawn as the profile demands, or is larger than a binding.
    pub(super) fn upload_background(
        &mut self,
        device: &Device,
        frame: &Frame<'_>,
        outputs: &Outputs,
    ) -> Result<(), RenderError> {
        let background = match frame.background()? {
            // Exposures and overlays are applied by the shaders with a background: a black sky adds
            // nothing.
            None if !outputs.appearances.is_empty() => {
                let black =
                    self.black.get_or_insert_with(|| Arc::new(CubeMap::uniform(DVec3::ZERO)));
                Some((DrawableSky::CubeMap(black.clone()), DMat3::IDENTITY))
            }
            background => background,
        };
        self.has_background = background.is_some();
        let Some((sky, sky_from_world)) = background else { return Ok(()) };
        let held = self.background.get_or_insert_with(|| Background::new(device));
        held.upload(device, frame, sky, sky_from_world, outputs)
    }

    /// Most loop iterations that the background takes of a thread.
    pub(super) fn background_iterations(&self) -> u64 {
        let background = self.background.as_ref().filter(|_| self.has_background);
        background.map_or(0, Background::iterations)
    }

    /// Makes room for the pixels of all tiles. Returns the number of tiles of a page.
    pub(super) fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32) -> u32 {
        if let Some(long_tiles) = &mut self.long_tiles {
            long_tiles.reserve(device, tiles);
        }
        let tile_bytes = planes.tile_bytes();
        // A page is one binding, so it may not be longer than a binding.
        let per_page = (device.binding_bytes() / tile_bytes).min(u64::from(u32::MAX)) as u32;
        for (page, tiles) in pages(&(0..tiles), per_page) {
            if page == self.pages.len() {
                let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
                self.pages.push(GrowableBuffer::new(device, "pixels", usage));
            }
            self.pages[page].reserve(device, tile_bytes * tiles.len() as u64);
        }
        per_page
    }

    /// Blends the tiles of a region. The frame has `frame_tiles` tiles.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        inputs: RasterizeInputs<'_>,
        output: &TileOutput,
        frame_tiles: u32,
    ) {
        let RasterizeInputs { plan, splats, bin, lenses, owners, first_splats, splat_owners } =
            inputs;
        let TileOutput { planes, tiles, tiles_per_page } = output;
        self.compile(device, *planes);
        if planes.has_owners() && !planes.has_semantics() {
            let instances = self.instances.get_or_insert_with(|| Instances::new(device));
            // The shader has no length of its own for the list, so its first element is the count.
            let count = Owner { cluster_view: 0, instance: owners.len() as u32 };
            let list: Vec<Owner> = [count].iter().chain(owners).copied().collect();
            instances.owners.fill(device, bytemuck::cast_slice(&list));
        }
        let spans = pages(tiles, *tiles_per_page)
            .map(|(_, tiles)| Span { first: tiles.start, count: tiles.len() as u32 });
        self.spans.fill(device, &slots(spans));
        if let Some(long_tiles) = &mut self.long_tiles {
            long_tiles.run(device, pass, (plan, splats, bin), frame_tiles, *planes);
        }
        let Some(kernels) = self.shader(*planes).compiled(planes.variant()) else { return };

        // One dispatch per page of pixels.
        let places = match &self.long_tiles {
            Some(long_tiles) => long_tiles.bind_places(),
            // The shader names the binding even where it never reads it.
            None => (15, self.no_places.bind()),
        };
        let mut composite = self.composite_resources(*planes, lenses, first_splats);
        composite.extend(splat_owners.map(|owners| (13, owners.bind())));
        let page_resources = |index: usize, page: usize, tiles: &Range<u32>| {
            let bytes = page_bytes(*planes, tiles, *tiles_per_page);
            let pixels = BufferBinding {
                buffer: self.pages[page].buffer(),
                // A tile takes a multiple of 256 bytes, so any tile's offset is aligned.
                offset: bytes.start,
                size: BufferSize::new(bytes.end - bytes.start),
            };
            let span = slot_binding(self.spans.buffer(), index as u64, size_of::<Span>());
            let mut resources = vec![
                (0, plan.frame().as_entire_binding()),
                (1, span),
                (6, plan.tile_counters().as_entire_binding()),
                (7, BindingResource::Buffer(pixels)),
                places.clone(),
            ];
            resources.extend(composite.iter().cloned());
            resources
        };
        for (index, (page, tiles)) in pages(tiles, *tiles_per_page).enumerate() {
            let mut resources = page_resources(index, page, &tiles);
            resources.extend([
                (2, bin.ranges.bind()),
                (3, bin.instances.bind()),
                (4, splats.shapes.bind()),
                (5, splats.colors.bind()),
            ]);
            kernels.blend.run(device, pass, Groups::Count(tiles.len() as u32), &resources);
        }
        let Some(finish) = &kernels.finish else { return };
        let Some(long_tiles) = &self.long_tiles else { return };
        for (index, (page, tiles)) in pages(tiles, *tiles_per_page).enumerate() {
            let mut resources = page_resources(index, page, &tiles);
            resources.push(long_tiles.bind_sums());
            if planes.has_owners() {
                resources.push((3, bin.instances.bind()));
            }
            finish.run(device, pass, Groups::Count(tiles.len() as u32), &resources);
        }
    }

    /// What the kernels need for the background, the appearances and the instances, but for the
    /// owners of frames with classes.
    fn composite_resources<'a>(
        &'a self,
        planes: Planes,
        lenses: &'a Lenses,
        first_splats: &'a GrowableBuffer,
    ) -> Vec<(u32, BindingResource<'a>)> {
        let mut resources = Vec::new();
        if let Some(instances) = self.instances(planes) {
            resources.extend([(13, instances.owners.bind()), (14, first_splats.bind())]);
        }
        if let Some(background) = self.shown_background() {
            resources.extend(background.bind());
            if background.has_lenses() {
                resources.extend(lenses.bind());
            }
        }
        resources
    }

    /// The kernels and the input of instance ids, for frames that have those and no classes.
    fn instances(&self, planes: Planes) -> Option<&Instances> {
        self.instances.as_ref().filter(|_| planes.has_owners() && !planes.has_semantics())
    }

    /// The background of the current frame.
    fn shown_background(&self) -> Option<&Background> {
        self.background.as_ref().filter(|_| self.has_background)
    }

    /// Compiles the kernels of the current frame, if they are missing.
    fn compile(&mut self, device: &Device, planes: Planes) {
        let background = self.shown_background().map(Background::shader);
        let shaders = if planes.has_semantics() {
            self.semantics.get_or_insert_with(BackgroundShaders::with_classes)
        } else if planes.has_owners() {
            &mut self.instances.get_or_insert_with(|| Instances::new(device)).shaders
        } else {
            &mut self.shaders
        };
        let shader = match background {
            None => &mut shaders.no_background,
            Some(BackgroundShader::Map) => &mut shaders.map,
            Some(BackgroundShader::Network) => &mut shaders.network,
            Some(BackgroundShader::MapLens) => &mut shaders.map_lens,
            Some(BackgroundShader::NetworkLens) => &mut shaders.network_lens,
        };
        shader.variant(device, planes.variant(), |module| TileKernels::new(device, module, planes));
    }

    /// The shader for the current frame's background and these planes.
    fn shader(&self, planes: Planes) -> &Shader {
        let semantics = self.semantics.as_ref().filter(|_| planes.has_semantics());
        let instances = self.instances(planes).map(|instances| &instances.shaders);
        let shaders = semantics.or(instances).unwrap_or(&self.shaders);
        match self.shown_background().map(Background::shader) {
            None => &shaders.no_background,
            Some(BackgroundShader::Map) => &shaders.map,
            Some(BackgroundShader::Network) => &shaders.network,
            Some(BackgroundShader::MapLens) => &shaders.map_lens,
            Some(BackgroundShader::NetworkLens) => &shaders.network_lens,
        }
    }

    /// Copies the pixels of a region's tiles to buffers that the host can read, page by page.
    pub(super) fn copy(
        &self,
        encoder: &mut CommandEncoder,
        to: &[GrowableBuffer],
        output: &TileOutput,
    ) {
        let TileOutput { planes, tiles, tiles_per_page } = output;
        for (page, tiles) in pages(tiles, *tiles_per_page) {
            let Range { start, end } = page_bytes(*planes, &tiles, *tiles_per_page);
            let from = self.pages[page].buffer();
            encoder.copy_buffer_to_buffer(from, start, to[page].buffer(), start, end - start);
        }
    }
}

/// The pages that hold some tiles, and the tiles that each of them holds.
pub(super) fn pages(
    tiles: &Range<u32>,
    per_page: u32,
) -> impl Iterator<Item = (usize, Range<u32>)> {
    let Range { start, end } = *tiles;
    (start / per_page..end.div_ceil(per_page)).map(move |page| {
        let first = page * per_page;
        (page as usize, start.max(first)..end.min(first.saturating_add(per_page)))
    })
}

/// The bytes of some tiles of one page, counted from the start of the page.
fn page_bytes(planes: Planes, tiles: &Range<u32>, per_page: u32) -> Range<u64> {
    let start = planes.tile_bytes() * u64::from(tiles.start % per_page);
    start..start + planes.tile_bytes() * tiles.len() as u64
}
