//! `wildcity bench`.

mod drive;
mod gpu;
mod step;
mod timed;

/// Time the renderer.
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
}

impl Bench {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Step(step) => step.run(),
            What::Gpu(gpu) => gpu.run(),
            What::Drive(drive) => drive.run(),
        }
    }
}
