//! `wildcity augment`.

mod options;
mod view_sessions;

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use indicatif::ProgressBar;
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;

use wildcity_augment::{
    AugmentError, CameraModel, ColmapForm, ColmapModel, Folder, Header, MadeWith, Options, Place,
    Plan, Point, PointSample, Sample, SampleFiles, Surroundings, TrainingCamera, counted, depth_mm,
    limits, mask_png, millimetres_png, rgb_png, transforms, weight,
};
use wildcity_repair::Models;
use wildcity_scene::geometry::Bounds;
use wildcity_server::{Config, Directories};
use wildcity_twin::store::{Catalog, Version};

use self::options::{ModelOptions, metres};
use self::view_sessions::{Drawn, ViewSessions};
use super::backend_options::BackendOptions;
use super::directories::{TwinVersion, Twins};
use super::{output, placement, progress};

/// Render views of a twin off its recorded drives, repair them, and write them as training data.
///
/// A twin is accurate on its drives and less accurate off them. This command renders the twin off
/// its drives, repairs the images with a model, and writes them with masks, depth and poses, so
/// that a trainer can learn from them as from recorded images, but with less weight. A twin that is
/// trained on these images is accurate at larger distances from the drives.
///
/// A model can correct small errors; where the image is far off, it hallucinates. So the views move
/// away from the drives in rounds: round N renders at min(0.5 m x N, OFFSET) for each OFFSET of
/// --offsets, to the left and to the right of the drive, every --every metres, with the heading of
/// the drive and all cameras. Train on a round, push the twin, and render the next round from it.
/// Each round has its own folder, DIR/round_N.
///
/// Images have no overlay, exposure or rolling shutter. Poses are in the twin's axes. To continue
/// an interrupted run, run the same command again. docs/augmentation.md explains how to train with
/// it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Augment {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// Lateral offsets that the rounds lead to, in metres, separated by commas, each to both sides
    /// of the drives.
    #[arg(long, value_name = "M,..", default_value = "1,3,5", value_delimiter = ',', value_parser = metres)]
    offsets: Vec<f64>,

    /// Distance between two views along a drive, in metres: 2 or 2m.
    #[arg(long, value_name = "M", default_value = "2", value_parser = metres)]
    every: f64,

    /// The round N: views are at most 0.5 m x N off the drives.
    #[arg(long, value_name = "N", default_value_t = 1)]
    round: u32,

    /// Cameras of the rig, separated by commas [default: all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    cameras: Vec<String>,

    /// Longest side of an image, in pixels; larger images of the rig are rendered at a reduced size
    /// [default: the rig's]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    side: Option<u32>,

    /// Keep the lenses of the rig. Without this option, each lens is replaced by a pinhole with its
    /// field of view, up to 100°. transforms.json and COLMAP can describe pinholes, OpenCV lenses
    /// with k1, k2, p1 and p2, and OpenCV fisheyes; other lenses and windshields are refused.
    #[arg(long)]
    lenses: bool,

    /// Largest number of points of the COLMAP model: opaque Gaussians within 100 m of a view,
    /// chosen at random.
    #[arg(long, value_name = "N", default_value_t = limits::POINTS, value_parser = clap::value_parser!(u32).range(0..=MOST_POINTS))]
    points: u32,

    /// Seed of the choice of the points.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,

    /// Format of the COLMAP model.
    #[arg(long, value_name = "FORM", value_enum, default_value_t)]
    colmap: ColmapName,

    /// Directory of the rounds; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    #[command(flatten)]
    model: ModelOptions,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
In DIR/round_N:
  images/          images to train on: repaired, or as rendered without --repair
  rendered/        the same images before the repair
  masks/           255 where the opacity is at least 1/2 and within the lens' field
  depth/           16-bit PNG in millimetres up to 65 m, 0 for none
  transforms.json  cameras, poses and weights, for nerfstudio and `wildcity eval`
  sparse/0         the same as a COLMAP model, with Gaussians as points
  augment.json     the settings of the run, and the hash of each file

Examples:
  wildcity augment street --repair model.json --offsets 1,3,5 --every 2m --round 1 --out augmented
  wildcity augment street --offsets 3 --round 6 --side 720 --cameras front,front_left,front_right --out plain
  wildcity eval street --axes identity --images augmented/round_1/transforms.json";

/// [`limits::MOST_POINTS`], as clap takes it.
const MOST_POINTS: i64 = limits::MOST_POINTS as i64;

/// [`ColmapForm`] on the command line.
#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum ColmapName {
    /// Text: cameras.txt, images.txt, points3D.txt.
    #[default]
    Txt,
    /// Binary: cameras.bin, images.bin, points3D.bin.
    Bin,
}

impl From<ColmapName> for ColmapForm {
    fn from(name: ColmapName) -> Self {
        match name {
            ColmapName::Txt => Self::Text,
            ColmapName::Bin => Self::Binary,
        }
    }
}

