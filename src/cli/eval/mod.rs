//! `wildcity eval`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use wildcity_eval::{EvaluatedImage, Evaluation, Means, Pair, PairScores, Subject, Thumbnails};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::camera::FieldMask;

use super::backend_options::BackendOptions;
use super::directories::Twins;
use super::profile_options::{LoadedProfile, ProfileOptions};
use super::real_images::{ImageList, RealImage, picture};
use super::scene_source::Source;
use super::{output, placement, progress};

/// Compare a twin or a scene file with real images that it was not trained on.
///
/// Renders each image with its camera (pose, intrinsics, distortion) and measures PSNR, SSIM and FLIP. Writes
/// report.html (a single self-contained file, the worst images first), eval.json and eval.csv. Means are those of
/// the images' values. The help of --images and --every says what to give for held-out images; an image that was
/// trained on gives numbers that are too good.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Eval {
    /// The name of a twin: NAME, or NAME@NUMBER for an older version; or a scene file in any format that
    /// `wildcity import` reads.
    #[arg(value_name = "SCENE")]
    scene: String,

    /// The images with their cameras: a transforms.json of nerfstudio, a COLMAP model (its folder, or one that has
    /// it in sparse/0; text or binary), or a camera list as of `wildcity render --cameras`, one camera a line, with
    /// "image" (and perhaps "mask"). Poses of a list are in the axes of the scene. Those of the others are in the
    /// axes in which a scene file is; a twin has the change of axes of its import and its alignment.
    #[arg(long, value_name = "FILE_OR_DIR")]
    images: PathBuf,

    /// Folder that the names of images are in [default: that of transforms.json or of the list; for COLMAP,
    /// `images` beside the model]. Images may be smaller than their cameras, as in images_4: then the cameras are
    /// scaled.
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks: for image NAME.png, NAME.png or NAME.png.png. Black pixels do not count, as those of
    /// vehicles and pedestrians that the twin does not have. Without it, the masks that transforms.json or the list
    /// names.
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// Compare every Nth image in the order of their names, beginning with the first. 8 is what INRIA's and gsplat's
    /// trainers hold out.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,

    /// Directions of the poses' axes, as of `wildcity import` [default: as the twin was imported and aligned;
    /// identity for a file and for a list]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Metres per unit of the poses, as of `wildcity import`; with --axes [default: 1]
    #[arg(long, value_name = "M", requires = "axes")]
    scale: Option<f64>,

    /// Also compare after the gain and offset of each colour channel that fit best, image by image: for captures with
    /// automatic exposure.
    #[arg(long)]
    align_exposure: bool,

    /// Images that the page shows, the worst first.
    #[arg(long, value_name = "N", default_value_t = 24)]
    show: usize,

    /// Also write the rendered images and the error maps in full size, as PNG, to rendered/ and errors/.
    #[arg(long)]
    save_images: bool,

    /// Directory for the report; created if it is missing.
    #[arg(long, value_name = "DIR", default_value = "wildcity-eval")]
    out: PathBuf,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    profile: ProfileOptions,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity eval street --images held-out/transforms.json
  wildcity eval street --images capture --every 8 --image-dir capture/images_4 --align-exposure
  wildcity eval point_cloud.ply --images capture/sparse/0 --every 8 --masks capture/masks --out eval
  wildcity eval street --images views.jsonl --save-images";

/// What renders the images.
struct Renderer {
    source: Source,
    /// That of the scene.
    own_profile: RenderProfile,
    /// The changes of the command line.
    changes: LoadedProfile,
    backend: Box<dyn Backend>,
    alignment: Alignment,
}

/// A rendered image.
struct Rendered {
    rgb8: Vec<u8>,
    /// Share of the pixels with an opacity of at least 1/2.
    covered: f64,
}

impl Eval {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let list = ImageList::read(&self.images, self.image_dir.as_deref(), self.masks.as_deref())?;
        let images: Vec<&RealImage> = list.every(self.every as usize);
        let changes = self.profile.load()?;
        let (source, own_profile) = Source::open(&self.scene, &self.twins)?;
        let alignment = self.alignment(&source, &list)?;
        let backend = self.backend.backend()?;
        let renderer = Renderer { source, own_profile, changes, backend, alignment };
        let profile = renderer.profile(None)?;
        output::create_dir(&self.out)?;
        let bar = progress::count("comparing");
        bar.set_length(images.len() as u64);
        let mut evaluated: Vec<EvaluatedImage> = Vec::with_capacity(images.len());
        for image in images {
            let about = || format!("image {}", image.name);
            evaluated.push(self.evaluate(&renderer, image).with_context(about)?);
            self.forget_better_pictures(&mut evaluated);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let evaluation = Evaluation::new(self.subject(&renderer, profile), evaluated);
        self.write(&evaluation)
    }

    /// From the axes of the poses to those of the scene.
    fn alignment(&self, source: &Source, list: &ImageList) -> anyhow::Result<Alignment> {
        match (&self.axes, source) {
            (Some(axes), _) => placement::imported(axes, self.scale.unwrap_or(1.0)),
            (None, Source::Twin(resident)) if !list.is_in_scene_axes => {
                placement::of_version(&self.twins.catalog()?, &resident.version)
            }
            (None, _) => Ok(Alignment::IDENTITY),
        }
    }

