//! `wildcity import`.

/// Make a twin of a trained scene.
#[derive(Debug, clap::Args)]
pub(super) struct Import {}

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        anyhow::bail!("not built yet")
    }
}