/// The views to render.
struct Job {
    version: Version,
    plan: Plan,
    places: Vec<Place>,
    cameras: Vec<TrainingCamera>,
    lens_model: CameraModel,
}

impl Augment {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let job = self.job(&catalog)?;
        let models = Arc::new(self.model.models()?);
        let dir = self.out.join(format!("round_{}", job.plan.round()));
        output::create_dir(&self.out)?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        // The records of the two sessions, which are not needed afterwards.
        let scratch = tempfile::tempdir().context("cannot create a temporary directory")?;
        runtime.block_on(async {
            let running = wildcity_server::start(self.server(scratch.path(), &models)?).await?;
            let drawn = self.draw(&running.url(), &catalog, &job, &models, &dir).await;
            running.stop().await;
            drawn
        })
    }

    fn job(&self, catalog: &Catalog) -> anyhow::Result<Job> {
        let plan = Plan::new(self.round, &self.offsets, self.every)?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        let cameras = options::cameras(&version, &self.cameras, self.side, self.lenses)?;
        let lens_model = CameraModel::from_cameras(&cameras)?;
        let places = plan.places(&version.manifest.trajectories)?;
        let samples = places.len() * cameras.len();
        let limit = limits::MOST_SAMPLES;
        if samples > limit {
            return Err(AugmentError::Samples { samples, limit }.into());
        }
        Ok(Job { version, plan, places, cameras, lens_model })
    }

    fn server(&self, scratch: &Path, models: &Arc<Models>) -> anyhow::Result<Config> {
        let directories = Directories {
            twins: self.twins.dir()?,
            episodes: scratch.join("episodes"),
            scenarios: scratch.join("scenarios"),
            uploads: scratch.join("uploads"),
        };
        let mut config = Config {
            cache: self.twins.cache(),
            repairs: Arc::clone(models),
            ..Config::local(directories, Arc::from(self.backend.backend()?))
        };
        config.limits.step = view_sessions::PLACE_TIMEOUT;
        Ok(config)
    }

    /// Renders the missing samples, and writes the lists.
    async fn draw(
        &self,
        url: &str,
        catalog: &Catalog,
        job: &Job,
        models: &Models,
        dir: &Path,
    ) -> anyhow::Result<()> {
        let model = models.names().next().map(|name| (name, self.model.at_least));
        let mut sessions = ViewSessions::open(url, &job.version, &job.cameras, model).await?;
        let header = self.header(catalog, job, &sessions);
        let bar = progress::count("checking");
        let folder = Folder::open(dir, header, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let kept = folder.count();
        if folder.damaged() > 0 {
            let damaged = folder.damaged();
            writeln!(
                io::stderr(),
                "{damaged} samples are missing or damaged, and are drawn again"
            )?;
        }
        let missing: Vec<&Place> =
            job.places.iter().filter(|place| !is_done(&folder, place, job)).collect();
        let bar = progress::count("drawing");
        bar.set_length((job.places.len() * job.cameras.len()) as u64);
        bar.set_position(kept as u64);
        bar.reset_eta();
        // One place is written while the next one is rendered.
        let (sender, receiver) = mpsc::channel(1);
        let cameras = job.cameras.clone();
        let writer_bar = bar.clone();
        let writer = spawn_blocking(move || write_samples(folder, &cameras, receiver, &writer_bar));
        for place in missing {
            let drawn = sessions.draw(place).await?;
            // The writer ends early only if it failed; then it returns the reason.
            if sender.send((place.clone(), drawn)).await.is_err() {
                break;
            }
        }
        drop(sender);
        let folder = writer.await??;
        bar.finish_and_clear();
        sessions.close().await?;
        self.finish(catalog, job, folder, kept, dir)
    }

    fn header(&self, catalog: &Catalog, job: &Job, sessions: &ViewSessions) -> Header {
        let options = Options {
            round: job.plan.round(),
            wanted_offsets_m: job.plan.wanted_m().to_vec(),
            every_m: job.plan.every_m(),
            cameras: job.cameras.iter().map(|camera| camera.name.clone()).collect(),
            side_px: self.side,
            lenses: self.lenses,
            points: self.points,
            seed: self.seed,
            colmap: ColmapForm::from(self.colmap).extension().to_owned(),
        };
        let made_with = MadeWith {
            twin: job.version.manifest.twin.clone(),
            version_hash: job.version.hash.clone(),
            backend: sessions.backend().to_owned(),
            repair: sessions.repaired_with(),
            options,
        };
        Header {
            made_with,
            version: job.version.number,
            offsets_m: job.plan.offsets_m(),
            // Some versions do not record this, such as pushed ones.
            world_from_capture: placement::from_version(catalog, &job.version)
                .ok()
                .map(|alignment| alignment.to_string()),
        }
    }

    /// Writes transforms.json, the COLMAP model and augment.json, and prints a summary.
    fn finish(
        &self,
        catalog: &Catalog,
        job: &Job,
        folder: Folder,
        kept: usize,
        dir: &Path,
    ) -> anyhow::Result<()> {
        let names = job
            .places
            .iter()
            .flat_map(|place| job.cameras.iter().map(|camera| place.image_name(&camera.name)));
        let samples = folder.samples(&names.collect::<Vec<_>>());
        let transforms = transforms(job.lens_model, &job.cameras, &samples);
        folder.write("transforms.json", format!("{transforms:#}\n").as_bytes())?;
        let colmap = ColmapModel {
            model: job.lens_model,
            cameras: &job.cameras,
            samples: &samples,
            points: &self.sampled_points(catalog, job)?,
        };
        for (name, bytes) in colmap.files(self.colmap.into()) {
            folder.write(&format!("sparse/0/{name}"), &bytes)?;
        }
        folder.finish(&samples)?;
        print(dir, job, &samples, kept)
    }

    fn sampled_points(&self, catalog: &Catalog, job: &Job) -> anyhow::Result<Vec<Point>> {
        let near = Surroundings::from_places(&job.places);
        let mut sample = PointSample::new(self.seed, self.points as usize, near.clone());
        if self.points > 0 {
            let is_near = |bounds: &Bounds| near.meet(bounds);
            catalog.visit_full_detail(&job.version, &is_near, &mut |section| {
                sample.add(&section);
            })?;
        }
        Ok(sample.into_points())
    }
}

