//! The error of each setting against the reference, and its cost.
//!
//! **Windows are compared, and whole steps are timed.** The f64 reference takes a minute for six
//! full images. Windows keep the full focal length, since levels of detail depend on it: a smaller
//! image would be another test. All settings see the same windows. The PSNR is of values before
//! they are rounded to 8 bits, since the rounding by itself limits PSNR to 59 dB.

use std::io::Cursor;
use std::sync::Arc;
use std::time::Instant;

use image::ImageReader;

use super::error::ReportError;
use super::error_images::ErrorImages;
use super::measurement::{Cost, Measurement, SampleResult};
use super::sample_points::{OFFSETS_M, SamplePoint};
use super::setting::Setting;
use super::statistics::{min, quantile};
use super::timing::{Step, StepTimes, encode};
use wildcity_render::compare::errors::{ErrorAccumulator, Image, ImageErrors};
use wildcity_render::compare::images::{RenderedImage, render_images};
use wildcity_render::gpu::Gpu;
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, RenderError, View};
use wildcity_scene::record::round_trip;
use wildcity_scene::sky::DrawableSky;
use wildcity_scene::{Rays, RenderProfile, Scene};
use wildcity_twin::residency::{PinnedScene, Resident};

/// A twin, the backends, and the sample points that settings are measured at.
pub struct Benchmark<'a> {
    pub resident: &'a Arc<Resident>,
    /// The backends; [`Setting::backend`] is an index into them. The first one renders the
    /// baseline.
    pub backends: &'a [Box<dyn Backend>],
    pub sample_points: &'a [SamplePoint],
    /// Number of timed runs of a step at each point, after one run that is not counted.
    pub repeat: u32,
    /// Opens a new instance of the gpu backend's device, which has rendered nothing yet. None if
    /// there is no device.
    pub open_device: &'a dyn Fn() -> Option<Gpu>,
}

/// Name of the backend that renders on a device.
const GPU: &str = "gpu";

/// Images of the f64 reference, at full detail and without a draw distance.
pub struct ReferenceImages {
    /// The images, by sample point and window.
    windows: Vec<Vec<Image>>,
    /// Time that a step of all cameras would take, in milliseconds: the time of the windows, scaled
    /// to the pixels of the whole images.
    pub step_ms: f64,
}

