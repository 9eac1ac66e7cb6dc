//! Every setting at every place: how far off it is from the definition, and what it costs.

use std::io::Cursor;
use std::sync::Arc;
use std::time::Instant;

use image::ImageReader;
use serde::Serialize;

use super::sample_points::{OFFSETS_M, SamplePoint};
use super::settings::{Family, Setting};
use super::timing::{Step, Timed, file};
use super::{ErrorImages, ReportError, error_images};
use wildcity_render::compare::errors::{ErrorAccumulator, Image, ImageErrors};
use wildcity_render::compare::images::{RenderedImage, render_images};
use wildcity_render::compare::json_numbers::{serialize_number, serialize_numbers};
use wildcity_render::gpu::Gpu;
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, RenderError, View};
use wildcity_scene::record::round_trip;
use wildcity_scene::sky::DrawableSky;
use wildcity_scene::{Rays, RenderProfile, Scene};
use wildcity_twin::residency::{PinnedScene, Resident};

/// What is measured, and on what.
pub struct Benchmark<'a> {
    /// The twin.
    pub resident: &'a Arc<Resident>,
    /// The backends that [`Setting::backend`] counts through.
    pub backends: &'a [Box<dyn Backend>],
    /// Where.
    pub places: &'a [SamplePoint],
    /// How often a step is timed at each place, after once that is not.
    pub repeat: u32,
    /// Opens a device that drew nothing yet, as that of the gpu backend, or says that there is none.
    pub device: &'a dyn Fn() -> Option<Gpu>,
}

/// The backend that draws on a device.
const GPU: &str = "gpu";

/// A setting, measured.
#[derive(Clone, Debug, Serialize)]
pub struct Measurement {
    /// What was measured.
    #[serde(flatten)]
    pub setting: Setting,
    /// Errors at all places.
    pub errors: ImageErrors,
    /// PSNR by [`OFFSETS_M`], in dB; one where there is no drive.
    #[serde(serialize_with = "serialize_numbers")]
    pub psnr_db_by_offset: Vec<f64>,
    /// The same place by place.
    pub by_place: Vec<SampleResult>,
    /// What it costs at all places on the drive.
    pub cost: Cost,
    /// Median time of a step of the twin as served, timed in turn with this one, in milliseconds.
    pub served_ms: f64,
    /// Where it is worst.
    #[serde(skip)]
    pub worst: ErrorImages,
}

/// A setting at one place.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SampleResult {
    /// Whether a setting may be chosen by it.
    pub chooses: bool,
    /// PSNR of all its windows together, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// PSNR of the window that has the least, in dB: what a setting is judged by.
    #[serde(serialize_with = "serialize_number")]
    pub least_db: f64,
    /// The 95th percentile of its steps, in milliseconds, which is the longest of fewer than twenty; none
    /// beside the drive, where no step is timed.
    pub p95_ms: Option<f64>,
}

/// What a step costs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Median time of a step of all cameras, in milliseconds: of drawing, and of encoding where the setting
    /// says how images are sent.
    pub step_ms: f64,
    /// Gaussians that a step draws, the most of all places.
    pub gaussians: u64,
    /// Memory that they and a baked sky take in the host, in bytes.
    pub scene_bytes: u64,
    /// Memory that all buffers take on a device that draws these steps and nothing else, in bytes. None on
    /// the host; nor where the driver does not count it, or a second device beside the backend's has no room.
    pub device_bytes: Option<u64>,
    /// Bytes of a Gaussian as it is stored, before compression.
    pub stored_bytes_each: f64,
    /// Bytes of a step's images as they are sent.
    pub sent_bytes: u64,
}

/// What a setting is compared with: the definition, in full detail and however far, by place and window.
pub struct ReferenceImages {
    images: Vec<Vec<Image>>,
    /// Time that a step of all cameras would take, in milliseconds: of the windows, times their share.
    pub step_ms: f64,
}

