//! `wildcity bench`.

/// Time the renderer.
#[derive(Debug, clap::Args)]
pub(super) struct Bench {}

impl Bench {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
