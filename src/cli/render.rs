//! `wildcity render`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;

use wildcity_render::{Frame, Target};

use super::backend_options::RendererOptions;
use super::scene_source::{SceneSource, Shot};
use super::{output, progress};

/// Render a scene file or a twin to images, one for each camera of a list.
///
/// Writes DIR/<name>.<format> for each camera. PNG and JPEG hold colour clamped to [0, 1] and
/// rounded to 8 bits. npy holds float32 [height, width, 4]: linear premultiplied red, green and
/// blue on black, and opacity.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Render {
    #[command(flatten)]
    source: SceneSource,

    #[command(flatten)]
    renderer: RendererOptions,

    /// Directory for the images; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// File format of the images.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

const EXAMPLES: &str = "\
Examples:
  wildcity render skull.ply --cameras front.json --out images
  wildcity render street --cameras views.json --out reference --backend reference --format npy
  wildcity render street --cameras views.json --out half --cpu-through sort
  wildcity render scene.ply --cameras views.json --out images --set near=0.2 --set alpha_cap=0.999";

#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum Format {
    #[default]
    Png,
    Jpeg,
    Npy,
}

impl Render {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let ready = self.source.open()?;
        let backend = self.renderer.backend()?;
        output::create_dir(&self.out)?;
        let bar = progress::count("rendering");
        bar.set_length(ready.shots.len() as u64);
        let mut out = output::stdout();
        for shot in &ready.shots {
            let pixels = shot.view.camera.pixels();
            let scene = ready.shot_scene(shot)?;
            let frame = Frame {
                scene: &scene,
                profile: &shot.profile,
                views: std::slice::from_ref(&shot.view),
            };
            let path = self.out.join(format!("{}.{}", shot.name, self.format.extension()));
            // Only the buffer of the format is filled.
            let mut rgba = Vec::new();
            let mut rgb8 = Vec::new();
            let target = match self.format {
                Format::Npy => {
                    rgba.resize(4 * pixels, 0.0);
                    Target { rgba: Some(&mut rgba), ..Target::default() }
                }
                Format::Png | Format::Jpeg => {
                    rgb8.resize(3 * pixels, 0);
                    Target { rgb8: Some(&mut rgb8), ..Target::default() }
                }
            };
            backend.render(&frame, &mut [target], &|_, _| {})?;
            let file = self
                .format
                .encode(shot, &rgba, &rgb8)
                .map_err(anyhow::Error::msg)
                .with_context(|| format!("cannot write {}", path.display()))?;
            output::write(&path, &file)?;
            bar.inc(1);
            writeln!(out, "{}", path.display())?;
        }
        bar.finish_and_clear();
        Ok(())
    }
}

impl Format {
    fn extension(self) -> &'static str {
        match self {
            Self::Png => "png",
            Self::Jpeg => "jpg",
            Self::Npy => "npy",
        }
    }

    /// The bytes of the file. They are written in one call, so that no error is lost in a buffer.
    fn encode(self, shot: &Shot, rgba: &[f32], rgb8: &[u8]) -> Result<Vec<u8>, String> {
        let width = shot.view.camera.width_px;
        let height = shot.view.camera.height_px;
        match self {
            Self::Png => wildcity_session::png(rgb8, width, height),
            Self::Jpeg => {
                wildcity_session::jpeg(rgb8, width, height, wildcity_session::limits::JPEG_QUALITY)
            }
            Self::Npy => Ok(npy([height, width, 4], rgba)),
        }
    }
}

/// A file of NumPy's format, version 1.0 (numpy.lib.format): magic, header length, a Python dict
/// padded to 64 bytes, data.
fn npy(shape: [u32; 3], values: &[f32]) -> Vec<u8> {
    let [h, w, c] = shape;
    let dict = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({h}, {w}, {c}), }}");
    let padded = (10 + dict.len() + 1).next_multiple_of(64) - 10;
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((padded as u16).to_le_bytes());
    file.extend(format!("{dict:width$}\n", width = padded - 1).into_bytes());
    file.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    file
}
