//! `wildcity train SOURCE`.

use std::fs;
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use image::imageops::{self, FilterType};
use image::{ImageBuffer, Rgb};

use glam::DVec3;
use wildcity_eval::images::{ImageList, RealImage, picture};
use wildcity_render::View;
use wildcity_render::gradient::Differentiate;
use wildcity_scene::RenderProfile;
use wildcity_scene::random::Random;
use wildcity_train::run::{Line, TrainingImage, TrainingImages, run};
use wildcity_train::settings::Settings;
use wildcity_train::start::{Point, gaussians_from_points};
use wildcity_twin::ingest::{capture, write_ply};

use crate::cli::backend_options::HardwareOptions;
use crate::cli::{exit, output, progress};

/// What `wildcity train SOURCE` takes.
#[derive(Debug, clap::Args)]
pub(super) struct TrainScene {
    /// The images and their cameras: a COLMAP model (its folder, or one with sparse/0), a
    /// transforms.json, or its folder.
    #[arg(value_name = "SOURCE", required = true)]
    source: Option<PathBuf>,

    /// PLY file to write, which `wildcity import` and other viewers and trainers read.
    #[arg(long, value_name = "FILE", required = true)]
    out: Option<PathBuf>,

    /// Folder of the images [default: images beside a COLMAP model; the folder of a
    /// transforms.json]
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks, named as the images: pixels darker than half do not count.
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// Points to begin with: a PLY file, or a COLMAP model [default: those of SOURCE]
    #[arg(long, value_name = "POINTS")]
    points: Option<PathBuf>,

    /// Steps, each on one image. Learning rates and growth are scaled to this number.
    /// [default: that of --settings, or 7000]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: Option<u32>,

    /// Most Gaussians at any time; of more points some are chosen [default: that of --settings, or
    /// 1000000]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    cap: Option<u32>,

    /// Train on images of this fraction of their width, from 0.05 to 1: a quarter of the pixels at
    /// 0.5 take a quarter of the time.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    size: f64,

    /// Keep every so-manieth image, in the order of their names, from training, to judge the
    /// result; 0 keeps none.
    #[arg(long, value_name = "N", default_value_t = 8)]
    held_out_every: usize,

    /// Of the order of images and of all random numbers: the same seed and images give the same
    /// file [default: that of --settings, or 0]
    #[arg(long)]
    seed: Option<u64>,

    /// TOML file of all settings; --steps, --cap and --seed change it. `wildcity train settings`
    /// prints the defaults.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    /// Write a line of JSON for each step.
    #[arg(long, value_name = "FILE")]
    lines: Option<PathBuf>,

    #[command(flatten)]
    hardware: HardwareOptions,
}

fn fraction(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(fraction) if (0.05..=1.0).contains(&fraction) => Ok(fraction),
        _ => Err("expected a fraction from 0.05 to 1, for example 0.5".to_owned()),
    }
}

/// Images of a list, at a fraction of their size.
struct Listed<'a> {
    images: Vec<&'a RealImage>,
    size: f64,
    held_out_every: usize,
}

