//! A model that is loaded, checked and ready.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::error::RepairError;
use crate::files;
use crate::fitted::Fitted;
use crate::halo::Halo;
use crate::image::{Image, View};
use crate::limits::{LOAD_TIMEOUT, MAX_THREADS};
use crate::manifest::{Input, InputRole, Manifest, Provider};
use crate::merge;
use crate::onnx::{self, Settings, Worker};
use crate::planes::{Planes, Rect};
use crate::probe::{Probed, probe};
use crate::reference::DEFAULT_BYTES;
use crate::roles;
use crate::runner::Runner;
use crate::signature;
use crate::tiles::Window;

/// The runtime, the provider and the limits with which a model runs.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// The runtime: a libonnxruntime.so from version 1.18 on. An empty path is refused as
    /// `RuntimeUnnamed`.
    pub library: PathBuf,
    /// The provider: one of the manifest's, or its first if none is given.
    pub provider: Option<Provider>,
    /// Threads of the cpu provider. The bytes do not depend on it.
    pub threads: usize,
    /// Time to build the session.
    pub load_timeout: Duration,
    /// Bytes of recorded images that [`crate::Models`] keeps in memory.
    pub reference_bytes: u64,
}

impl Default for LoadOptions {
    /// Without a runtime: every load is refused.
    fn default() -> Self {
        Self::new(PathBuf::new())
    }
}

impl LoadOptions {
    /// The default options with the runtime at `library`.
    pub fn new(library: impl Into<PathBuf>) -> Self {
        LoadOptions {
            library: library.into(),
            provider: None,
            threads: 1,
            load_timeout: LOAD_TIMEOUT,
            reference_bytes: DEFAULT_BYTES,
        }
    }
}

/// A repaired image and the hashes that a record has of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Repaired {
    /// `scale` times as large as the rendered image.
    pub image: Image,
    /// BLAKE3 of the rendered image.
    pub rendered_hash: blake3::Hash,
    /// BLAKE3 of the repaired image.
    pub hash: blake3::Hash,
}

/// Times of the parts of a repair.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RepairTimes {
    /// Time to convert images and maps to the inputs of the graph: their sizes and ranges.
    pub fit: Duration,
    /// Time of the graph, for all tiles.
    pub run: Duration,
    /// Time to convert its output to an image of 8 bits, and for the hashes.
    pub merge: Duration,
}

/// A model that is loaded, checked and ready. It runs one image at a time.
pub struct Model {
    runner: Runner,
    provider: Provider,
    repair_hash: blake3::Hash,
    /// The measured halo in pixels, if the fit is `tile`.
    halo: Option<usize>,
    is_deterministic: bool,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model")
            .field("name", &self.manifest().name)
            .field("halo", &self.halo)
            .finish_non_exhaustive()
    }
}

impl Model {
    /// Reads the manifest at `path` and the files that it pins, opens the runtime if this is the
    /// process's first model, and probes: shape, NaN, time, three equal runs; for tiles the halo,
    /// and that tiles equal the whole.
    ///
    /// # Errors
    /// All of [`RepairError`] except `Input`.
    pub fn load(path: &Path, options: &LoadOptions) -> Result<Model, RepairError> {
        let files = files::read(path)?;
        let manifest = &files.manifest;
        let wrong =
            |field: &str, message: String| RepairError::Input { field: field.to_owned(), message };
        // What costs nothing to check comes before the session, which may take minutes to build.
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
        // From here on the bytes that were hashed are those that run.
        let (worker, graph) = Worker::start(files.graph, &settings)?;
        signature::check(manifest, &graph, path)?;
        let mut hasher = blake3::Hasher::new();
        // The manifest pins the hashes of the files, so that its own bytes stand for them.
        hasher.update(&files.manifest_bytes).update(onnx::build_info().as_bytes());
        hasher.update(provider.name().as_bytes());
        let runner = Runner::new(files.manifest, worker);
        let Probed { is_deterministic, halo } = probe(&runner)?;
        Ok(Model { runner, provider, repair_hash: hasher.finalize(), halo, is_deterministic })
    }

    /// The manifest that the model was loaded from.
    pub fn manifest(&self) -> &Manifest {
        &self.runner.manifest
    }

    /// The execution provider that runs the graph.
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// The runtime: name of its library, which has the version, and the commit that it was built
    /// from.
    pub fn runtime(&self) -> String {
        let build = onnx::build_info();
        // `git-branch=..., git-commit-id=..., build type=...`: the words up to the next comma.
        let commit = build.split("git-commit-id=").nth(1).and_then(|rest| rest.split(',').next());
        format!("{}, commit {}", onnx::library_name(), commit.unwrap_or("unknown"))
    }

