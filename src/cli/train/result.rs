//! The files that a run leaves.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Rig, Trajectory};
use wildcity_train::compose::Exposure;
use wildcity_train::run::TrainingImages;
use wildcity_train::sky_file;
use wildcity_train::trainer::Trainer;
use wildcity_twin::ingest::write_ply;

use crate::cli::{Options, output};

/// Where a run's result is.
#[derive(Clone)]
pub(super) struct Written {
    pub(super) ply: PathBuf,
    /// Where the page about the run belongs.
    pub(super) page: PathBuf,
    /// The sky, if one was trained.
    pub(super) sky: Option<PathBuf>,
    /// The exposure of each image, if they were trained.
    pub(super) exposures: Option<PathBuf>,
    /// The drive and the rig, if their poses were trained.
    pub(super) drive: Option<PathBuf>,
    pub(super) rig: Option<PathBuf>,
}

impl Written {
    /// Writes the Gaussians to a PLY file, and the sky, the exposures and the refined poses beside
    /// it.
    pub(super) fn new(
        trainer: &Trainer,
        ply: &Path,
        images: &dyn TrainingImages,
        refined: Option<&(Trajectory, Rig)>,
    ) -> anyhow::Result<Self> {
        let gaussians = trainer.model().to_gaussians();
        // A file that is refused when it is read would be noticed only after the run is gone.
        validate::check(&gaussians, &Field::plain_name)
            .context("the run has made Gaussians that no scene may have: use smaller rates")?;
        let mut bytes = Vec::new();
        write_ply(&gaussians, &mut bytes)?;
        output::write(ply, &bytes)?;
        let network = trainer.sky()?;
        let sky = network.map(|network| {
            let path = ply.with_extension("sky.safetensors");
            output::write(&path, &sky_file(&network)?)?;
            anyhow::Ok(path)
        });
        let mut written = Self {
            ply: ply.to_owned(),
            page: ply.with_extension("html"),
            sky: sky.transpose()?,
            exposures: None,
            drive: None,
            rig: None,
        };
        if let Some(exposures) = trainer.exposures() {
            let path = ply.with_extension("exposures.json");
            output::write(&path, &to_json(&exposures, images)?)?;
            written.exposures = Some(path);
        }
        if let Some((drive, rig)) = refined {
            let put = |extension: &str, bytes: &[u8]| {
                let path = ply.with_extension(extension);
                output::write(&path, bytes)?;
                anyhow::Ok(Some(path))
            };
            written.drive = put("drive.json", &serde_json::to_vec(drive)?)?;
            written.rig = put("rig.json", &serde_json::to_vec_pretty(rig)?)?;
        }
        Ok(written)
    }

    /// Says what was written.
    pub(super) fn print(&self, source: &Path, gaussians: usize) -> io::Result<()> {
        writeln!(
            output::stdout(),
            "{}: {gaussians} Gaussians, in the axes and the unit of {}\n{}: a page about the run",
            self.ply.display(),
            source.display(),
            self.page.display()
        )
    }

    /// Says how to make a twin of it.
    pub(super) fn print_import(&self, options: &Options) -> io::Result<()> {
        let mut command = format!("wildcity import {:?} --twin NAME", self.ply);
        let mut has_axes = false;
        for (name, value) in options {
            if let Some(value) = value {
                command += &format!(" {name} {value:?}");
                has_axes |= *name == "--axes";
            }
        }
        let mut stdout = output::stdout();
        if has_axes {
            return writeln!(stdout, "make a twin of it:\n{command}");
        }
        writeln!(
            stdout,
            "make a twin of it:\n{command} --axes AXES\n\
             AXES is identity if z is up, and y-down-z-forward for most models of COLMAP"
        )
    }
}

/// Names of images with their maps of colours: `matrix * rgb + offset`, of linear values 0 to 1.
fn to_json(exposures: &[Exposure<f32>], images: &dyn TrainingImages) -> anyhow::Result<Vec<u8>> {
    let entry = |(index, exposure): (usize, &Exposure<f32>)| {
        let Exposure { matrix, offset } = exposure;
        (images.name(index), serde_json::json!({ "matrix": matrix, "offset": offset }))
    };
    let all: serde_json::Map<String, serde_json::Value> =
        exposures.iter().enumerate().map(entry).collect();
    Ok(serde_json::to_vec_pretty(&all)?)
}