impl Benchmark<'_> {
    /// Renders the reference at all sample points, with splats or with a ray for every pixel. Calls
    /// `progress` with the number of points that are done.
    ///
    /// # Errors
    /// The twin cannot be read, or a frame cannot be rendered.
    pub fn render_reference(
        &self,
        rays: Rays,
        progress: &mut dyn FnMut(usize),
    ) -> Result<ReferenceImages, ReportError> {
        // Full detail and no draw distance, so that the error of both shows in every setting.
        let profile = RenderProfile { tau_px: 0.0, reach_m: None, rays, ..self.profile() };
        let pixels = |views: &[View]| views.iter().map(|v| v.camera.pixels()).sum::<usize>();
        let mut windows = Vec::new();
        let mut step_ms = 0.0;
        for (done, point) in self.sample_points.iter().enumerate() {
            progress(done);
            // Outside of the timed part: loading sections is not the cost of a step.
            let scene = self.scene(&point.views, &profile)?;
            let start = Instant::now();
            let drawings = render_images(&Reference, &scene, &profile, &point.windows)?;
            let windows_ms = start.elapsed().as_secs_f64() * 1e3;
            // The reference tests every pixel against every splat: its time is proportional
            // to the pixels.
            let pixel_ratio = pixels(&point.views) as f64 / pixels(&point.windows) as f64;
            step_ms += windows_ms * pixel_ratio / self.sample_points.len() as f64;
            let images = point.windows.iter().zip(&drawings);
            windows.push(images.map(|(view, drawing)| displayed(view, drawing)).collect());
        }
        Ok(ReferenceImages { windows, step_ms })
    }

    /// Measures one setting against the reference.
    ///
    /// # Errors
    /// The twin cannot be read, a frame cannot be rendered, or an image cannot be encoded.
    pub fn measure(
        &self,
        setting: &Setting,
        reference: &ReferenceImages,
    ) -> Result<Measurement, ReportError> {
        // Fails for a setting that the twin's profile does not allow.
        let profile = setting.apply(self.profile())?;
        let backend = &*self.backends[setting.backend];
        // A device of its own, as the memory of the backend's has held other settings.
        let device = if backend.name() == GPU { (self.open_device)() } else { None };
        let mut errors = ErrorTotals::new();
        let mut costs = CostTotals::new();
        let mut by_sample_point = Vec::new();
        for (point, references) in self.sample_points.iter().zip(&reference.windows) {
            // The scene as this setting renders it: its images, its detail, its record format.
            let scaled_point = point.scaled(setting)?;
            let pinned = self.scene(&scaled_point.views, &profile)?;
            // There and back, so that the Gaussians have what the format has lost.
            let converted = setting.record.map(|record| round_trip(&pinned, record).scene);
            let scene: &Scene = converted.as_ref().unwrap_or(&pinned);

            // Errors, in the windows.
            let views = &scaled_point.windows;
            let drawings = render_images(backend, scene, &profile, views)?;
            let mut images = Vec::with_capacity(views.len());
            for (view, drawing) in views.iter().zip(&drawings) {
                images.push(received(setting, view, drawing)?);
            }
            // An image of another size is compared with the reference shrunk to it.
            let shrunk: Vec<Image>;
            let references = if setting.scale == 1.0 {
                references
            } else {
                let pairs = references.iter().zip(&images);
                shrunk = pairs.map(|(truth, image)| truth.averaged(image.size_px)).collect();
                &shrunk
            };
            let PointErrors { psnr_db, min_db } = errors.add(point, images, references);

            // Cost, of whole steps on the drive.
            // The points off the drive show the error only.
            let is_timed = point.offset_m == 0.0;
            let mut p95_ms = None;
            if is_timed {
                let views = &scaled_point.views;
                let step =
                    Step { backend, scene, profile: &profile, views, encoding: setting.encoding };
                let times = self.time(&step, point)?;
                // At each point by itself: a slow place must not vanish among fast ones.
                p95_ms = Some(quantile(&times.steps_ms, 0.95));
                costs.add(&step, times, device.as_ref())?;
            }
            let for_selection = point.for_selection;
            by_sample_point.push(SampleResult { for_selection, psnr_db, min_db, p95_ms });
        }

        let manifest = &self.resident.version.manifest;
        let record = setting.record.unwrap_or(manifest.record);
        let stored_bytes = record.bits(manifest.sh_degree) as f64 / 8.0;
        // The median, since a single step that was interrupted says nothing of the machine.
        let baseline_ms = quantile(&costs.baseline_ms, 0.5);
        Ok(Measurement {
            setting: setting.clone(),
            errors: errors.all()?,
            psnr_db_by_offset: errors.psnr_db_by_offset(),
            by_sample_point,
            cost: costs.cost(stored_bytes),
            baseline_ms,
            worst: errors.worst_images()?,
        })
    }

    /// Times a step at a sample point, in turn with the step of the twin as it is served.
    fn time(&self, step: &Step<'_>, point: &SamplePoint) -> Result<StepTimes, ReportError> {
        let profile = self.profile();
        let scene = self.scene(&point.views, &profile)?;
        let baseline = Step {
            // Always the first backend, so that all settings are compared with one clock.
            backend: &*self.backends[0],
            scene: &scene,
            profile: &profile,
            views: &point.views,
            encoding: None,
        };
        step.time(&baseline, self.repeat)
    }

    pub(super) fn profile(&self) -> RenderProfile {
        self.resident.version.manifest.profile
    }

    pub(super) fn scene(
        &self,
        views: &[View],
        profile: &RenderProfile,
    ) -> Result<PinnedScene, ReportError> {
        Ok(self.resident.scene(&wildcity_session::viewpoints(views), profile)?)
    }
}

/// Errors of one setting, gathered over the sample points.
struct ErrorTotals {
    by_offset: Vec<ErrorAccumulator>,
    worst: Option<WorstWindow>,
}

/// The window with the least PSNR until now.
struct WorstWindow {
    psnr_db: f64,
    sample_point: String,
    image: Image,
    reference: Image,
}

/// Errors at one sample point.
struct PointErrors {
    /// PSNR of all windows together, in dB.
    psnr_db: f64,
    /// PSNR of the worst window, in dB.
    min_db: f64,
}

impl ErrorTotals {
    fn new() -> Self {
        Self { by_offset: vec![ErrorAccumulator::default(); OFFSETS_M.len()], worst: None }
    }

    /// Adds the windows of a sample point.
    fn add(
        &mut self,
        point: &SamplePoint,
        images: Vec<Image>,
        references: &[Image],
    ) -> PointErrors {
        let mut gathered = ErrorAccumulator::default();
        let mut windows_db = Vec::with_capacity(images.len());
        for (image, reference) in images.into_iter().zip(references) {
            let psnr_db = gathered.add(&image, reference);
            windows_db.push(psnr_db);
            // `<` and not `<=`: of equal ones the first stays. A NaN is never less, so that its
            // window is not shown.
            let worst_db = self.worst.as_ref().map_or(f64::INFINITY, |worst| worst.psnr_db);
            if psnr_db < worst_db {
                let sample_point = point.name.clone();
                let reference = reference.clone();
                self.worst = Some(WorstWindow { psnr_db, sample_point, image, reference });
            }
        }
        // A twin without a drive has the offset 0 at all points.
        let offset = OFFSETS_M.iter().position(|offset_m| *offset_m == point.offset_m);
        self.by_offset[offset.unwrap_or(0)].merge(&gathered);
        PointErrors {
            psnr_db: gathered.errors().map_or(f64::INFINITY, |errors| errors.psnr_db),
            min_db: min(windows_db),
        }
    }