impl TrainScene {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // clap requires both.
        let source = self.source.as_deref();
        let source = source.context("give SOURCE: a COLMAP model or a transforms.json")?;
        let out = self.out.as_deref().context("give --out FILE.ply")?;
        check_out(out)?;
        let settings = self.settings()?;
        let list = ImageList::read(source, self.image_dir.as_deref(), self.masks.as_deref())?;
        for warning in &list.warnings {
            writeln!(io::stderr(), "warning: {warning}")?;
        }
        let mut points = self.points(source)?;
        if points.len() > settings.growth.cap {
            let all = points.len();
            let mut random = Random::new(settings.seed, "points", 0);
            for k in (1..all).rev() {
                points.swap(k, random.below(k + 1));
            }
            points.truncate(settings.growth.cap);
            writeln!(io::stderr(), "{} of {all} points are chosen: --cap", points.len())?;
        }
        let images =
            Listed { images: list.every(1), size: self.size, held_out_every: self.held_out_every };
        // Every image is looked at before a long run finds one that is missing.
        for index in 0..images.count() {
            let file = &images.images[index].file;
            ensure!(file.is_file(), "there is no image {}: give --image-dir", file.display());
        }
        let backends = self.hardware.differentiating()?;
        let backend: &dyn Differentiate = match backends.last() {
            Some(backend) => backend.as_ref(),
            None => anyhow::bail!("no backend computes gradients"),
        };
        let held_out = (0..images.count()).filter(|&index| images.is_held_out(index)).count();
        writeln!(
            io::stderr(),
            "{}, {held_out} of them held out, {}, backend {}",
            output::counted(images.count(), "image"),
            output::counted(points.len(), "point"),
            backend.name()
        )?;
        let every = (settings.steps / 10).max(1);
        let mut lines = self.lines.as_deref().map(LinesFile::create).transpose()?;
        let bar = progress::count("training");
        bar.set_length(settings.steps as u64);
        let mut last = None;
        let mut failed = None;
        let mut on_step = |line: &Line| {
            bar.set_position(line.step as u64);
            if let Some(db) = line.held_out_db {
                bar.set_message(format!("{db:.2} dB"));
                last = Some(line.clone());
            }
            // A log has no bar.
            if line.step.is_multiple_of(every) && !io::stderr().is_terminal() {
                let Line { step, l1, gaussians, seconds, .. } = line;
                let db = line.held_out_db.map_or(String::new(), |db| format!(", {db:.2} dB"));
                let said = writeln!(
                    io::stderr(),
                    "step {step}: l1 {l1:.4}, {gaussians} Gaussians, {seconds:.0} s{db}"
                );
                failed = said.err().map(anyhow::Error::from);
            }
            let written = lines.as_mut().map_or(Ok(()), |lines| lines.write(line));
            failed = failed.take().or(written.err());
            failed.is_none()
        };
        let start = gaussians_from_points(&points);
        let profile = RenderProfile::default();
        let trained = run(start, &images, backend, profile, &settings, every, &mut on_step)?;
        bar.finish_and_clear();
        if let Some(error) = failed {
            return Err(error);
        }

        let mut bytes = Vec::new();
        write_ply(&trained, &mut bytes)?;
        output::write(out, &bytes)?;
        let mut stdout = io::stdout().lock();
        let held_out = last.and_then(|line| Some((line.held_out_db?, line.seconds)));
        if let Some((db, seconds)) = held_out {
            writeln!(
                stdout,
                "held out: {db:.2} dB after {} steps, {seconds:.0} s",
                settings.steps
            )?;
        }
        writeln!(
            stdout,
            "{}: {} Gaussians, in the axes and the unit of {}; make a twin of it:\n\
             wildcity import {:?} --twin NAME --axes AXES\n\
             AXES is identity if z is up, and y-down-z-forward for most models of COLMAP",
            out.display(),
            trained.len(),
            source.display(),
            out,
        )?;
        Ok(())
    }

    fn settings(&self) -> anyhow::Result<Settings> {
        let mut settings = match &self.settings {
            None => Settings::default(),
            Some(path) => {
                let cannot = || format!("--settings {}", path.display());
                let text = fs::read_to_string(path).with_context(cannot)?;
                toml::from_str(&text).with_context(cannot)?
            }
        };
        settings.steps = self.steps.map_or(settings.steps, |steps| steps as usize);
        settings.growth.cap = self.cap.map_or(settings.growth.cap, |cap| cap as usize);
        settings.seed = self.seed.unwrap_or(settings.seed);
        settings.check()?;
        Ok(settings)
    }

    fn points(&self, source: &Path) -> anyhow::Result<Vec<Point>> {
        let source = match &self.points {
            Some(points) => points.clone(),
            None => listed_points(source)?,
        };
        ensure!(source.exists(), "there are no points at {}", source.display());
        let read = capture::read_points(&source)?;
        let read = read.filter(|points| !points.is_empty()).with_context(|| {
            format!(
                "{} has no points to begin with: give --points, a PLY file or a COLMAP model with \
                 points3D.bin or points3D.txt",
                source.display()
            )
        })?;
        let point = |point: capture::CapturePoint| Point {
            at_m: DVec3::from_array(point.at),
            rgb: point.rgb8.map(|value| f64::from(value) / 255.0),
        };
        Ok(read.into_iter().map(point).collect())
    }
}

