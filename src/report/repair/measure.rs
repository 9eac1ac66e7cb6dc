//! Renders views on and off the recorded drive, repairs them, and compares them with ground truth.

use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use wildcity_render::compare::flip::flip;
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_repair::reference::{Projection, Rays, ReferenceCache, opaque_depth};
use wildcity_repair::{InputRole, Model};
use wildcity_scene::Trajectory;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::rig::RigCamera;
use wildcity_session::{
    NeededReferences, OfflineDrawing, OfflineReferences, OfflineView, ReferenceSource,
    RenderedImage, TrainingCoverage, ViewReferences,
};
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use super::RepairReport;
use super::below::{Gains, recommend_below};
use super::flicker::FlickerPair;
use super::row::{EXACT_DB, ImageKind, RepairMs, RepairRow, RepairedModel, Sample};
use super::stations::{RepairSampling, RepairStation};
use crate::error::ReportError;

/// Index of the rendered image among the kinds, and of the warped one. The models come after them.
const RENDERED: usize = 0;
const WARPED: usize = 1;
const FIRST_MODEL: usize = 2;

/// The twin, models and poses that are measured.
pub struct RepairBenchmark<'a> {
    pub resident: &'a Arc<Resident>,
    /// Where it is stored, with its recorded images.
    pub catalog: &'a Catalog,
    /// The twin that is the ground truth; `None` if there is none.
    pub truth: Option<&'a Arc<Resident>>,
    /// The backend that renders.
    pub backend: &'a dyn Backend,
    pub cameras: &'a [RigCamera],
    pub models: &'a [Arc<Model>],
    /// Recorded images in memory.
    pub references: &'a ReferenceCache,
    /// The poses, and the size of the images.
    pub sampling: RepairSampling,
}

/// The twin, models and images that were measured.
#[derive(Clone, Debug, Serialize)]
pub struct RepairSubject {
    /// The poses, and the size of the images.
    pub sampling: RepairSampling,
    /// Cameras of a pose.
    pub cameras: usize,
    /// Width and height of the first camera's images.
    pub size_px: [u32; 2],
    /// Source of the reference images: `recorded` images, or the twin `rendered` on its drive.
    pub references: &'static str,
    /// Number of reference images that were read or rendered, with their depth. They stay in
    /// memory.
    pub read: usize,
    /// Mean time to read and render one of them, in milliseconds.
    pub read_ms: f64,
    /// The ground truth; `None` if there is none.
    pub truth: Option<Truth>,
    /// The models, in the order of the rows.
    pub models: Vec<RepairedModel>,
}

/// The twin that is the ground truth.
#[derive(Clone, Debug, Serialize)]
pub struct Truth {
    pub twin: String,
    /// Number of its version.
    pub version: u64,
    /// Hash of the version.
    pub version_hash: String,
}

/// Measures repair. Calls `progress` with the number of poses that are done, and with all.
///
/// # Errors
/// A model does not fit, or fails; or a twin cannot be read or rendered.
pub fn measure(
    benchmark: &RepairBenchmark<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<RepairReport, ReportError> {
    let first = benchmark.resident.version.manifest.trajectories.first();
    // Without a drive there is no "beside".
    let drive = first.ok_or(ReportError::NoDrive)?;
    let cameras = benchmark.sampling.cameras(benchmark.cameras)?;
    let mut measurement = RepairMeasurement::new(benchmark, &cameras)?;
    let samples = measurement.samples(drive, progress)?;
    let subject = measurement.subject();

    let models = subject.models.iter().map(|model| (ImageKind::Model, model.name.clone()));
    let mut kinds = vec![
        (ImageKind::Rendered, "rendered".to_owned()),
        (ImageKind::Warped, "warped".to_owned()),
    ];
    kinds.extend(models);
    // Distance by distance, and within each in the order of the kinds: so the table reads.
    let mut rows = Vec::new();
    for (offset, offset_m) in benchmark.sampling.offsets_m.iter().enumerate() {
        // A linear search per row: some thousand samples at most.
        let of = |kind: usize| -> Vec<&Sample> {
            samples.iter().filter(|one| (one.offset, one.kind) == (offset, kind)).collect()
        };
        // What all kinds of this distance are compared with.
        let rendered = of(RENDERED);
        for (index, (kind, name)) in kinds.iter().enumerate() {
            rows.push(RepairRow::new(*offset_m, *kind, name.clone(), &of(index), &rendered));
        }
    }
    let mut below = Vec::new();
    if benchmark.truth.is_some() {
        for (index, model) in subject.models.iter().enumerate() {
            let gains = |for_selection: bool| -> Vec<Gains> {
                let own = |one: &&Sample| {
                    (one.kind, one.for_selection) == (FIRST_MODEL + index, for_selection)
                };
                // Each model by itself: they differ in where they begin to gain.
                let of = |one: &Sample| Some(Gains { trust: one.trust, gain_db: one.gain_db? });
                samples.iter().filter(own).filter_map(of).collect()
            };
            below.push(recommend_below(model.name.clone(), &gains(true), &gains(false)));
        }
    }
    Ok(RepairReport { subject, rows, below })
}

/// A measurement of repair: its input, and the state that is shared by all poses.
struct RepairMeasurement<'a> {
    benchmark: &'a RepairBenchmark<'a>,
    cameras: &'a [RigCamera],
    offline: OfflineReferences,
    coverage: TrainingCoverage,
    /// The projection and the rays of each camera.
    optics: Vec<(Arc<Projection>, Rays)>,
    read: usize,
    read_ms: f64,
}

