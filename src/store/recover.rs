//! Cleaning up after imports that were killed.

use std::collections::BTreeSet;

use super::{Catalog, StoreError};

/// Removes what killed imports left: their staging, and objects they placed without a record.
pub(super) fn clean(catalog: &Catalog) -> Result<(), StoreError> {
    for name in catalog.objects.begun()? {
        if let Some(staging) = catalog.objects.stage_abandoned(&name)? {
            // With a damaged version nobody knows what it named, so everything stays.
            if let Ok(named) = named(catalog, &name) {
                staging.sweep(|hash| named.contains(hash))?;
            }
        }
    }
    Ok(())
}

/// Hashes of all objects that any version of a twin names.
pub(super) fn named(catalog: &Catalog, name: &str) -> Result<BTreeSet<String>, StoreError> {
    let mut named = BTreeSet::new();
    for number in catalog.objects.numbers(name)? {
        let hash = catalog.record(name, number)?.manifest;
        let manifest = catalog.manifest(name, &hash)?;
        named.extend(manifest.chunks.into_iter().map(|chunk| chunk.object));
        named.insert(hash);
    }
    Ok(named)
}
