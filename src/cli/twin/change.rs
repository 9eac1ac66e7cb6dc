//! A new version of a twin with the same Gaussians.

use std::io::Write;

use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output;
use wildcity_scene::Manifest;
use wildcity_twin::store::{CommitKind, StorageOptions, Version, VersionChange};

/// Commits a version with the changes that `edit` makes to its base, whose manifest it gets.
pub(super) fn commit(
    twins: &Twins,
    twin: &TwinVersion,
    edit: impl FnOnce(&Manifest, &mut VersionChange) -> anyhow::Result<()>,
) -> anyhow::Result<Version> {
    let catalog = twins.catalog()?;
    let base = catalog.version(&twin.name, twin.number)?;
    // The Gaussians stay, and so does the record of their origin.
    let mut change = VersionChange::edit();
    edit(&base.manifest, &mut change)?;
    let storage = StorageOptions { record: base.manifest.record, ..StorageOptions::default() };
    let commit = catalog.begin(&twin.name, CommitKind::Import, storage)?;
    Ok(commit.change(base.number, change)?)
}

/// Prints the number of a new version, a description of it, and its hash.
pub(super) fn print(version: &Version, what: &str) -> anyhow::Result<()> {
    let Version { number, hash, manifest, .. } = version;
    writeln!(output::stdout(), "twin {} version {number}: {what}\nblake3 {hash}", manifest.twin)?;
    Ok(())
}
