//! `wildcity twin copy` and `wildcity twin rename`.

use std::io::Write;

use crate::cli::directories::Twins;
use crate::cli::output;
use wildcity_twin::store::Version;

/// Copy one version of a twin to a new twin.
///
/// The copy renders the same images. Its hash is another one, because a version has the name of its
/// twin: scenarios and episodes that name the hash of the old one do not fit it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin copy street street-test
  wildcity twin copy street street-before --version 3")]
pub(super) struct Copy {
    /// Name of the twin.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Name of the new twin.
    #[arg(value_name = "NEW")]
    new: String,

    /// Number of the version [default: the latest]
    #[arg(long, value_name = "N")]
    version: Option<u64>,

    #[command(flatten)]
    twins: Twins,
}

impl Copy {
    pub(super) fn run(self) -> anyhow::Result<()> {
        report(&self.twins.catalog()?.copy(&self.twin, self.version, &self.new)?)
    }
}

/// Give a twin another name.
///
/// Copies each version that was not garbage-collected, and removes the old twin; there must be room
/// for both. Nothing is changed while a server uses a version. Hashes change, as with `wildcity
/// twin copy`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity twin rename street main-street")]
pub(super) struct Rename {
    /// Name of the twin.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// The name that it gets.
    #[arg(value_name = "NEW")]
    new: String,

    #[command(flatten)]
    twins: Twins,
}

impl Rename {
    pub(super) fn run(self) -> anyhow::Result<()> {
        report(&self.twins.catalog()?.rename(&self.twin, &self.new)?)
    }
}

fn report(version: &Version) -> anyhow::Result<()> {
    let twin = &version.manifest.twin;
    writeln!(output::stdout(), "twin {twin} version {}\nblake3 {}", version.number, version.hash)?;
    Ok(())
}
