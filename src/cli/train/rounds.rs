//! `wildcity train loop`.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};

use super::options::fraction;
use super::recorded::RecordedImages;
use crate::cli::{self, Options};

/// Make a twin accurate off its drives, round by round: render views, repair them, train on them.
///
/// Round N renders views at min(0.5 m x N, OFFSET) beside the drives (`wildcity train augment`),
/// repairs them with the model of --repair, trains the twin on them and on its recorded images
/// (`wildcity train refine`), and makes a new version of the twin, from which the next round
/// renders. A server that is running serves each new version to the sessions that open it. Each
/// round has a page in --out.
///
/// A loop that was stopped goes on with --from N: the views of a round that were drawn are kept.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Loop {
    /// The name of the twin.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    recorded: RecordedImages,

    /// TOML file of all settings, as for `wildcity train refine`.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

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

    /// Lateral offsets that the rounds lead to, as for `wildcity train augment`.
    #[arg(long, value_name = "M,..", default_value = "1,3,5")]
    offsets: String,

    /// Distance between two views along a drive, as for `wildcity train augment`.
    #[arg(long, value_name = "M", default_value = "2")]
    every: String,

    /// Render views of these cameras of the rig only, as for `wildcity train augment` [default:
    /// all]
    #[arg(long, value_name = "NAME,..")]
    cameras: Option<String>,

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
        let images = &self.recorded.images;
        ensure!(images.exists(), "--images {}: there is no such file or folder", images.display());
        for round in from..=rounds {
            writeln!(io::stderr(), "round {round} of {rounds}")?;
            let again = || format!("round {round}: --from {round} goes on");
            let twin = self.twin.as_ref();
            // Through the command line, so that defaults and checks are those of the two commands.
            cli::run_command(&["train".as_ref(), "augment".as_ref(), twin], self.augment(round))
                .with_context(again)?;
            cli::run_command(&["train".as_ref(), "refine".as_ref(), twin], self.refine(round))
                .with_context(again)?;
        }
        Ok(())
    }

    fn augment(&self, round: u32) -> Options {
        vec![
            ("--twins", self.twins.clone()),
            ("--round", text(round)),
            ("--offsets", text(&self.offsets)),
            ("--every", text(&self.every)),
            ("--out", Some(self.out.clone().into())),
            ("--repair", self.repair.clone().map(OsString::from)),
            ("--cameras", self.cameras.clone().map(OsString::from)),
            ("--side", self.side.and_then(text)),
        ]
    }

    fn refine(&self, round: u32) -> Options {
        let mut options = self.recorded.options();
        options.extend([
            ("--twins", self.twins.clone()),
            ("--augmented", Some(self.out.join(format!("round_{round}")).into())),
            ("--page", Some(self.out.join(format!("round_{round}.html")).into())),
            ("--steps", text(self.steps)),
            ("--size", text(self.size)),
            ("--settings", self.settings.clone().map(OsString::from)),
        ]);
        options
    }
}

fn text(value: impl ToString) -> Option<OsString> {
    Some(value.to_string().into())
}
