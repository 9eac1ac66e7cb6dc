//! `wildcity bench`.

mod gpu;
mod step;

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
}

impl Bench {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Step(step) => step.run(),
            What::Gpu(gpu) => gpu.run(),
        }
    }
}

/// The one in the middle, or the mean of the two in the middle.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    0.5 * (values.get(low).unwrap_or(&f64::NAN) + values.get(high).unwrap_or(&f64::NAN))
}
