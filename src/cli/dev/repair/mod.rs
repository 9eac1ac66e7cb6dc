//! `wildcity dev repair`.

mod sample;
mod warp_time;

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, ensure};
use image::{ImageFormat, RgbImage};
use wildcity_repair::{Halo, Image, InputRole, LoadOptions, Model, Provider};

use self::sample::Sample;
use crate::cli::repair_options::runtime_library;
use crate::cli::{memory, output};

/// Load a repair model, probe it, and measure it.
///
/// Reads the manifest FILE and the files that it pins, compares it with the graph, and runs the
/// model on a pattern: shape, NaN, time limit, three equal runs. For a model in tiles it measures
/// the halo (how far an output pixel depends on the input) and checks that tiles give the same bits
/// as the whole image. Then it prints time and additional memory of one image per size. Inputs
/// other than the image get neutral values: the image itself as reference, 10 m of depth, full
/// opacity and validity.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Repair {
    /// Manifest of the model (JSON, "format": "wildcity.repair/1").
    #[arg(value_name = "FILE")]
    manifest: PathBuf,

    /// Image to repair, PNG or JPEG [default: a generated pattern]
    #[arg(long, value_name = "PNG", requires = "out")]
    image: Option<PathBuf>,

    /// Directory for before.png and after.png; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// ONNX Runtime library, version 1.18 or later [default: $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// One of the manifest's providers; the command does not fall back to another one [default: its
    /// first]
    #[arg(long, value_enum)]
    provider: Option<ProviderOption>,

    /// Threads of the cpu provider. The output does not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1)]
    threads: usize,

    /// Size to measure; may be repeated [default: 360x232, 720x464, 1440x928]
    #[arg(long = "size", value_name = "WxH")]
    sizes: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  wildcity dev repair zero-dce.json --onnxruntime libonnxruntime.so.1.32.0
  wildcity dev repair zero-dce.json --image street.png --out pictures
  wildcity dev repair difix.json --provider cuda --size 1024x576";

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum ProviderOption {
    Cpu,
    Cuda,
    Tensorrt,
}

/// The cameras of the Alpamayo rig, at a quarter, half and full size.
const SIZES: [[usize; 2]; 3] = [[360, 232], [720, 464], [1440, 928]];

impl Repair {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let sizes = self.sizes()?;
        let image = self.image.as_deref().map(read_image).transpose()?;
        if let Some(dir) = &self.out {
            output::create_dir(dir)?;
        }
        let model = Model::load(&self.manifest, &self.options())?;
        let mut out = output::stdout();
        self.print_model(&mut out, &model)?;
        writeln!(out, "\n{:<12} {:>10} {:>12}", "size", "time", "memory")?;
        let mut measured = 0;
        for [width, height] in sizes {
            let size = format!("{width}x{height}");
            let sample = Sample::new(pattern(width, height));
            let peak = Peak::start();
            let start = Instant::now();
            match model.repair_timed(&sample.view()) {
                Ok((_, times)) => {
                    measured += 1;
                    let seconds = start.elapsed().as_secs_f64();
                    writeln!(out, "{size:<12} {seconds:>8.3} s {:>12}", peak.text())?;
                    let [fit, run, merge] =
                        [times.fit, times.run, times.merge].map(|part| part.as_secs_f64());
                    let parts =
                        format!("its inputs; {run:.3} s its graph; {merge:.3} s its output");
                    writeln!(out, "{:<12} {fit:>8.3} s of that for {parts}", "")?;
                }
                Err(error) => writeln!(out, "{size:<12} {error}")?,
            }
            if model.needs(InputRole::ReferenceWarped) {
                let [pinhole, fisheye] = warp_time::seconds(width, height);
                let what = "to warp five references; with a non-pinhole lens";
                writeln!(out, "{:<12} {pinhole:>8.3} s {what} {fisheye:.3} s", "")?;
            }
        }
        ensure!(measured > 0, "the model repaired an image of none of these sizes");
        let Some(dir) = &self.out else { return Ok(()) };
        let sample = Sample::new(image.unwrap_or_else(|| pattern(SIZES[0][0], SIZES[0][1])));
        let repaired = model.repair(&sample.view())?;
        output::write(&dir.join("before.png"), &png(sample.rendered())?)?;
        output::write(&dir.join("after.png"), &png(&repaired.image)?)?;
        writeln!(out, "\nrendered     {}", repaired.rendered_hash)?;
        writeln!(out, "repaired     {}", repaired.hash)?;
        writeln!(out, "pictures     {}", dir.display())?;
        Ok(())
    }

    fn options(&self) -> LoadOptions {
        let library = runtime_library(self.onnxruntime.as_ref());
        let provider = self.provider.map(|provider| match provider {
            ProviderOption::Cpu => Provider::Cpu,
            ProviderOption::Cuda => Provider::Cuda,
            ProviderOption::Tensorrt => Provider::Tensorrt,
        });
        LoadOptions { provider, threads: self.threads, ..LoadOptions::new(library) }
    }

    fn sizes(&self) -> anyhow::Result<Vec<[usize; 2]>> {
        if self.sizes.is_empty() {
            return Ok(SIZES.to_vec());
        }
        let size = |text: &String| {
            let sides = text.split_once('x').and_then(|(width, height)| {
                Some([width.parse::<usize>().ok()?, height.parse::<usize>().ok()?])
            });
            let largest = wildcity_repair::limits::MAX_SIDE_PX;
            let is_size =
                |sides: &[usize; 2]| sides.iter().all(|side| (1..=largest).contains(side));
            sides
                .filter(is_size)
                .with_context(|| format!("--size {text:?}: give WIDTHxHEIGHT, each 1 to {largest}"))
        };
        self.sizes.iter().map(size).collect()
    }

    fn print_model(&self, out: &mut impl Write, model: &Model) -> io::Result<()> {
        let manifest = model.manifest();
        let repeated = if model.is_deterministic() {
            "three runs gave the same bytes"
        } else {
            "three runs gave different bytes"
        };
        let halo = match model.halo() {
            Some(Halo::Pixels(halo)) if manifest.size.fixed.is_some() => {
                format!("{halo} px; the model takes no larger image that tiles could equal")
            }
            Some(Halo::Pixels(halo)) => format!("{halo} px; tiles equal the whole"),
            Some(Halo::Whole) => "the whole image".to_owned(),
            None => "not measured: size.fit is not \"tile\"".to_owned(),
        };
        writeln!(
            out,
            "model        {} {} ({})",
            manifest.name, manifest.version, manifest.licence
        )?;
        writeln!(out, "runtime      {}", model.runtime())?;
        writeln!(out, "provider     {}, {} thread(s)", model.provider().name(), self.threads)?;
        writeln!(out, "repair hash  {}", model.repair_hash())?;
        writeln!(out, "repeated     {repeated}")?;
        writeln!(out, "halo         {halo}")
    }
}

