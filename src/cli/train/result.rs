//! The files that a run leaves.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Rig, Trajectory};
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
    /// The drive and the rig, if their poses were trained.
    pub(super) drive: Option<PathBuf>,
    pub(super) rig: Option<PathBuf>,
}

impl Written {
    /// Writes the Gaussians to a PLY file, and the sky and the refined poses beside it.
    pub(super) fn new(
        trainer: &Trainer,
        ply: &Path,
        refined: Option<&(Trajectory, Rig)>,
    ) -> anyhow::Result<Self> {
        let gaussians = trainer.model().to_gaussians();
        validate::check(&gaussians, &Field::plain_name)
            .context("the run has made Gaussians that no scene may have: use smaller rates")?;
        if trainer.settings().exposure.on {
            writeln!(
                io::stderr(),
                "note: the exposures of images are not written: the scene has the mean one"
            )?;
        }
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
            drive: None,
            rig: None,
        };
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
            io::stdout().lock(),
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
        let mut stdout = io::stdout().lock();
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
