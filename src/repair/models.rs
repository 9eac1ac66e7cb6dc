//! The models that a program offers, by name. Each is loaded on its first use, so that a program
//! whose users request none loads no library.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::error::RepairError;
use crate::files;
use crate::model::{LoadOptions, Model};
use crate::reference::ReferenceCache;

/// The models of some manifests.
#[derive(Debug, Default)]
pub struct Models {
    options: LoadOptions,
    entries: BTreeMap<String, Entry>,
    references: ReferenceCache,
}

#[derive(Debug)]
struct Entry {
    manifest: PathBuf,
    loaded: Mutex<Option<Arc<Model>>>,
}

impl Models {
    /// Reads only the manifests at `paths`: no model and no library is loaded. If there is a
    /// manifest, checks that the library is a file.
    ///
    /// # Errors
    /// A manifest cannot be read, two have the same name, or the library is not named or is not a
    /// file.
    pub fn read(paths: &[PathBuf], options: LoadOptions) -> Result<Models, RepairError> {
        let mut entries: BTreeMap<String, Entry> = BTreeMap::new();
        for path in paths {
            let name = files::read_manifest(path)?.name;
            if let Some(other) = entries.get(&name) {
                let message =
                    format!("{name:?} is also that of {}; rename one", other.manifest.display());
                let field = "name".to_owned();
                return Err(RepairError::Manifest { file: path.clone(), field, message });
            }
            let entry = Entry { manifest: path.clone(), loaded: Mutex::default() };
            entries.insert(name, entry);
        }
        // A program without models needs no library.
        if !entries.is_empty() {
            if options.library.as_os_str().is_empty() {
                return Err(RepairError::RuntimeUnnamed);
            }
            let path = options.library.clone();
            files::check_library(&path)
                .map_err(|message| RepairError::Runtime { path, message })?;
        }
        let references = ReferenceCache::new(options.reference_bytes);
        Ok(Models { options, entries, references })
    }

    /// The names of the models, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// The cache of reference images for the models' sessions.
    pub fn references(&self) -> &ReferenceCache {
        &self.references
    }

    /// The model of a name. Loads it if it is not loaded yet, or was withdrawn; callers of the same
    /// model wait for each other.
    ///
    /// # Errors
    /// [`RepairError::Unknown`], or those of [`Model::load`].
    pub fn get(&self, name: &str) -> Result<Arc<Model>, RepairError> {
        let Some(entry) = self.entries.get(name) else {
            let known = self.entries.keys().cloned().collect();
            return Err(RepairError::Unknown { name: name.to_owned(), known });
        };
        // The lock of this entry is held while the model loads: a second caller waits for the same
        // model instead of loading it again. Other models have locks of their own.
        let mut loaded = entry.loaded.lock();
        if let Some(model) = loaded.as_ref().filter(|model| !model.is_withdrawn()) {
            return Ok(Arc::clone(model));
        }
        // The withdrawn model is dropped first: two of them may not fit the GPU's memory.
        *loaded = None;
        let model = Arc::new(Model::load(&entry.manifest, &self.options)?);
        // The manifest is read a second time here, and may have been replaced since the start.
        if model.manifest().name != name {
            let message = format!(
                "{:?}; it was {name:?} when the program started: restart it, or restore the file",
                model.manifest().name
            );
            let field = "name".to_owned();
            return Err(RepairError::Manifest { file: entry.manifest.clone(), field, message });
        }
        *loaded = Some(Arc::clone(&model));
        Ok(model)
    }
}
