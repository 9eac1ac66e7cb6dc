//! `wildcity render`.

/// Render cameras of a file to images.
#[derive(Debug, clap::Args)]
pub(super) struct Render {}

impl Render {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
