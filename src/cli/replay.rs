//! `wildcity replay`.

/// Repeat a recorded episode and compare every frame.
#[derive(Debug, clap::Args)]
pub(super) struct Replay {}

impl Replay {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