impl Benchmark<'_> {
    /// Draws the truth at all places, of splats or ray by ray; tells `progress` how many are done.
    ///
    /// # Errors
    /// The twin cannot be read, or a frame cannot be drawn.
    pub fn truth(
        &self,
        rays: Rays,
        progress: &mut dyn FnMut(usize),
    ) -> Result<ReferenceImages, ReportError> {
        let profile = RenderProfile { tau_px: 0.0, reach_m: None, rays, ..self.profile() };
        let (mut images, mut step_ms) = (Vec::new(), 0.0);
        for (done, place) in self.places.iter().enumerate() {
            progress(done);
            let scene = self.scene(&place.views, &profile)?;
            let start = Instant::now();
            let drawings = render_images(&Reference, &scene, &profile, &place.windows)?;
            let pixels = |views: &[View]| views.iter().map(|v| v.camera.pixels()).sum::<usize>();
            let share = pixels(&place.views) as f64 / pixels(&place.windows) as f64;
            step_ms += start.elapsed().as_secs_f64() * 1e3 * share / self.places.len() as f64;
            images.push(place.windows.iter().zip(&drawings).map(|(v, d)| shown(v, d)).collect());
        }
        Ok(ReferenceImages { images, step_ms })
    }

    /// Measures one setting.
    ///
    /// # Errors
    /// The twin cannot be read, a frame cannot be drawn, or an image cannot be encoded.
    pub fn measure(
        &self,
        setting: &Setting,
        truth: &ReferenceImages,
    ) -> Result<Measurement, ReportError> {
        let profile = setting.apply(self.profile())?;
        let backend = &*self.backends[setting.backend];
        let mut by_offset = vec![ErrorAccumulator::default(); OFFSETS_M.len()];
        let mut by_place = Vec::new();
        let (mut steps_ms, mut served_ms, mut cost) = (Vec::new(), Vec::new(), Cost::NOTHING);
        let device = if backend.name() == GPU { (self.device)() } else { None };
        let mut worst = (f64::INFINITY, None);
        for (place, truths) in self.places.iter().zip(&truth.images) {
            let own = place.scaled(setting.scale)?;
            let needed = self.scene(&own.views, &profile)?;
            let (stored, stored_bytes) = self.stored(setting, &needed);
            let scene: &Scene = stored.as_ref().unwrap_or(&needed);
            let offset = OFFSETS_M.iter().position(|o| *o == place.offset_m).unwrap_or(0);

            let drawings = render_images(backend, scene, &profile, &own.windows)?;
            let (mut here, mut windows_db) = (ErrorAccumulator::default(), Vec::new());
            for ((view, drawing), truth) in own.windows.iter().zip(&drawings).zip(truths) {
                let image = arrived(setting, view, drawing, truth.size_px)?;
                let db = here.add(&image, truth);
                windows_db.push(db);
                if db < worst.0 {
                    worst = (db, Some((place.name.clone(), image, truth.clone())));
                }
            }
            let psnr_db = here.errors().map_or(f64::INFINITY, |errors| errors.psnr_db);
            by_offset[offset].merge(&here);

            let mut p95_ms = None;
            if place.offset_m == 0.0 {
                let timed = self.time(setting, scene, &profile, &own.views, place)?;
                p95_ms = Some(quantile(&timed.steps_ms, 0.95));
                steps_ms.extend(timed.steps_ms);
                served_ms.extend(timed.served_ms);
                cost.gaussians = cost.gaussians.max(scene.gaussians() as u64);
                let bytes = scene.bytes() as u64 + sky_bytes(scene, &profile)?;
                cost.scene_bytes = cost.scene_bytes.max(bytes);
                cost.sent_bytes = cost.sent_bytes.max(timed.sent_bytes);
                cost.stored_bytes_each = stored_bytes;
                if let Some(device) = &device {
                    let (views, sent) = (&own.views[..], None);
                    let step = Step { backend: device, scene, profile: &profile, views, sent };
                    let held = step.draw().ok().and_then(|()| device.usage()?.allocated_bytes);
                    cost.device_bytes = cost.device_bytes.max(held);
                }
            }
            let least_db = least(windows_db);
            by_place.push(SampleResult { chooses: place.chooses, psnr_db, least_db, p95_ms });
        }
        let mut all = ErrorAccumulator::default();
        by_offset.iter().for_each(|gathered| all.merge(gathered));
        cost.step_ms = quantile(&steps_ms, 0.5);
        let db = |gathered: &ErrorAccumulator| gathered.errors().map(|errors| errors.psnr_db);
        let worst = worst.1.map(|(place, image, truth)| error_images::of(place, &image, &truth));
        Ok(Measurement {
            setting: setting.clone(),
            errors: all.errors().ok_or(ReportError::NoSamplePoints)?,
            psnr_db_by_offset: by_offset.iter().filter_map(db).collect(),
            by_place,
            cost,
            served_ms: quantile(&served_ms, 0.5),
            worst: worst.transpose()?.unwrap_or_default(),
        })
    }

    fn time(
        &self,
        setting: &Setting,
        scene: &Scene,
        profile: &RenderProfile,
        views: &[View],
        place: &SamplePoint,
    ) -> Result<Timed, ReportError> {
        let backend = &*self.backends[setting.backend];
        let own = Step { backend, scene, profile, views, sent: setting.sent };
        let (usual, views) = (self.profile(), &place.views);
        let scene = self.scene(views, &usual)?;
        let backend = &*self.backends[0];
        let served = Step { backend, scene: &scene, profile: &usual, views, sent: None };
        own.time(&served, self.repeat)
    }

    fn profile(&self) -> RenderProfile {
        self.resident.version.manifest.profile
    }

    fn scene(&self, views: &[View], profile: &RenderProfile) -> Result<PinnedScene, ReportError> {
        Ok(self.resident.scene(&wildcity_session::viewpoints(views), profile)?)
    }

    /// The scene in the setting's record, if it is another one, and bytes of a Gaussian in it.
    fn stored(&self, setting: &Setting, scene: &Scene) -> (Option<Scene>, f64) {
        let manifest = &self.resident.version.manifest;
        match setting.record {
            None => (None, manifest.record.bits(manifest.sh_degree) as f64 / 8.0),
            Some(record) => {
                let coded = round_trip(scene, record);
                let bytes = record.bits(manifest.sh_degree) as f64 / 8.0;
                (Some(coded.scene), bytes)
            }
        }
    }
}