fn is_done(folder: &Folder, place: &Place, job: &Job) -> bool {
    job.cameras.iter().all(|camera| folder.has(&place.image_name(&camera.name)))
}

/// Writes the samples of each received place to the folder, until the channel is closed.
fn write_samples(
    mut folder: Folder,
    cameras: &[TrainingCamera],
    mut receiver: mpsc::Receiver<(Place, Vec<Drawn>)>,
    bar: &ProgressBar,
) -> anyhow::Result<Folder> {
    while let Some((place, drawn)) = receiver.blocking_recv() {
        for (camera, drawn) in cameras.iter().zip(drawn) {
            let name = place.image_name(&camera.name);
            if !folder.has(&name) {
                let (sample, files) = sample(name, &place, camera, drawn)?;
                folder.put(sample, &files)?;
                bar.inc(1);
            }
        }
    }
    Ok(folder)
}

/// Makes a sample and its files of a rendered image.
fn sample(
    name: String,
    place: &Place,
    training: &TrainingCamera,
    drawn: Drawn,
) -> anyhow::Result<(Sample, SampleFiles)> {
    let camera = &training.camera;
    let size_px = [camera.width_px, camera.height_px];
    let counts = counted(camera, &drawn.opacity)?;
    let depth_mm = depth_mm(&drawn.depth_m, &counts)?;
    let rendered = rgb_png(&drawn.rendered, size_px)?;
    let (image, rendered) = match &drawn.repaired {
        Some(repaired) => (rgb_png(repaired, size_px)?, Some(rendered)),
        None => (rendered, None),
    };
    let mask = mask_png(&counts, size_px)?;
    let depth = millimetres_png(&depth_mm, size_px)?;
    let counted = counts.iter().filter(|counts| **counts).count() as f64 / counts.len() as f64;
    let sample = Sample {
        name,
        trajectory: place.trajectory.clone(),
        station_m: place.station_m,
        offset_m: place.offset_m,
        camera: training.name.clone(),
        world_from_camera: place.world_from_rig * training.rig_from_camera,
        trust: drawn.trust,
        weight: weight(drawn.trust),
        counted,
        repair: drawn.repair,
        files: BTreeMap::new(),
    };
    Ok((sample, SampleFiles { image, rendered, mask, depth }))
}

fn print(dir: &Path, job: &Job, samples: &[Sample], kept: usize) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    let offsets_m: Vec<String> = job.plan.offsets_m().iter().map(f64::to_string).collect();
    let mean_trust = samples.iter().map(|sample| sample.trust).sum::<f64>() / samples.len() as f64;
    let is_repaired =
        |sample: &&Sample| sample.repair.as_ref().is_some_and(|repair| repair.status == "repaired");
    let repaired = samples.iter().filter(is_repaired).count();
    writeln!(
        out,
        "round {}: {} images of {} cameras at {} m beside the drives; {repaired} repaired, {kept} from an earlier run; \
         mean trust {mean_trust:.2}",
        job.plan.round(),
        samples.len(),
        job.cameras.len(),
        offsets_m.join(", ")
    )?;
    for name in ["transforms.json", "sparse/0", "augment.json"] {
        writeln!(out, "{}", dir.join(name).display())?;
    }
    Ok(())
}
