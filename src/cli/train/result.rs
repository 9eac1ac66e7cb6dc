//! The files that a run leaves.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Rig, Trajectory};
use wildcity_train::sky_file;
use wildcity_train::trainer::Trainer;
use wildcity_twin::ingest::write_ply;

use crate::cli::output;

/// Where a run's result is.
pub(super) struct Written {
    pub(super) ply: PathBuf,
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
        let mut written =
            Self { ply: ply.to_owned(), sky: sky.transpose()?, drive: None, rig: None };
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

    /// Says what was written, and what to do with it.
    pub(super) fn print(&self, source: &Path, gaussians: usize, help: bool) -> io::Result<()> {
        let Self { ply, sky, .. } = self;
        let mut stdout = io::stdout().lock();
        writeln!(
            stdout,
            "{}: {gaussians} Gaussians, in the axes and the unit of {}",
            ply.display(),
            source.display()
        )?;
        if !help {
            return Ok(());
        }
        let sky = sky.as_ref().map_or(String::new(), |sky| format!(" --sky {sky:?}"));
        writeln!(
            stdout,
            "make a twin of it:\n\
             wildcity import {ply:?} --twin NAME --axes AXES{sky}\n\
             AXES is identity if z is up, and y-down-z-forward for most models of COLMAP",
        )
    }
}
