//! `wildcity inspect`.

/// Show what a twin consists of.
#[derive(Debug, clap::Args)]
pub(super) struct Inspect {}

impl Inspect {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