impl Measurement {
    /// Least PSNR of a window at any place, in dB.
    pub fn least_db(&self) -> f64 {
        least(self.by_place.iter().map(|place| place.least_db))
    }

    /// The longest 95th percentile of a place's steps, in milliseconds: what `--at-most-ms` goes by.
    pub fn p95_ms(&self) -> f64 {
        let all = self.by_place.iter().filter_map(|place| place.p95_ms);
        all.fold(f64::NAN, f64::max)
    }

    /// Whether it draws the same images of the same Gaussians as the twin as served, in the same memory:
    /// all that its time can differ by is chance.
    pub fn changes_nothing(&self, served: &Self) -> bool {
        let db = |m: &Self| -> Vec<[f64; 2]> {
            m.by_place.iter().map(|place| [place.psnr_db, place.least_db]).collect()
        };
        let held = |m: &Self| (m.setting.backend, m.cost.gaussians, m.cost.scene_bytes);
        let same_images = self.errors == served.errors && db(self) == db(served);
        self.setting.family != Family::AsServed && same_images && held(self) == held(served)
    }
}

/// Memory that the sky takes in the form in which a profile draws it, in bytes.
pub(super) fn sky_bytes(scene: &Scene, profile: &RenderProfile) -> Result<u64, RenderError> {
    let drawn = scene.sky.as_ref().map(|sky| sky.drawable(profile.sky_error));
    Ok(match drawn.transpose()? {
        Some(DrawableSky::CubeMap(map)) => map.bytes() as u64,
        Some(DrawableSky::Network(_)) | None => 0,
    })
}

impl Cost {
    const NOTHING: Self = Self {
        step_ms: 0.0,
        gaussians: 0,
        scene_bytes: 0,
        device_bytes: None,
        stored_bytes_each: 0.0,
        sent_bytes: 0,
    };
}

/// What arrives of a drawing, at the size of what it is compared with.
fn arrived(
    setting: &Setting,
    view: &View,
    drawing: &RenderedImage,
    size_px: [u32; 2],
) -> Result<Image, ReportError> {
    let mut image = shown(view, drawing);
    if setting.sent.is_some() {
        let encoded = file(setting.sent, view, &drawing.rgb8);
        let encoded = encoded.map_err(|reason| ReportError::Encode { reason })?;
        let bytes = match encoded {
            None => drawing.rgb8.clone(),
            Some(file) => decoded(&file)?,
        };
        image.rgb = bytes.iter().map(|&byte| f32::from(byte) / 255.0).collect();
    }
    Ok(if image.size_px == size_px { image } else { image.resized(size_px) })
}

fn decoded(file: &[u8]) -> Result<Vec<u8>, ReportError> {
    let reason = |error: String| ReportError::Encode { reason: error };
    let reader = ImageReader::new(Cursor::new(file)).with_guessed_format();
    let reader = reader.map_err(|error| reason(error.to_string()))?;
    let image = reader.decode().map_err(|error| reason(error.to_string()))?;
    Ok(image.into_rgb8().into_raw())
}

/// A drawing as it is shown.
fn shown(view: &View, drawing: &RenderedImage) -> Image {
    let rgba = drawing.rgba.chunks_exact(4);
    Image {
        size_px: [view.camera.width_px, view.camera.height_px],
        rgb: rgba.flat_map(|rgba| [0, 1, 2].map(|c| rgba[c].clamp(0.0, 1.0))).collect(),
        depth_m: drawing.depth_m.clone(),
        opacity: drawing.opacity.clone(),
    }
}

/// The least of them; NaN if one is, or of none.
pub(super) fn least(values: impl IntoIterator<Item = f64>) -> f64 {
    let lesser = |a: f64, b: f64| if a.is_nan() || a <= b { a } else { b };
    values.into_iter().reduce(lesser).unwrap_or(f64::NAN)
}

/// The value that a share of all keeps below; NaN of none.
pub(super) fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted.get((last as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
}

/// Scales all times to one speed of the machine: that at which the twin as served took its median time.
/// A setting that was measured while others compiled is then no slower than the rest. It is the first
/// backend's time that says how fast the machine was, for settings of the others too.
pub fn normalize_machine_speed(all: &mut [Measurement]) {
    let served_ms: Vec<f64> = all.iter().map(|m| m.served_ms).collect();
    let usual_ms = quantile(&served_ms, 0.5);
    for m in all {
        let faster = usual_ms / m.served_ms;
        m.served_ms = usual_ms;
        m.cost.step_ms *= faster;
        m.by_place.iter_mut().flat_map(|place| &mut place.p95_ms).for_each(|ms| *ms *= faster);
    }
}