/// Checks, before a long run, that its file can be written.
fn check_out(out: &Path) -> anyhow::Result<()> {
    let out_name = out.display();
    let is_ply = out.extension().is_some_and(|extension| extension == "ply");
    ensure!(is_ply, "--out {out_name}: the file is a PLY: give it a name that ends with .ply");
    let is_free = !out.exists() || out.is_file();
    ensure!(is_free, "--out {out_name} is a folder or a device: give the name of a file");
    // The folder of a bare name is the current one.
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty());
    let is_there = folder.is_none_or(Path::is_dir);
    ensure!(is_there, "--out {out_name}: there is no such folder: create it");
    Ok(())
}

/// Where the points of a list are: in the PLY file that a transforms.json names, or in its folder,
/// which may be or have a COLMAP model.
fn listed_points(source: &Path) -> anyhow::Result<PathBuf> {
    let mut folder = source;
    let mut list = source.join("transforms.json");
    if source.extension().is_some_and(|extension| extension == "json") {
        folder = source.parent().unwrap_or(source);
        list = source.to_owned();
    }
    if list.is_file() {
        let cannot = || format!("cannot read {}", list.display());
        let text = fs::read(&list).with_context(cannot)?;
        let json: serde_json::Value = serde_json::from_slice(&text).with_context(cannot)?;
        if let Some(name) = json.get("ply_file_path").and_then(serde_json::Value::as_str) {
            return Ok(folder.join(name));
        }
    }
    // The folder of a bare name is the current one.
    Ok(if folder.as_os_str().is_empty() { PathBuf::from(".") } else { folder.to_owned() })
}

impl TrainingImages for Listed<'_> {
    fn count(&self) -> usize {
        self.images.len()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.held_out_every > 0 && index.is_multiple_of(self.held_out_every)
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        self.decode(self.images[index]).map_err(|error| exit::chain(&error))
    }
}

impl Listed<'_> {
    fn decode(&self, image: &RealImage) -> anyhow::Result<TrainingImage> {
        let background = RenderProfile::default().background;
        let (mut rgb8, mut camera) = picture::real(&image.file, &image.camera, background)?;
        let own_px = [camera.width_px, camera.height_px];
        let file = image.mask.as_deref();
        let mut mask = file.map(|file| picture::mask(file, own_px)).transpose()?;
        let is_empty = mask.as_ref().is_some_and(|mask| !mask.contains(&true));
        ensure!(
            !is_empty,
            "the mask {} leaves no pixel: dark pixels do not count",
            file.unwrap_or(Path::new("")).display()
        );
        if self.size < 1.0 {
            let [width, height] =
                own_px.map(|px| ((f64::from(px) * self.size).round() as u32).max(1));
            camera = camera.scaled(width.into(), height.into())?;
            let whole: ImageBuffer<Rgb<u8>, Vec<u8>> =
                ImageBuffer::from_raw(own_px[0], own_px[1], rgb8).context("an image's size")?;
            rgb8 = imageops::resize(&whole, width, height, FilterType::Triangle).into_raw();
            // A pixel counts if the one at its middle does.
            mask = mask.map(|mask| {
                let at = |px: u32, size: u32, own: u32| {
                    ((f64::from(px) + 0.5) * f64::from(own) / f64::from(size)) as usize
                };
                let pixel = |y: u32, x: u32| {
                    let row = at(y, height, own_px[1]) * own_px[0] as usize;
                    mask[row + at(x, width, own_px[0])]
                };
                (0..height)
                    .flat_map(|y| (0..width).map(move |x| (y, x)))
                    .map(|(y, x)| pixel(y, x))
                    .collect()
            });
        }
        // Photographs of this size: what they are trained as.
        camera.native_size_px = None;
        let view = View::new(camera, image.world_from_camera);
        Ok(TrainingImage { view, rgb8, mask })
    }
}

/// The file of `--lines`.
struct LinesFile {
    path: PathBuf,
    file: fs::File,
}

impl LinesFile {
    fn create(path: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write {}", path.display());
        Ok(Self { path: path.to_owned(), file: fs::File::create(path).with_context(cannot)? })
    }

    fn write(&mut self, line: &Line) -> anyhow::Result<()> {
        let text = serde_json::to_string(line)?;
        let cannot = || format!("cannot write {}", self.path.display());
        writeln!(self.file, "{text}").with_context(cannot)
    }
}
