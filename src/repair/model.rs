//! A model that is loaded, checked and ready.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::error::RepairError;
use crate::files;
use crate::halo::{Halo, Probe};
use crate::image::{Image, View};
use crate::limits::{LOAD_TIMEOUT, MAX_SIDE_PX, MAX_THREADS};
use crate::manifest::{Dtype, Fit, Input, InputRole, Layout, Manifest, Provider, Size};
use crate::merge;
use crate::onnx::{self, Feed, Settings, Worker};
use crate::planes::{Planes, Rect};
use crate::resample::{Kernel, resample};
use crate::roles;
use crate::signature;
use crate::tiles::{Tiling, Window};

/// Where and how a model runs.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// The runtime: a libonnxruntime.so from version 1.18 on. An empty path is refused as `RuntimeUnnamed`.
    pub library: PathBuf,
    /// One of the manifest's; its first if none is given.
    pub provider: Option<Provider>,
    /// Threads of the cpu provider. The bytes do not depend on it.
    pub threads: usize,
    /// Time to build the session.
    pub load_timeout: Duration,
}

impl LoadOptions {
    /// The default options with the runtime at `library`.
    pub fn new(library: impl Into<PathBuf>) -> Self {
        LoadOptions {
            library: library.into(),
            provider: None,
            threads: 1,
            load_timeout: LOAD_TIMEOUT,
        }
    }
}

/// A repaired image.
#[derive(Clone, Debug, PartialEq)]
pub struct Repaired {
    /// `scale` times as large as the rendered image.
    pub image: Image,
    /// BLAKE3 of the rendered image.
    pub rendered_hash: blake3::Hash,
    /// BLAKE3 of the repaired image.
    pub hash: blake3::Hash,
}

/// A model that is loaded, checked and ready. It runs one image at a time.
pub struct Model {
    manifest: Manifest,
    provider: Provider,
    repair_hash: blake3::Hash,
    halo: Option<Halo>,
    is_deterministic: bool,
    worker: Mutex<Worker>,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model")
            .field("name", &self.manifest.name)
            .field("halo", &self.halo)
            .finish_non_exhaustive()
    }
}

impl Model {
    /// Reads the manifest at `path` and the files that it pins, opens the runtime if this is the process's
    /// first model, and probes: shape, NaN, time, three equal runs; for tiles the halo, and that tiles equal
    /// the whole.
    ///
    /// # Errors
    /// All of [`RepairError`] but `Input`.
    pub fn load(path: &Path, options: &LoadOptions) -> Result<Model, RepairError> {
        let files = files::read(path)?;
        let manifest = &files.manifest;
        let wrong =
            |field: &str, message: String| RepairError::Input { field: field.to_owned(), message };
        if !(1..=MAX_THREADS).contains(&options.threads) {
            return Err(wrong("threads", format!("{}; 1 to {MAX_THREADS}", options.threads)));
        }
        let provider = options.provider.unwrap_or(manifest.providers[0]);
        if !manifest.providers.contains(&provider) {
            let known: Vec<&str> =
                manifest.providers.iter().map(|provider| provider.name()).collect();
            let message = format!("{:?}; the manifest has {}", provider.name(), known.join(", "));
            return Err(wrong("provider", message));
        }
        let settings = Settings {
            library: options.library.clone(),
            provider,
            threads: options.threads,
            gpu_bytes: (manifest.memory_mib as usize) << 20,
            load_timeout: options.load_timeout,
        };
        let (worker, graph) = Worker::start(files.graph, &settings)?;
        signature::check(manifest, &graph, path)?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(&files.manifest_bytes).update(onnx::build_info().as_bytes());
        hasher.update(provider.name().as_bytes());
        let mut model = Model {
            repair_hash: hasher.finalize(),
            manifest: files.manifest,
            provider,
            halo: None,
            is_deterministic: false,
            worker: Mutex::new(worker),
        };
        model.probe()?;
        Ok(model)
    }

