//! `wildcity verify`.

use std::io::{self, Write};

use crate::store::Catalog;

use super::places::Twins;
use super::progress;

/// Read every object of every version of a twin again and compare it with its hash.
///
/// Exit code 0 if all are what was committed; otherwise 1, and the damaged ones are named.
/// Importing the same source again with the same options heals them.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "Example:\n  wildcity verify street && wildcity serve")]
pub(super) struct Verify {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    twins: Twins,
}

impl Verify {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = Catalog::open(&self.twins.dir()?)?;
        let bar = progress::bytes("verifying");
        let verified = catalog.verify(&self.twin, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let mut out = io::stdout().lock();
        for damage in &verified.damaged {
            writeln!(out, "damaged {}: {}", damage.object, damage.error)?;
        }
        let (damaged, objects) = (verified.damaged.len(), verified.objects);
        anyhow::ensure!(damaged == 0, "{damaged} of {objects} objects are damaged");
        writeln!(
            out,
            "twin {}: {objects} objects, {} bytes of chunks, all sound",
            self.twin, verified.bytes
        )?;
        Ok(())
    }
}
