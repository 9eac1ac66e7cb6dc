//! The checkpoint of a run: a file beside its result, from which `--resume` goes on.

use std::fs;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::process;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use anyhow::{Context, ensure};
use tokio::runtime;
use wildcity_scene::RenderProfile;
use wildcity_train::settings::Settings;
use wildcity_train::trainer::{Fixed, Trainer};

use crate::cli::output;

/// Steps from one checkpoint to the next.
pub(super) const EVERY: usize = 500;

/// The checkpoint of one run.
pub(super) struct Checkpoints {
    path: PathBuf,
    /// What names the images, cameras and points of the run.
    inputs: String,
}

impl Checkpoints {
    /// The checkpoint of a run that writes `out`.
    pub(super) fn new(out: &Path, inputs: String) -> Self {
        Self::at(&path(out), inputs)
    }

    /// The checkpoint in a file.
    pub(super) fn at(path: &Path, inputs: String) -> Self {
        Self { path: path.to_owned(), inputs }
    }

    /// The run that goes on; `None` if it begins anew, which a checkpoint of an earlier run must
    /// not be lost by.
    pub(super) fn read(
        &self,
        resume: bool,
        profile: RenderProfile,
        settings: &Settings,
        fixed: Fixed,
    ) -> anyhow::Result<Option<Trainer>> {
        let name = self.path.display();
        let file = match fs::File::open(&self.path) {
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
        let file = BufReader::new(file);
        let trainer = Trainer::from_checkpoint(file, &self.inputs, profile, settings, fixed);
        Ok(Some(trainer.with_context(|| format!("{name}"))?))
    }

    pub(super) fn write(&self, trainer: &Trainer) -> anyhow::Result<()> {
        output::write_by(&self.path, |file| Ok(trainer.write_checkpoint(&self.inputs, file)?))
    }
}

/// The file of a run that writes `out`.
fn path(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    // Appended and not put in place of the extension: two outputs that differ only in theirs have
    // two checkpoints.
    name.push(".checkpoint");
    name.into()
}

/// Removes the checkpoint of a run that has reached its end.
pub(super) fn remove(out: &Path) -> anyhow::Result<()> {
    remove_file(&path(out))
}

/// Removes a checkpoint, if it is there.
pub(super) fn remove_file(path: &Path) -> anyhow::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Whether a run is at work, which ends after its step when the process is asked to stop.
static TRAINS: AtomicBool = AtomicBool::new(false);

/// Whether the process has been asked to stop.
static STOPS: AtomicBool = AtomicBool::new(false);

/// As long as it lives, the first SIGTERM or Ctrl-C asks the run to stop. Every other one ends the
/// process, as without it.
pub(super) struct StopsAtSignal;

impl StopsAtSignal {
    pub(super) fn new() -> anyhow::Result<Self> {
        // A comparison trains several times in one process, and needs one thread for all.
        static LISTENS: OnceLock<()> = OnceLock::new();
        if LISTENS.set(()).is_ok() {
            let runtime = runtime::Builder::new_current_thread().enable_all().build()?;
            // Registered before the thread begins, so that no signal is lost.
            let first = {
                let _guard = runtime.enter();
                wildcity_server::stop_signal()?
            };
            let listen = async move {
                first.await;
                STOPS.store(true, Ordering::Relaxed);
                // The first signal lets the step end and the checkpoint be written; a second one
                // ends at once.
                if TRAINS.load(Ordering::Relaxed) {
                    let Ok(second) = wildcity_server::stop_signal() else { return };
                    second.await;
                }
                // 128 and the number of SIGINT, as shells report it.
                process::exit(130);
            };
            let thread = thread::Builder::new().name("signals".to_owned());
            thread.spawn(move || runtime.block_on(listen))?;
        }
        TRAINS.store(true, Ordering::Relaxed);
        Ok(Self)
    }

    pub(super) fn stops(&self) -> bool {
        STOPS.load(Ordering::Relaxed)
    }
}

impl Drop for StopsAtSignal {
    fn drop(&mut self) {
        TRAINS.store(false, Ordering::Relaxed);
    }
}