    /// The manifest.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// What computes.
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// Version of the runtime, as its build says.
    pub fn runtime(&self) -> &'static str {
        let build = onnx::build_info();
        let branch = build.split("git-branch=").nth(1).and_then(|rest| rest.split(',').next());
        branch.unwrap_or(build)
    }

    /// BLAKE3 of all that decides the bytes beside the images: manifest (which pins the files), build of the
    /// runtime, provider.
    pub fn repair_hash(&self) -> blake3::Hash {
        self.repair_hash
    }

    /// The measured halo, if the fit is `tile`.
    pub fn halo(&self) -> Option<Halo> {
        self.halo
    }

    /// Whether three probe runs gave the same bytes.
    pub fn is_deterministic(&self) -> bool {
        self.is_deterministic
    }

    /// Repairs an image.
    ///
    /// # Errors
    /// `Input`, `Shape`, `NotFinite`, `TimedOut`, `Withdrawn`, `Run`, `Tiles`.
    pub fn repair(&self, view: &View<'_>) -> Result<Repaired, RepairError> {
        view.check()?;
        let fitted = Fitted::of(&self.manifest.size, view.rendered)?;
        let mut inputs = Vec::new();
        for input in self.pixel_inputs() {
            inputs.push(fitted.fit(roles::planes(view, input)?, input.dtype));
        }
        let scalars = self.scalars(view)?;
        let windows = self.windows(inputs[0].height, inputs[0].width)?;
        let scale = self.manifest.output().scale as usize;
        let channels = self.manifest.output().role.channels();
        let mut output = Planes::zeros(channels, inputs[0].height * scale, inputs[0].width * scale);
        for window in &windows {
            let tile: Vec<Planes> = inputs.iter().map(|planes| planes.crop(window.seen)).collect();
            let returned = self.run(&tile, &scalars)?;
            self.check_finite(&returned)?;
            let used = window.used.scaled(scale);
            let seen = window.seen.scaled(scale);
            let within = Rect { top: used.top - seen.top, left: used.left - seen.left, ..used };
            output.paste(&returned, within, used.top, used.left);
        }
        let is_image = |input: &Input| matches!(input.role, InputRole::Rgb | InputRole::Luma);
        let at = self.pixel_inputs().position(is_image).unwrap_or(0);
        let seen = inputs[at].crop(fitted.content);
        let output = output.crop(fitted.content.scaled(scale));
        let image = merge::merge(&self.manifest, view, seen, output);
        let hash = image.hash();
        Ok(Repaired { image, rendered_hash: view.rendered.hash(), hash })
    }

    fn pixel_inputs(&self) -> impl Iterator<Item = &Input> {
        self.manifest.inputs.iter().filter(|input| input.role.channels().is_some())
    }

    /// Trust and constants.
    fn scalars(&self, view: &View<'_>) -> Result<Vec<Feed>, RepairError> {
        let inputs = self.manifest.inputs.iter().filter(|input| input.role.channels().is_none());
        let feed = |input: &Input| {
            let shape: Vec<i64> = match input.role {
                InputRole::Trust => vec![1, 1],
                _ => input.shape.iter().map(|side| i64::from(*side)).collect(),
            };
            let count = shape.iter().product::<i64>() as usize;
            let values = vec![roles::scalar(view, input)?; count];
            Ok(Feed { name: input.name.clone(), shape, dtype: input.dtype, values })
        };
        inputs.map(feed).collect()
    }

    /// The tiles of an image that fits, or the image.
    fn windows(&self, height: usize, width: usize) -> Result<Vec<Window>, RepairError> {
        let whole = Rect { top: 0, left: 0, height, width };
        if self.manifest.size.fit != Fit::Tile {
            return Ok(vec![Window { seen: whole, used: whole }]);
        }
        let halo = match self.halo {
            Some(Halo::Pixels(halo)) => halo,
            _ => return Err(whole_halo()),
        };
        self.tiling(halo).windows(height, width)
    }

    fn tiling(&self, halo: usize) -> Tiling {
        let size = &self.manifest.size;
        let tile = size.fixed.or(size.tile).unwrap_or([u32::MAX; 2]).map(|side| side as usize);
        Tiling { tile, multiple_of: multiple_of(size), halo }
    }

    /// Runs the graph on planes that have a size it takes, and checks the shape of the output.
    fn run(&self, planes: &[Planes], scalars: &[Feed]) -> Result<Planes, RepairError> {
        let layout = self.manifest.layout;
        let mut feeds = scalars.to_vec();
        for (input, planes) in self.pixel_inputs().zip(planes) {
            let sides = [planes.height as i64, planes.width as i64];
            feeds.push(Feed {
                name: input.name.clone(),
                shape: signature::image_shape(layout, planes.channels as i64, sides),
                dtype: input.dtype,
                values: to_layout(planes, layout),
            });
        }
        let output = self.manifest.output();
        let scale = output.scale as usize;
        let channels = output.role.channels();
        let height = planes[0].height * scale;
        let width = planes[0].width * scale;
        let limit = Duration::from_millis(self.manifest.timeout_ms);
        let mut worker = self.worker.lock().unwrap_or_else(PoisonError::into_inner);
        let returned = worker.run(feeds, &output.name, limit)?;
        drop(worker);
        let wanted = signature::image_shape(layout, channels as i64, [height as i64, width as i64]);
        if returned.shape != wanted {
            return Err(RepairError::Shape {
                output: output.name.clone(),
                wanted,
                found: returned.shape,
            });
        }
        Ok(from_layout(returned.values, channels, [height, width], layout))
    }

    fn check_finite(&self, output: &Planes) -> Result<(), RepairError> {
        let count = output.values.iter().filter(|value| !value.is_finite()).count();
        if count == 0 {
            return Ok(());
        }
        let name = self.manifest.output().name.clone();
        Err(RepairError::NotFinite { output: name, count, of: output.values.len() })
    }

    /// Runs the model on a pattern: shape, NaN, time, repeated bytes; then the halo.
    fn probe(&mut self) -> Result<(), RepairError> {
        let size = self.manifest.size.clone();
        let spatial = |input: &Input| (input.role.channels().unwrap_or(0), input.range);
        let probe = Probe {
            inputs: self.pixel_inputs().map(spatial).collect(),
            multiple_of: multiple_of(&size),
            fixed: size.fixed.map(|sides| sides.map(|side| side as usize)),
            scale: self.manifest.output().scale as usize,
        };
        let blank = Image { width: 1, height: 1, rgb8: vec![0; 3] };
        let view = View { trust: Some(0.5), ..View::new(&blank) };
        let scalars = self.scalars(&view)?;
        let side = 64_usize.next_multiple_of(probe.multiple_of);
        let [height, width] = probe.fixed.unwrap_or([side; 2]);
        let images = probe.images(height, width);
        let first = self.run(&images, &scalars)?;
        self.check_finite(&first)?;
        let again = [self.run(&images, &scalars)?, self.run(&images, &scalars)?];
        self.is_deterministic = again.iter().all(|again| *again == first);
        if size.fit != Fit::Tile {
            return Ok(());
        }
        let halo = probe.halo(&mut |planes| self.run(planes, &scalars))?;
        self.halo = Some(halo);
        let Halo::Pixels(halo) = halo else { return Err(whole_halo()) };
        if probe.fixed.is_none() {
            self.check_tiles(&probe, halo, &scalars)?;
        }
        Ok(())
    }

    /// Compares two tiles in each direction with the whole.
    fn check_tiles(&self, probe: &Probe, halo: usize, scalars: &[Feed]) -> Result<(), RepairError> {
        let tiling = self.tiling(halo);
        let [height, width] = tiling.tile.map(|side| side + probe.multiple_of);
        let images = probe.images(height, width);
        let whole = self.run(&images, scalars)?;
        for Window { seen, used } in tiling.windows(height, width)? {
            let tile: Vec<Planes> = images.iter().map(|planes| planes.crop(seen)).collect();
            let returned = self.run(&tile, scalars)?;
            let used_out = used.scaled(probe.scale);
            let seen_out = seen.scaled(probe.scale);
            let within = Rect {
                top: used_out.top - seen_out.top,
                left: used_out.left - seen_out.left,
                ..used_out
            };
            if returned.crop(within) != whole.crop(used_out) {
                let message =
                    format!("with the measured halo of {halo} px they differ from the whole");
                return Err(RepairError::Tiles { message });
            }
        }
        Ok(())
    }
}

