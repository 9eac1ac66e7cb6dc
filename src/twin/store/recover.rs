//! Removes the remains of killed commits.

use std::collections::BTreeSet;
use std::io::{self, ErrorKind};

use super::layout::ACTORS;
use super::{Catalog, StoreError};

impl Catalog {
    /// Removes the remains of killed commits of all twins: their staging, and objects that they
    /// placed without a record.
    ///
    /// A process with read-only access leaves this to processes that may write.
    ///
    /// # Errors
    /// The unfinished commits cannot be listed, or the remains of twin `needed` cannot be removed.
    /// A failure of another twin is left to the next commit of that twin.
    pub(super) fn remove_abandoned_commits(&self, needed: Option<&str>) -> Result<(), StoreError> {
        for name in self.objects.unfinished_commits()? {
            // If a version is damaged, it is unknown which objects it named, so every object is
            // kept. No version names assets, and all of them are kept.
            let named = || match &*name {
                ACTORS => None,
                name => self.named_by_all(name).ok(),
            };
            match self.objects.remove_abandoned(&name, &named) {
                Err(StoreError::Io { cause, .. }) if is_read_only(&cause) => {}
                Err(error) if needed == Some(&*name) => return Err(error),
                _ => {}
            }
        }
        Ok(())
    }

    /// Hashes of all objects that any version of a twin names.
    fn named_by_all(&self, name: &str) -> Result<BTreeSet<String>, StoreError> {
        let collected = self.collected(name)?;
        let mut named = BTreeSet::new();
        // `numbers` would fail for a twin whose first commit was killed.
        for number in self.objects.version_numbers(name)? {
            if !collected.contains(&number) {
                named.extend(self.named_by(name, &self.record(name, number)?.manifest)?);
            }
        }
        Ok(named)
    }
}

fn is_read_only(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem)
}
