//! The files that a run leaves.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use wildcity_train::sky_file;
use wildcity_train::trainer::Trainer;
use wildcity_twin::ingest::write_ply;

use crate::cli::output;

/// Where a run's result is.
pub(super) struct Written {
    pub(super) ply: PathBuf,
    /// The sky, if one was trained.
    pub(super) sky: Option<PathBuf>,
}

impl Written {
    /// Writes the Gaussians to a PLY file, and the sky beside it.
    pub(super) fn new(trainer: &Trainer, ply: &Path) -> anyhow::Result<Self> {
        let mut bytes = Vec::new();
        write_ply(&trainer.model().to_gaussians(), &mut bytes)?;
        output::write(ply, &bytes)?;
        let network = trainer.sky()?;
        let sky = network.map(|network| {
            let path = ply.with_extension("sky.safetensors");
            output::write(&path, &sky_file(&network)?)?;
            anyhow::Ok(path)
        });
        Ok(Self { ply: ply.to_owned(), sky: sky.transpose()? })
    }

    /// Says what was written, and what to do with it.
    pub(super) fn print(&self, source: &Path, gaussians: usize, help: bool) -> io::Result<()> {
        let Self { ply, sky } = self;
        let mut stdout = io::stdout().lock();
        let (name, source) = (ply.display(), source.display());
        writeln!(stdout, "{name}: {gaussians} Gaussians, in the axes and the unit of {source}")?;
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