    /// Errors at all sample points together.
    fn all(&self) -> Result<ImageErrors, ReportError> {
        let mut all = ErrorAccumulator::default();
        self.by_offset.iter().for_each(|gathered| all.merge(gathered));
        all.errors().ok_or(ReportError::NoSamplePoints)
    }

    /// In dB; only of distances that have sample points.
    fn psnr_db_by_offset(&self) -> Vec<f64> {
        let errors = self.by_offset.iter().filter_map(ErrorAccumulator::errors);
        errors.map(|errors| errors.psnr_db).collect()
    }

    /// The worst window; empty if no window differs from the reference.
    fn worst_images(self) -> Result<ErrorImages, ReportError> {
        match self.worst {
            None => Ok(ErrorImages::default()),
            Some(WorstWindow { sample_point, image, reference, .. }) => {
                ErrorImages::new(sample_point, &image, &reference)
            }
        }
    }
}

/// Costs of one setting, gathered over the sample points.
struct CostTotals {
    cost: Cost,
    steps_ms: Vec<f64>,
    baseline_ms: Vec<f64>,
}

impl CostTotals {
    fn new() -> Self {
        Self { cost: Cost::ZERO, steps_ms: Vec::new(), baseline_ms: Vec::new() }
    }

    /// Adds a step that was timed. `device` renders it once more, to show what memory it takes.
    fn add(
        &mut self,
        step: &Step<'_>,
        times: StepTimes,
        device: Option<&Gpu>,
    ) -> Result<(), ReportError> {
        self.steps_ms.extend(times.steps_ms);
        self.baseline_ms.extend(times.baseline_ms);
        let cost = &mut self.cost;
        // The largest of the points: this is what a machine has to hold.
        cost.gaussians = cost.gaussians.max(step.scene.gaussians() as u64);
        let scene_bytes = step.scene.bytes() as u64 + sky_bytes(step.scene, step.profile)?;
        cost.scene_bytes = cost.scene_bytes.max(scene_bytes);
        cost.sent_bytes = cost.sent_bytes.max(times.sent_bytes);
        if let Some(device) = device {
            let on_device = Step { backend: device, encoding: None, ..*step };
            // A device without room for the step leaves no value; it is not an error of the report.
            let rendered = on_device.render().ok();
            let allocated_bytes = rendered.and_then(|()| device.usage()?.allocated_bytes);
            cost.device_bytes = cost.device_bytes.max(allocated_bytes);
        }
        Ok(())
    }

    fn cost(&self, stored_bytes_per_gaussian: f64) -> Cost {
        // Over the steps of all points together.
        let step_ms = quantile(&self.steps_ms, 0.5);
        Cost { step_ms, stored_bytes_per_gaussian, ..self.cost }
    }
}

/// Memory that the sky takes in the form in which a profile renders it, in bytes: 0 unless it is a
/// map.
pub(super) fn sky_bytes(scene: &Scene, profile: &RenderProfile) -> Result<u64, RenderError> {
    let drawn = scene.sky.as_ref().map(|sky| sky.drawable(profile.sky_error));
    Ok(match drawn.transpose()? {
        Some(DrawableSky::CubeMap(map)) => map.bytes() as u64,
        Some(DrawableSky::Network(_)) | None => 0,
    })
}

/// The image that an agent receives.
fn received(setting: &Setting, view: &View, drawing: &RenderedImage) -> Result<Image, ReportError> {
    let mut image = displayed(view, drawing);
    // Without an encoding the values are compared before rounding, see the head of this file.
    if setting.encoding.is_some() {
        let encoded = encode(setting.encoding, view, &drawing.rgb8)
            .map_err(|reason| ReportError::Encode { reason })?;
        let rgb8 = match encoded {
            // `Raw`: the 8 bits themselves.
            None => drawing.rgb8.clone(),
            Some(file) => decode(&file)?,
        };
        image.rgb = rgb8.iter().map(|&byte| f32::from(byte) / 255.0).collect();
    }
    Ok(image)
}

fn decode(file: &[u8]) -> Result<Vec<u8>, ReportError> {
    let failed = |reason: String| ReportError::Encode { reason };
    let reader = ImageReader::new(Cursor::new(file))
        .with_guessed_format()
        .map_err(|error| failed(error.to_string()))?;
    let image = reader.decode().map_err(|error| failed(error.to_string()))?;
    Ok(image.into_rgb8().into_raw())
}

/// A drawing as a display shows it: colour clamped to [0, 1].
fn displayed(view: &View, drawing: &RenderedImage) -> Image {
    let rgba = drawing.rgba.chunks_exact(4);
    Image {
        size_px: [view.camera.width_px, view.camera.height_px],
        rgb: rgba.flat_map(|rgba| [0, 1, 2].map(|c| rgba[c].clamp(0.0, 1.0))).collect(),
        depth_m: drawing.depth_m.clone(),
        opacity: drawing.opacity.clone(),
    }
}
