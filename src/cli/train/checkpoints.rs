//! The checkpoint of a run: a file beside its result, from which `--resume` goes on.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use anyhow::{Context, ensure};
use tokio::runtime;
use wildcity_scene::RenderProfile;
use wildcity_train::settings::Settings;
use wildcity_train::trainer::Trainer;

use crate::cli::output;

/// Steps from one checkpoint to the next.
pub(super) const EVERY: usize = 500;

/// The checkpoint of one run.
pub(super) struct Checkpoints {
    pub(super) path: PathBuf,
    /// What names the images, cameras and points of the run.
    inputs: String,
}

impl Checkpoints {
    /// The checkpoint of a run that writes `out`.
    pub(super) fn new(out: &Path, inputs: String) -> Self {
        let mut name = out.as_os_str().to_owned();
        name.push(".checkpoint");
        Self { path: name.into(), inputs }
    }

    /// The run that goes on; `None` if it begins anew, which a checkpoint of an earlier run must
    /// not be lost by.
    pub(super) fn read(
        &self,
        resume: bool,
        profile: RenderProfile,
        settings: &Settings,
    ) -> anyhow::Result<Option<Trainer>> {
        let name = self.path.display();
        let bytes = match fs::read(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                ensure!(!resume, "--resume: there is no {name}: begin without --resume");
                return Ok(None);
            }
            read => read.with_context(|| format!("cannot read {name}"))?,
        };
        ensure!(
            resume,
            "{name} is there: an earlier run was stopped. --resume goes on with it; remove the file to begin anew"
        );
        let trainer = Trainer::from_checkpoint(&bytes, &self.inputs, profile, settings, None);
        Ok(Some(trainer.with_context(|| format!("{name}"))?))
    }

    pub(super) fn write(&self, trainer: &Trainer) -> anyhow::Result<()> {
        output::write(&self.path, &trainer.to_checkpoint(&self.inputs)?)
    }

    /// Removes the checkpoint of a run that has reached its end.
    pub(super) fn remove(&self) -> anyhow::Result<()> {
        match fs::remove_file(&self.path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot remove {}", self.path.display()))
            }
            _ => Ok(()),
        }
    }
}

/// Becomes true when the process is asked to stop: SIGTERM, or Ctrl-C. A second signal ends the
/// process at once.
pub(super) fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    let runtime = runtime::Builder::new_current_thread().enable_all().build()?;
    let signal = {
        let _guard = runtime.enter();
        wildcity_server::stop_signal()?
    };
    let stops = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stops);
    thread::Builder::new().name("signals".to_owned()).spawn(move || {
        runtime.block_on(signal);
        flag.store(true, Ordering::Relaxed);
    })?;
    Ok(stops)
}
