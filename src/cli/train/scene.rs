//! `wildcity train SOURCE`.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use wildcity_log::Log;
use wildcity_train::held_out::{HeldOut, held_out_images};
use wildcity_train::page::{Contents, page};
use wildcity_train::settings::PoseMode;
use wildcity_train::trainer::{Fixed, Trainer};
use wildcity_twin::store::check_name;

use super::checkpoints::{self, Checkpoints};
use super::lines::LinesFile;
use super::log_images::LogImages;
use super::options::{Inputs, OpenedImages, RunOptions};
use super::progress::{PICTURES, evaluate_every, train};
use super::result::Written;
use super::start;
use crate::cli;
use crate::cli::output;

/// What `wildcity train SOURCE` takes.
#[derive(Debug, clap::Args)]
pub(super) struct TrainScene {
    #[command(flatten)]
    run: RunOptions,

    /// PLY file to write, which `wildcity import` and other viewers and trainers read. A page about
    /// the run is beside it: FILE.html.
    #[arg(long, value_name = "FILE", required = true)]
    out: Option<PathBuf>,

    /// Make a twin of the result: the name of a new twin, or of one that gets a new version.
    #[arg(long, value_name = "NAME")]
    twin: Option<String>,

    /// Axes of the poses, for --twin, in the form of `wildcity import --axes` [default: those of
    /// the twin's latest version, or identity]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true, requires = "twin")]
    axes: Option<String>,

    /// Directory of the twins, for --twin, as for `wildcity import`.
    #[arg(long, value_name = "DIR_OR_URL", requires = "twin")]
    twins: Option<OsString>,

    /// Go on with a run that was stopped. Its state is kept beside the file of --out each 500 steps
    /// and when it is stopped, and the result has the bytes of a run that was not.
    #[arg(long)]
    resume: bool,

    /// Write a line of JSON for each step.
    #[arg(long, value_name = "FILE")]
    lines: Option<PathBuf>,
}

impl TrainScene {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let source = self.run.source.path()?;
        // clap requires it.
        let out = self.out.as_deref().context("give --out FILE.ply")?;
        check_out(out)?;
        self.lines.as_ref().map_or(Ok(()), |lines| output::check_folder("--lines", lines))?;
        self.twin.as_deref().map_or(Ok(()), check_name).context("--twin")?;
        let inputs = self.run.open()?;
        let (trained, images) = self.train(out, inputs)?;
        let trainer = &trained.trainer;
        let is_of_rig = trainer.settings().poses.mode != PoseMode::Image;
        let poses = trainer.poses().filter(|_| is_of_rig);
        let refined = poses.and_then(|poses| Some(images.logged()?.refined(poses)));
        let cameras = images.logged().map(LogImages::camera_names).unwrap_or_default();
        let written = Written::new(trainer, out, images.images(), refined.as_ref())?;
        self.write(source, &trained, &cameras, &written)
    }

    /// Takes the run to its end.
    fn train(&self, out: &Path, inputs: Inputs) -> anyhow::Result<(Trained, OpenedImages)> {
        let Inputs { images: opened, inputs, start, profile, settings } = inputs;
        let images = opened.images();
        let backend = &*self.run.source.hardware.training()?;
        writeln!(
            io::stderr(),
            "{}, {} of them held out, {}, backend {}",
            output::counted(images.count(), "image"),
            images.held_out().len(),
            output::counted(start.gaussians.len(), "Gaussian"),
            backend.name()
        )?;
        let gaussians = start::inputs(&start.gaussians);
        let inputs = format!("{} {profile:?}\n{inputs}{gaussians}", backend.name());
        let checkpoints = Checkpoints::new(out, inputs);
        let mut trainer =
            match checkpoints.read(self.resume, profile, &settings, Fixed::default())? {
                Some(trainer) => trainer,
                None => Trainer::new(start, profile, settings)?,
            };
        let done = trainer.steps_done();
        let open = |path: &PathBuf| LinesFile::open(path, done);
        let mut lines = self.lines.as_ref().map(open).transpose()?;
        let every = evaluate_every(&trainer);
        let last = train(&mut trainer, images, backend, every, &mut |line, trainer| {
            lines.as_mut().map_or(Ok(()), |lines| lines.write(line))?;
            let is_time = line.step.is_multiple_of(checkpoints::EVERY);
            if is_time { checkpoints.write(trainer) } else { Ok(()) }
        })?;
        let steps = trainer.settings().steps;
        if trainer.steps_done() < steps {
            checkpoints.write(&trainer)?;
            anyhow::bail!(
                "stopped after {} of {steps} steps: the same command with --resume goes on",
                trainer.steps_done()
            );
        }
        if let Some((db, seconds)) = last {
            let mut stdout = output::stdout();
            writeln!(stdout, "held out: {db:.2} dB after {steps} steps, {seconds:.0} s")?;
        }
        // Whatever happens until all files are written: --resume only writes them.
        checkpoints.write(&trainer)?;
        let held_out = held_out_images(&trainer, images, backend, PICTURES)?;
        let held_out_count = images.held_out().len();
        let counts = [images.count() - held_out_count, held_out_count];
        Ok((Trained { trainer, held_out, images: counts }, opened))
    }

    /// Writes the page of a run, says what there is, and makes the twin.
    fn write(
        &self,
        source: &Path,
        trained: &Trained,
        cameras: &[String],
        written: &Written,
    ) -> anyhow::Result<()> {
        let Trained { trainer, held_out, images } = trained;
        let out = &written.ply;
        let name = source.display().to_string();
        let contents = Contents { source: &name, trainer, images: *images, held_out, cameras };
        output::write(&written.page, page(&contents)?.as_bytes())?;
        checkpoints::remove(out)?;
        let options = self.import_options(source, written);
        written.print(source, trainer.model().len())?;
        match &self.twin {
            Some(twin) => cli::run_command(
                &["import".as_ref(), out.as_os_str(), "--twin".as_ref(), twin.as_ref()],
                options,
            ),
            None => Ok(written.print_import(&options)?),
        }
    }

    /// The options of the import that makes a twin of the result.
    fn import_options(&self, source: &Path, written: &Written) -> cli::Options {
        let Written { sky, drive, rig, .. } = written.clone();
        let log: Option<OsString> = Log::is_log(source).then(|| source.into());
        let axes = self.axes.clone().map(OsString::from);
        vec![
            // The world of a log has z up.
            ("--axes", axes.or_else(|| log.is_some().then(|| "identity".into()))),
            ("--twins", self.twins.clone()),
            ("--sky", sky.map(OsString::from)),
            ("--trajectory", drive.map(OsString::from)),
            ("--rig", rig.map(OsString::from)),
            ("--log", log),
        ]
    }
}

/// A run that has reached its end.
struct Trained {
    trainer: Trainer,
    held_out: Vec<HeldOut>,
    /// Images that it has learned from, and those that were held out.
    images: [usize; 2],
}

/// Checks, before a long run, that its file can be written.
fn check_out(out: &Path) -> anyhow::Result<()> {
    let out_name = out.display();
    let is_ply = out.extension().is_some_and(|extension| extension == "ply");
    ensure!(is_ply, "--out {out_name}: the file is a PLY: give it a name that ends with .ply");
    let is_free = !out.exists() || out.is_file();
    ensure!(is_free, "--out {out_name} is a folder or a device: give the name of a file");
    output::check_folder("--out", out)
}
