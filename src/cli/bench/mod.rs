//! `wildcity bench`.

mod drive;
mod gpu;
mod load;
mod step;
mod timed;

/// Time the renderer, and reading twins.
#[derive(Debug, clap::Args)]
pub(super) struct Bench {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Step(step::Step),
    Gpu(gpu::Gpu),
    Drive(Box<drive::Drive>),
    Load(load::Load),
}

impl Bench {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Step(step) => step.run(),
            What::Gpu(gpu) => gpu.run(),
            What::Drive(drive) => drive.run(),
            What::Load(load) => load.run(),
        }
    }
}
