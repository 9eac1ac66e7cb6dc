//! `wildcity train loop`.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};

use super::scene::fraction;
use crate::cli;

/// Make a twin accurate off its drives, round by round: render views, repair them, train on them.
///
/// Round N renders views at min(0.5 m x N, OFFSET) beside the drives (`wildcity augment`), repairs
/// them with the model of --repair, trains the twin on them and on its recorded images
/// (`wildcity train refine`), and makes a new version of the twin, from which the next round
/// renders. A server that is running serves each new version to the sessions that open it.
///
/// A loop that was stopped goes on with --from N: the views of a round that were drawn are kept.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Loop {
    /// The name of the twin.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// The recorded images with their cameras, as for `wildcity train refine`.
    #[arg(long, value_name = "FILE_OR_DIR")]
    images: PathBuf,

    /// Folder of the recorded images, as for `wildcity eval`.
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks of the recorded images, as for `wildcity eval`.
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// TOML file of all settings, as for `wildcity train refine`.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    /// Axes of the poses of --images, as for `wildcity train refine`.
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Manifest of the model that repairs the images (docs/repair.md) [default: none, images are as
    /// rendered]
    #[arg(long, value_name = "MODEL.json")]
    repair: Option<PathBuf>,

    /// Number of the last round.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    rounds: u32,

    /// Number of the first round.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    from: u32,

    /// Lateral offsets that the rounds lead to, as for `wildcity augment`.
    #[arg(long, value_name = "M,..", default_value = "1,3,5")]
    offsets: String,

    /// Distance between two views along a drive, as for `wildcity augment`.
    #[arg(long, value_name = "M", default_value = "2")]
    every: String,

    /// Longest side of a rendered view, in pixels [default: the rig's]
    #[arg(long, value_name = "PX")]
    side: Option<u32>,

    /// Steps of each round, each on one image.
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: u32,

    /// Train on images of this fraction of their width, from 0.05 to 1.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    size: f64,

    /// Directory of the rounds; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Directory of the twins, or an object store, as for `wildcity import`.
    #[arg(long, value_name = "DIR_OR_URL")]
    twins: Option<OsString>,
}

const EXAMPLES: &str = "\
Examples:
  wildcity train loop street --images capture --repair model.json --rounds 10 --out rounds
  wildcity train loop street --images capture --repair model.json --from 4 --out rounds
  wildcity twin log street                              (the version of each round)";

impl Loop {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let Self { rounds, from, .. } = self;
        ensure!(from <= rounds, "--from {from} is after the last round: --rounds {rounds}");
        for round in from..=rounds {
            writeln!(io::stderr(), "round {round} of {rounds}")?;
            let again = || format!("round {round}: --from {round} goes on");
            cli::run_arguments(self.augment(round)).with_context(again)?;
            cli::run_arguments(self.refine(round)).with_context(again)?;
        }
        Ok(())
    }

    fn augment(&self, round: u32) -> Vec<OsString> {
        let mut arguments = self.common(&["augment", &self.twin]);
        let mut add = |name: &str, value: OsString| arguments.extend([name.into(), value]);
        add("--round", round.to_string().into());
        add("--offsets", self.offsets.clone().into());
        add("--every", self.every.clone().into());
        add("--out", self.out.clone().into());
        if let Some(repair) = &self.repair {
            add("--repair", repair.into());
        }
        if let Some(side) = self.side {
            add("--side", side.to_string().into());
        }
        arguments
    }

    fn refine(&self, round: u32) -> Vec<OsString> {
        let mut arguments = self.common(&["train", "refine", &self.twin]);
        let mut add = |name: &str, value: OsString| arguments.extend([name.into(), value]);
        add("--images", self.images.clone().into());
        add("--augmented", self.out.join(format!("round_{round}")).into());
        add("--steps", self.steps.to_string().into());
        add("--size", self.size.to_string().into());
        if let Some(axes) = &self.axes {
            add("--axes", axes.into());
        }
        let files = [
            ("--image-dir", &self.image_dir),
            ("--masks", &self.masks),
            ("--settings", &self.settings),
        ];
        for (name, file) in files {
            if let Some(file) = file {
                add(name, file.into());
            }
        }
        arguments
    }

    fn common(&self, command: &[&str]) -> Vec<OsString> {
        let mut arguments: Vec<OsString> = vec!["wildcity".into()];
        arguments.extend(command.iter().map(OsString::from));
        if let Some(twins) = &self.twins {
            arguments.extend(["--twins".into(), twins.clone()]);
        }
        arguments
    }
}