/// The images of a camera in one frame.
struct KindImages {
    /// Red, green and blue of 8 bits, by kind.
    rgb8: Vec<Vec<u8>>,
    /// Times of the repair, by kind.
    repair_ms: Vec<RepairMs>,
    /// Share of the pixels that recorded images cover.
    covered: f64,
}

impl<'a> RepairMeasurement<'a> {
    fn new(
        benchmark: &'a RepairBenchmark<'a>,
        cameras: &'a [RigCamera],
    ) -> Result<Self, ReportError> {
        let RepairBenchmark { resident, catalog, .. } = *benchmark;
        let coverage =
            TrainingCoverage::new(&resident.version.manifest).ok_or(ReportError::NoDrive)?;
        // References are read as a session does it, without a session.
        let offline = OfflineReferences::open(resident.clone(), catalog.clone(), cameras, &[])?;
        // Before the first image: a model that does not fit would fail after minutes.
        benchmark.models.iter().try_for_each(|model| offline.check(model, cameras))?;
        // Tables of 513 x 513 directions: once per camera and not per image.
        let optics_of_one = |camera: &RigCamera| {
            (Arc::new(Projection::from_camera(&camera.camera)), Rays::from_camera(&camera.camera))
        };
        let optics = cameras.iter().map(optics_of_one).collect();
        Ok(Self { benchmark, cameras, offline, coverage, optics, read: 0, read_ms: 0.0 })
    }

    fn subject(&self) -> RepairSubject {
        let model = |model: &Arc<Model>| {
            let manifest = model.manifest();
            RepairedModel {
                name: manifest.name.clone(),
                version: manifest.version.clone(),
                licence: manifest.licence.clone(),
                repair_hash: model.repair_hash().to_hex().to_string(),
                provider: model.provider().name(),
                deterministic: model.is_deterministic(),
            }
        };
        let truth = |truth: &Arc<Resident>| Truth {
            twin: truth.version.manifest.twin.clone(),
            version: truth.version.number,
            version_hash: truth.version.hash.clone(),
        };
        let size_px = self.cameras.first().map(|camera| camera.camera);
        RepairSubject {
            sampling: self.benchmark.sampling.clone(),
            cameras: self.cameras.len(),
            size_px: size_px.map_or([0; 2], |camera| [camera.width_px, camera.height_px]),
            references: match self.offline.source() {
                Some(ReferenceSource::Recorded) => "recorded",
                Some(ReferenceSource::Rendered) | None => "rendered",
            },
            read: self.read,
            // At least 1: nothing was read if all references were in memory.
            read_ms: self.read_ms / self.read.max(1) as f64,
            truth: self.benchmark.truth.map(truth),
            models: self.benchmark.models.iter().map(model).collect(),
        }
    }

