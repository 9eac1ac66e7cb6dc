//! Re-reading every object of a twin.

use std::collections::BTreeMap;

use super::{Catalog, StoreError};

/// What was re-read.
#[derive(Debug)]
pub struct Verified {
    /// Objects that were compared with their hashes.
    pub objects: usize,
    /// Their size together, in bytes, as the manifests say.
    pub bytes: u64,
    /// The ones that are not what was committed.
    pub damaged: Vec<Damage>,
}

/// An object that is not what was committed.
#[derive(Debug)]
pub struct Damage {
    /// Its name, 64 lower-case hex digits.
    pub object: String,
    /// What is wrong with it: missing, unreadable, or of another hash.
    pub error: StoreError,
}

impl Catalog {
    /// Compares every object of every version of a twin with its hash. `progress` gets bytes done
    /// and bytes in all.
    ///
    /// # Errors
    /// The log cannot be read. Damage is no error: it is the answer.
    pub fn verify(
        &self,
        name: &str,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Verified, StoreError> {
        let mut damaged = Vec::new();
        let mut objects = BTreeMap::new();
        let mut manifests = BTreeMap::new();
        for number in self.numbers(name)? {
            let hash = self.record(name, number)?.manifest;
            match self.manifest(name, &hash) {
                Ok(manifest) => {
                    objects.extend(manifest.chunks.into_iter().map(|c| (c.object, c.bytes)));
                    manifests.insert(hash, ());
                }
                Err(error) => damaged.push(Damage { object: hash, error }),
            }
        }
        let total = objects.values().sum();
        let count = objects.len() + manifests.len() + damaged.len();
        let mut done = 0;
        for (object, bytes) in objects {
            let checked = self.objects.open(name, &object).and_then(|reader| reader.finish());
            if let Err(error) = checked {
                damaged.push(Damage { object, error });
            }
            done += bytes;
            progress(done, total);
        }
        Ok(Verified { objects: count, bytes: total, damaged })
    }
}