    /// BLAKE3 of everything that the output depends on, except the images: manifest (which pins the
    /// files), build of the runtime, provider.
    pub fn repair_hash(&self) -> blake3::Hash {
        self.repair_hash
    }

    /// The measured halo, if the fit is `tile`.
    pub fn halo(&self) -> Option<Halo> {
        self.halo.map(Halo::Pixels)
    }

    /// Whether three probe runs gave the same bytes.
    pub fn is_deterministic(&self) -> bool {
        self.is_deterministic
    }

    /// Whether an input has a role. Its value must then be in the [`View`].
    pub fn needs(&self, role: InputRole) -> bool {
        self.manifest().inputs.iter().any(|input| input.role == role)
    }

    /// Whether it ran too long too often, and no run will succeed any more. Loading it again makes
    /// it usable.
    pub fn is_withdrawn(&self) -> bool {
        self.runner.is_withdrawn()
    }

    /// Checks that images of a size can be repaired.
    ///
    /// # Errors
    /// `Input` or `Tiles`.
    pub fn check_size(&self, width: usize, height: usize) -> Result<(), RepairError> {
        let fitted = Fitted::new(&self.manifest().size, [height, width])?;
        self.windows(fitted.height, fitted.width).map(|_| ())
    }

    /// Repairs an image.
    ///
    /// # Errors
    /// `Input`, `Shape`, `NotFinite`, `TimedOut`, `Withdrawn`, `Run`, `Tiles`.
    pub fn repair(&self, view: &View<'_>) -> Result<Repaired, RepairError> {
        self.repair_timed(view).map(|(repaired, _)| repaired)
    }

    /// Repairs an image. Returns the times of the parts, too.
    ///
    /// # Errors
    /// As [`Model::repair`].
    pub fn repair_timed(&self, view: &View<'_>) -> Result<(Repaired, RepairTimes), RepairError> {
        let started = Instant::now();
        view.check()?;
        let manifest = self.manifest();
        let size = [view.rendered.height, view.rendered.width];
        let fitted = Fitted::new(&manifest.size, size)?;
        // Every map is fitted in the same way, so that all inputs have one size.
        let mut inputs = Vec::new();
        for input in self.runner.pixel_inputs() {
            inputs.push(fitted.fit(roles::planes(view, input)?, input.dtype));
        }
        let scalars = self.runner.scalars(view)?;
        let windows = self.windows(inputs[0].height, inputs[0].width)?;
        let scale = manifest.output().scale as usize;
        let channels = manifest.output().role.channels();
        // Tiles are pasted into it; their used parts cover each pixel once.
        let mut output = Planes::zeros(channels, inputs[0].height * scale, inputs[0].width * scale);
        let fitted_at = Instant::now();
        for window in &windows {
            let tile: Vec<Planes> = inputs.iter().map(|planes| planes.crop(window.seen)).collect();
            let returned = self.runner.run(&tile, &scalars)?;
            self.runner.check_finite(&returned)?;
            let used = window.used.scaled(scale);
            let seen = window.seen.scaled(scale);
            // The used part relative to the window, as the model returned only the window.
            let within = Rect { top: used.top - seen.top, left: used.left - seen.left, ..used };
            output.paste(&returned, within, used.top, used.left);
        }
        let run_at = Instant::now();
        let is_image = |input: &Input| matches!(input.role, InputRole::Rgb | InputRole::Luma);
        let at = self.runner.pixel_inputs().position(is_image).unwrap_or(0);
        // The padding is dropped on both sides, so that `merge` compares equal sizes.
        let seen = inputs[at].crop(fitted.content);
        let output = output.crop(fitted.content.scaled(scale));
        let image = merge::merge(manifest, view, seen, output);
        let hash = image.hash();
        let repaired = Repaired { image, rendered_hash: view.rendered.hash(), hash };
        let times = RepairTimes {
            fit: fitted_at - started,
            run: run_at - fitted_at,
            merge: run_at.elapsed(),
        };
        Ok((repaired, times))
    }

    /// The tiles of an image that fits, or the image.
    fn windows(&self, height: usize, width: usize) -> Result<Vec<Window>, RepairError> {
        // Only `Fit::Tile` has a halo.
        let Some(halo) = self.halo else {
            let whole = Rect { top: 0, left: 0, height, width };
            return Ok(vec![Window { seen: whole, used: whole }]);
        };
        self.runner.tiling(halo).windows(height, width)
    }
}