    /// Renders one image and compares it with the real one.
    fn evaluate(&self, renderer: &Renderer, image: &RealImage) -> anyhow::Result<EvaluatedImage> {
        let profile = renderer.profile(image.near)?;
        let (truth, camera) = picture::real(&image.file, &image.camera, profile.background)?;
        let size_px = [camera.width_px, camera.height_px];
        let mask = image.mask.as_deref().map(|file| picture::mask(file, size_px)).transpose()?;
        let view = View::new(camera, renderer.alignment.pose(&image.world_from_camera));
        let Rendered { rgb8, covered } = renderer.render(&view, &profile)?;
        let pair = Pair::new(size_px, truth, rgb8, counted(&view, mask))?;
        let compared = PairScores::of(&pair, self.align_exposure);
        if self.save_images {
            self.save(&image.name, &pair, &compared.error_map)?;
        }
        let mut evaluated = EvaluatedImage::new(image.name.clone(), size_px, covered, &compared);
        let thumbnails = Thumbnails::of(&pair, &compared.error_map);
        evaluated.thumbnails = Some(thumbnails.map_err(anyhow::Error::msg)?);
        Ok(evaluated)
    }

    /// Keeps the pictures of the worst images only, so that memory does not grow with the number of images.
    fn forget_better_pictures(&self, evaluated: &mut [EvaluatedImage]) {
        let shown = evaluated.iter().filter(|image| image.thumbnails.is_some()).count();
        if shown <= self.show {
            return;
        }
        let shown = evaluated.iter_mut().filter(|image| image.thumbnails.is_some());
        let best = shown.max_by(|a, b| a.compare(b));
        if let Some(best) = best {
            best.thumbnails = None;
        }
    }

    fn save(&self, name: &str, pair: &Pair, error_map: &[f32]) -> anyhow::Result<()> {
        let [width, height] = pair.size_px();
        let rendered = wildcity_session::png(pair.rendered(), width, height);
        let errors = wildcity_eval::error_png(pair, error_map);
        for (folder, file) in [("rendered", rendered), ("errors", errors)] {
            let path = self.out.join(folder).join(picture::inside(name)).with_extension("png");
            output::create_dir(path.parent().unwrap_or(&self.out))?;
            output::write(&path, &file.map_err(anyhow::Error::msg)?)?;
        }
        Ok(())
    }

    fn subject(&self, renderer: &Renderer, profile: RenderProfile) -> Subject {
        let version = renderer.source.version();
        Subject {
            scene: version.map_or(self.scene.clone(), |version| version.manifest.twin.clone()),
            version: version.map(|version| version.number),
            version_hash: version.map(|version| version.hash.clone()),
            images: self.images.display().to_string(),
            alignment: renderer.alignment.to_string(),
            every: self.every as usize,
            backend: renderer.backend.name(),
            profile,
        }
    }

    /// Writes the files, and a summary on standard output.
    fn write(&self, evaluation: &Evaluation) -> anyhow::Result<()> {
        let files = [
            ("report.html", wildcity_eval::page(evaluation)),
            ("eval.json", format!("{:#}\n", serde_json::to_value(evaluation)?)),
            ("eval.csv", evaluation.csv()),
        ];
        for (name, text) in &files {
            output::write(&self.out.join(name), text.as_bytes())?;
        }
        let mut out = io::stdout().lock();
        print_means(&mut out, &evaluation.all)?;
        if let Some(worst) = evaluation.worst_first().first() {
            writeln!(out, "worst: {}, {}", worst.name, decibels(worst.scores.psnr_db))?;
        }
        for (name, _) in &files {
            writeln!(out, "{}", self.out.join(name).display())?;
        }
        Ok(())
    }
}

impl Renderer {
    /// How an image is rendered: `near` of the list overrides the scene's, and the command line both.
    fn profile(&self, near: Option<f64>) -> anyhow::Result<RenderProfile> {
        let near = near.unwrap_or(self.own_profile.near);
        self.changes.apply(RenderProfile { near, ..self.own_profile })
    }

    fn render(&self, view: &View, profile: &RenderProfile) -> anyhow::Result<Rendered> {
        let views = [*view];
        let scene = self.source.scene(&views, profile)?;
        let pixels = view.camera.pixels();
        let mut rgb8 = vec![0; 3 * pixels];
        let mut opacity = vec![0.0; pixels];
        let target =
            Target { rgb8: Some(&mut rgb8), opacity: Some(&mut opacity), ..Target::default() };
        let frame = Frame { scene: &scene, profile, views: &views };
        self.backend.render(&frame, &mut [target], &|_, _| {})?;
        let covered = opacity.iter().filter(|opacity| **opacity >= 0.5).count();
        Ok(Rendered { rgb8, covered: covered as f64 / pixels as f64 })
    }
}

/// The pixels that count: not masked, and within the lens' field.
fn counted(view: &View, mask: Option<Vec<bool>>) -> Option<Vec<bool>> {
    let Some(field) = FieldMask::of(&view.camera) else { return mask };
    let mut counts = mask.unwrap_or_else(|| vec![true; view.camera.pixels()]);
    field.clear_outside(&view.camera, 1, &mut counts);
    Some(counts)
}

fn print_means(out: &mut impl Write, means: &Means) -> io::Result<()> {
    let Means { images, psnr_db, ssim, ssim_mirrored, flip, .. } = means;
    let psnr = decibels(*psnr_db);
    writeln!(
        out,
        "mean of {images} images: PSNR {psnr}, SSIM {ssim:.4} (mirrored edges: {ssim_mirrored:.4}), FLIP {flip:.4}"
    )?;
    if let Some(aligned) = &means.aligned {
        let psnr = decibels(aligned.psnr_db);
        writeln!(out, "with aligned exposure: PSNR {psnr}, SSIM {:.4}", aligned.ssim)?;
    }
    Ok(())
}

fn decibels(db: f64) -> String {
    if db == f64::INFINITY { "exact".to_owned() } else { format!("{db:.2} dB") }
}
