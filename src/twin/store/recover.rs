//! Cleaning up after commits that were killed.

use std::collections::BTreeSet;
use std::io::{self, ErrorKind};

use super::{Catalog, StoreError};

/// Removes what killed commits left: their staging, and objects they placed without a record.
///
/// Who may only read the directory leaves that to those who may write.
pub(super) fn clean(catalog: &Catalog) -> Result<(), StoreError> {
    for name in catalog.objects.unfinished_commits()? {
        // With a damaged version nobody knows what it named, so every object stays.
        match catalog.objects.remove_abandoned(&name, &|| named(catalog, &name).ok()) {
            Err(StoreError::Io { cause, .. }) if is_read_only(&cause) => {}
            cleaned => cleaned?,
        }
    }
    Ok(())
}

fn is_read_only(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem)
}

/// Hashes of all objects that any version of a twin names.
fn named(catalog: &Catalog, name: &str) -> Result<BTreeSet<String>, StoreError> {
    let (collected, mut named) = (catalog.collected(name)?, BTreeSet::new());
    for number in catalog.objects.numbers(name)? {
        if !collected.contains(&number) {
            named.extend(catalog.named_by(name, &catalog.record(name, number)?.manifest)?);
        }
    }
    Ok(named)
}
