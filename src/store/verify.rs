//! Re-reading every object of a twin.

use std::collections::{BTreeMap, BTreeSet};

use super::{Catalog, StoreError};

/// What was re-read.
#[derive(Debug)]
pub struct Verified {
    /// Objects that were compared with their hashes.
    pub objects: usize,
    /// Size of the chunks together, in bytes, as the manifests say.
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
        // By hash: versions share objects, and are often alike.
        let (mut sound, mut chunks) = (BTreeSet::new(), BTreeMap::new());
        for number in self.numbers(name)? {
            let hash = self.record(name, number)?.manifest;
            if sound.contains(&hash) {
                continue;
            }
            match self.manifest(name, &hash) {
                Ok(mut manifest) => {
                    sound.insert(hash);
                    let table = manifest.table.object.clone();
                    // Without their table, chunks are still compared with their own hashes.
                    if let Err(error) = self.fill(&mut manifest) {
                        damaged.push(Damage { object: table, error });
                    } else {
                        sound.insert(table);
                    }
                    chunks.extend(manifest.chunks.into_iter().map(|c| (c.object.clone(), c)));
                }
                Err(error) => damaged.push(Damage { object: hash, error }),
            }
        }
        let total = chunks.values().map(|chunk| chunk.bytes).sum();
        let objects = chunks.len() + sound.len() + damaged.len();
        let mut done = 0;
        for (object, chunk) in chunks {
            let checked = if chunk.sections.is_empty() {
                self.objects.open(name, &object).and_then(|reader| reader.finish())
            } else {
                self.check_chunk(name, &chunk)
            };
            if let Err(error) = checked {
                damaged.push(Damage { object, error });
            }
            done += chunk.bytes;
            progress(done, total);
        }
        Ok(Verified { objects, bytes: total, damaged })
    }
}