fn whole_halo() -> RepairError {
    let message = "an output pixel depends on the whole image, or the model hides NaN".to_owned();
    RepairError::Tiles { message }
}

fn multiple_of(size: &Size) -> usize {
    size.multiple_of.unwrap_or(1) as usize
}

/// The size in which the model sees an image.
struct Fitted {
    /// What the model gets.
    height: usize,
    width: usize,
    /// The part of it that is the image; the rest is padding.
    content: Rect,
    is_resized: bool,
}

impl Fitted {
    fn of(size: &Size, image: &Image) -> Result<Fitted, RepairError> {
        let fixed = size.fixed.map(|sides| sides.map(|side| side as usize));
        let multiple = multiple_of(size);
        let [height, width] = [image.height, image.width];
        if size.fit == Fit::Resize {
            let [height, width] = fixed.unwrap_or_else(|| {
                let pixels = f64::from(size.pixels.unwrap_or(1));
                resized([height, width], pixels, multiple)
            });
            let content = Rect { top: 0, left: 0, height, width };
            return Ok(Fitted { height, width, content, is_resized: true });
        }
        let up = |side: usize| side.next_multiple_of(multiple);
        let padded = match (fixed, size.fit) {
            // Tiles have the fixed size, so the image must have at least that.
            (Some([h, w]), Fit::Tile) => [height.max(h), width.max(w)],
            (Some([h, w]), _) if height > h || width > w => {
                let message = format!(
                    "{width} x {height} px; size.fixed with \"fit\": \"pad\" takes at most {w} x {h}; use \"tile\" or \
                     \"resize\""
                );
                return Err(RepairError::Input { field: "image".to_owned(), message });
            }
            (Some(sides), _) => sides,
            (None, _) => [up(height), up(width)],
        };
        let content = Rect { top: 0, left: 0, height, width };
        Ok(Fitted { height: padded[0], width: padded[1], content, is_resized: false })
    }

