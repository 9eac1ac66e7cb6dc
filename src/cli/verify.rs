//! `wildcity verify`.

/// Check every object of a twin against its hash.
#[derive(Debug, clap::Args)]
pub(super) struct Verify {}

impl Verify {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