    fn samples(
        &mut self,
        drive: &Trajectory,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Vec<Sample>, ReportError> {
        let stations = self.benchmark.sampling.stations(drive, self.cameras);
        let mut samples = Vec::new();
        for (done, station) in stations.iter().enumerate() {
            progress(done, stations.len());
            self.add_station(station, &mut samples)?;
        }
        Ok(samples)
    }

    fn add_station(
        &mut self,
        station: &RepairStation,
        samples: &mut Vec<Sample>,
    ) -> Result<(), ReportError> {
        let resident = self.benchmark.resident;
        // Render the earlier frame first: it loads the sections, so that the timed render of the
        // current frame does not wait for the disk.
        let (mut before, _) = self.render_cameras(resident, &station.views[1])?;
        let (mut now, render_ms) = self.render_cameras(resident, &station.views[0])?;
        let mut truths = [Vec::new(), Vec::new()];
        if let Some(truth) = self.benchmark.truth {
            // The same poses in the twin that is the truth, with its own profile.
            for (images, views) in truths.iter_mut().zip(&station.views) {
                *images = self.render_cameras(truth, views)?.0;
            }
        }
        let [true_now, true_before] = truths;
        // From here on camera by camera: images of one camera are independent of the others.
        for camera in 0..self.cameras.len() {
            let frames = [&mut now[camera], &mut before[camera]];
            for (frame, image) in frames.into_iter().enumerate() {
                let pose = &station.world_from_rig[frame];
                let view = &station.views[frame][camera];
                image.trust = self.coverage.trust(pose, view, &image.opacity).value;
            }
            let now = &now[camera];
            let before = &before[camera];
            // This frame first: references that it reads are in memory for the earlier one.
            let images = self.repair_all_kinds(station, 0, camera, now)?;
            let images_before = self.repair_all_kinds(station, 1, camera, before)?;
            let views = [0, 1].map(|frame| &station.views[frame][camera]);
            let flicker = |images: [&RenderedImage; 2], pixels: [&[u8]; 2]| {
                // Rendered depth, for repaired pixels as well: a model returns no depth.
                let depth_m = images.map(|image| opaque_depth(&image.depth_m, &image.opacity));
                let (projection, rays) = &self.optics[camera];
                let depth_m = [&depth_m[0][..], &depth_m[1][..]];
                FlickerPair { views, depth_m, projection, rays }.flicker(pixels)
            };
            let truth = true_now.get(camera).zip(true_before.get(camera));
            let true_flicker =
                // The depth of the truth, not of the twin, since its surfaces may lie elsewhere.
                truth.and_then(|(now, before)| flicker([now, before], [&now.rgb8, &before.rgb8]));
            let true_rgb8 = truth.map(|(now, _)| &now.rgb8[..]);
            let size_px = [views[0].camera.width_px, views[0].camera.height_px];
            // The baseline of all gains at this camera and pose.
            let rendered_db = true_rgb8.map(|truth| psnr_db(&now.rgb8, truth));
            for kind in 0..images.rgb8.len() {
                let pixels = &images.rgb8[kind];
                let psnr_db = true_rgb8.map(|truth| psnr_db(pixels, truth));
                samples.push(Sample {
                    offset: station.offset,
                    kind,
                    for_selection: station.for_selection,
                    trust: now.trust,
                    covered: images.covered,
                    // Cameras are rendered together: each gets an equal share of the time.
                    render_ms: render_ms / self.cameras.len() as f64,
                    repair_ms: images.repair_ms[kind],
                    psnr_db,
                    // 0 for the rendered image itself.
                    gain_db: psnr_db.zip(rendered_db).map(|(own, rendered)| own - rendered),
                    flip: true_rgb8.map(|truth| mean_flip(pixels, truth, size_px)),
                    flicker: flicker([now, before], [pixels, &images_before.rgb8[kind]]),
                    true_flicker,
                });
            }
        }
        Ok(())
    }

    /// Renders all cameras of a twin. Returns the images, and the time in milliseconds.
    fn render_cameras(
        &self,
        resident: &Arc<Resident>,
        views: &[View],
    ) -> Result<(Vec<RenderedImage>, f64), ReportError> {
        let reads_normals = |model: &Arc<Model>| model.needs(InputRole::Normals);
        // Normals take time, and only some models read them.
        let needs_normals = self.benchmark.models.iter().any(reads_normals);
        let profile = &resident.version.manifest.profile;
        let scene = resident.scene(&wildcity_session::viewpoints(views), profile)?;
        let empty = |view: &View| {
            let pixels = view.camera.pixels();
            RenderedImage {
                rgb8: vec![0; 3 * pixels],
                depth_m: vec![0.0; pixels],
                opacity: vec![0.0; pixels],
                normals: vec![0.0; if needs_normals { 3 * pixels } else { 0 }],
                trust: 0.0,
            }
        };
        let mut images: Vec<RenderedImage> = views.iter().map(empty).collect();
        let exposures =
            // The exposure belongs to the image; the ego vehicle's overlay does not, see
            // `RepairSampling::cameras`.
            |camera: &RigCamera| Appearance { exposure: camera.appearance.exposure, overlay: None };
        let exposures: Vec<Appearance> = self.cameras.iter().map(exposures).collect();
        let targets = images.iter_mut().zip(&exposures).map(|(image, appearance)| Target {
            rgb8: Some(&mut image.rgb8),
            depth_m: Some(&mut image.depth_m),
            opacity: Some(&mut image.opacity),
            normals: needs_normals.then_some(&mut image.normals[..]),
            appearance: Some(appearance),
            ..Target::default()
        });
        let mut targets: Vec<Target<'_>> = targets.collect();
        let frame = Frame { scene: &scene, profile, views };
        let started = Instant::now();
        self.benchmark.backend.render(&frame, &mut targets, &|_, _| {})?;
        let ms = 1e3 * started.elapsed().as_secs_f64();
        // The targets borrow the images.
        drop(targets);
        Ok((images, ms))
    }

    /// The image of a camera in all kinds: rendered, warped, and repaired by each model.
    fn repair_all_kinds(
        &mut self,
        station: &RepairStation,
        frame: usize,
        camera: usize,
        rendered: &RenderedImage,
    ) -> Result<KindImages, ReportError> {
        let view = &station.views[frame][camera];
        let world_from_rig = &station.world_from_rig[frame];
        let RepairBenchmark { resident, backend, references, models, .. } = *self.benchmark;
        let mounted = &self.cameras[camera];
        let (_, rays) = &self.optics[camera];
        // No kept image: each frame is repaired by itself.
        let of = OfflineView { camera: mounted, rays, view, world_from_rig, rendered, kept: None };
        // One more image to read, if any model asks for it.
        let nearest = models.iter().any(|model| model.needs(InputRole::Reference));
        let profile = &resident.version.manifest.profile;
        let drawing = OfflineDrawing { profile, backend, cache: references };
        // Warped always, as it is a kind of its own.
        let needed = NeededReferences { warped: true, nearest };
        let beside = self.offline.beside(&of, needed, drawing)?;
        self.read += beside.read_count;
        self.read_ms += 1e3 * beside.read.as_secs_f64();
        let warp = 1e3 * beside.warp.as_secs_f64();
        let (warped, covered) = overlay_warped(rendered, &beside);
        let mut rgb8 = vec![rendered.rgb8.clone(), warped];
        debug_assert_eq!((RENDERED, WARPED, FIRST_MODEL), (0, 1, rgb8.len()));
        let mut repair_ms = vec![RepairMs::default(), RepairMs { warp, ..RepairMs::default() }];
        for model in models {
            let repaired = beside.repaired(model, &of);
            let (pixels, times) = repaired.map_err(|cause| ReportError::Repair {
                model: model.manifest().name.clone(),
                camera: mounted.name.clone(),
                cause: Box::new(cause),
            })?;
            let roles = [InputRole::ReferenceWarped, InputRole::ReferenceValid];
            // A model that does not read the warped images need not wait for them.
            let is_warped = roles.into_iter().any(|role| model.needs(role));
            repair_ms.push(RepairMs {
                warp: if is_warped { warp } else { 0.0 },
                model: 1e3 * (times.fit + times.run).as_secs_f64(),
                merge: 1e3 * times.merge.as_secs_f64(),
            });
            rgb8.push(pixels);
        }
        Ok(KindImages { rgb8, repair_ms, covered })
    }
}

/// Overlays the warped recorded images on a rendered image. Returns the image, and the share that
/// they cover.
fn overlay_warped(rendered: &RenderedImage, beside: &ViewReferences) -> (Vec<u8>, f64) {
    let mut rgb8 = rendered.rgb8.clone();
    let Some((warped, valid)) = beside.warped() else { return (rgb8, 0.0) };
    let pixels = rgb8.chunks_exact_mut(3).zip(warped.rgb8.chunks_exact(3)).zip(valid);
    let mut covered = 0;
    // Only where a reference fits: elsewhere the rendered pixel stays.
    for ((own, recorded), _) in pixels.filter(|(_, valid)| **valid > 0.0) {
        own.copy_from_slice(recorded);
        covered += 1;
    }
    (rgb8, f64::from(covered) / valid.len().max(1) as f64)
}

/// PSNR in dB, at most [`EXACT_DB`].
fn psnr_db(rgb8: &[u8], truth: &[u8]) -> f64 {
    psnr_db_u8(rgb8.iter().zip(truth)).min(EXACT_DB)
}

fn mean_flip(rgb8: &[u8], truth: &[u8], size_px: [u32; 2]) -> f64 {
    // FLIP takes sRGB from 0 to 1, which the bytes are.
    let [image, truth] = [rgb8, truth]
        .map(|rgb8| rgb8.iter().map(|byte| f32::from(*byte) / 255.0).collect::<Vec<_>>());
    let errors = flip(&image, &truth, size_px);
    errors.iter().map(|error| f64::from(*error)).sum::<f64>() / errors.len().max(1) as f64
}
