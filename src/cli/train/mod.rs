//! `wildcity train`.

mod augment;
mod block;
mod block_parts;
mod check;
mod checkpoints;
mod compare;
mod depths;
mod images;
mod lines;
mod log_images;
mod options;
mod plan;
mod progress;
mod recorded;
mod refine;
mod result;
mod rounds;
mod scene;
mod settings;
mod start;

use super::subcommands::subcommands;

/// Make a twin from a log, or a scene from photographs with known cameras, without a GPU or with
/// one.
///
/// Each step renders one image, compares it with the photograph, and moves the Gaussians by the
/// derivatives of the difference. Gaussians that have become transparent become copies of others,
/// and their number grows up to --cap. Prints the PSNR of the photographs that were held out.
///
/// 200 images of 360 x 232 px take a minute and a half for 3,000 steps on two cores.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = EXAMPLES,
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    arg_required_else_help = true
)]
pub(super) struct Train {
    #[command(subcommand)]
    command: Option<TrainCommand>,

    #[command(flatten)]
    scene: scene::TrainScene,
}

const EXAMPLES: &str = "\
Examples:
  wildcity train log --out street.ply --twin street
  wildcity train capture --out capture.ply --size 0.25 --steps 3000
  wildcity train capture/transforms.json --points lidar.ply --out scene.ply --lines train.jsonl
  wildcity import capture.ply --twin capture --axes y-down-z-forward";

subcommands! { TrainCommand;
    Plan(Box<plan::Plan>),
    Compare(Box<compare::Compare>),
    Block(Box<block::Block>),
    Augment(Box<augment::Augment>),
    Refine(Box<refine::Refine>),
    Loop(Box<rounds::Loop>),
    Check(check::Check),
    Settings(settings::PrintSettings),
}

impl Train {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.command {
            Some(command) => command.run(),
            None => self.scene.run(),
        }
    }
}