    /// Planes of the image as the model gets them.
    fn fit(&self, planes: Planes, dtype: Dtype) -> Planes {
        let fitted = match self.is_resized {
            true => resample(&planes, self.height, self.width, Kernel::Lanczos3),
            false => planes.padded(self.height, self.width),
        };
        // Rounded here, so that a residual is against what the model got.
        if dtype == Dtype::F16 { fitted.rounded_to_f16() } else { fitted }
    }
}

/// The multiples nearest to the aspect of an image with about so many pixels.
fn resized([height, width]: [usize; 2], pixels: f64, multiple: usize) -> [usize; 2] {
    let ratio = (pixels / (height as f64 * width as f64)).sqrt();
    let largest = MAX_SIDE_PX / multiple;
    [height, width].map(|side| {
        let multiples = (side as f64 * ratio / multiple as f64).round() as usize;
        multiples.clamp(1, largest) * multiple
    })
}

fn to_layout(planes: &Planes, layout: Layout) -> Vec<f32> {
    if layout == Layout::Nchw {
        return planes.values.clone();
    }
    let pixels = planes.height * planes.width;
    let channels = planes.channels;
    (0..pixels * channels).map(|at| planes.values[at % channels * pixels + at / channels]).collect()
}

fn from_layout(
    values: Vec<f32>,
    channels: usize,
    [height, width]: [usize; 2],
    layout: Layout,
) -> Planes {
    if layout == Layout::Nchw {
        return Planes { channels, height, width, values };
    }
    let pixels = height * width;
    let planar =
        (0..pixels * channels).map(|at| values[at % pixels * channels + at / pixels]).collect();
    Planes { channels, height, width, values: planar }
}