/// The peak memory of this process since a point in time.
struct Peak {
    before_kib: Option<u64>,
}

impl Peak {
    fn start() -> Peak {
        // 5 resets the peak (proc(5)); where that is refused, no memory is reported.
        let is_reset = fs::write("/proc/self/clear_refs", "5").is_ok();
        Peak { before_kib: memory::status_kib("VmRSS:").filter(|_| is_reset) }
    }

    fn text(&self) -> String {
        match (self.before_kib, memory::status_kib("VmHWM:")) {
            (Some(before), Some(peak)) => {
                format!("{} MiB", peak.saturating_sub(before).div_ceil(1024))
            }
            _ => "unknown".to_owned(),
        }
    }
}

fn read_image(path: &Path) -> anyhow::Result<Image> {
    let cannot = || format!("--image {}", path.display());
    let mut reader = image::ImageReader::open(path)
        .with_context(cannot)?
        .with_guessed_format()
        .with_context(cannot)?;
    ensure!(reader.format().is_some(), "--image {}: neither PNG nor JPEG", path.display());
    let largest = wildcity_repair::limits::MAX_SIDE_PX as u32;
    let mut limits = image::Limits::default();
    // Before decoding, so that a small file cannot ask for gigabytes.
    limits.max_image_width = Some(largest);
    limits.max_image_height = Some(largest);
    reader.limits(limits);
    let image = reader.decode().with_context(cannot)?.to_rgb8();
    let width = image.width() as usize;
    let height = image.height() as usize;
    Ok(Image { width, height, rgb8: image.into_raw() })
}

fn png(image: &Image) -> anyhow::Result<Vec<u8>> {
    let pixels = RgbImage::from_raw(image.width as u32, image.height as u32, image.rgb8.clone());
    let mut bytes = io::Cursor::new(Vec::new());
    pixels.context("an image has 3 bytes per pixel")?.write_to(&mut bytes, ImageFormat::Png)?;
    Ok(bytes.into_inner())
}

/// A gradient with a chequerboard: smooth parts and edges.
fn pattern(width: usize, height: usize) -> Image {
    let mut rgb8 = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        for x in 0..width {
            // At most 159 + 48: the sum of both fits a byte.
            let edge = if (x / 24 + y / 24) % 2 == 0 { 48 } else { 0 };
            let across = (x * 160 / width) as u8;
            let down = (y * 160 / height) as u8;
            rgb8.extend([across + edge, down + edge, 60 + edge]);
        }
    }
    Image { width, height, rgb8 }
}
