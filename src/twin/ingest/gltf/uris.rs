//! The bytes of a document's URIs: files, or base64 within the document.

use std::collections::BTreeMap;
use std::rc::Rc;

use data_encoding::BASE64;

use crate::ingest::IngestError;
use crate::ingest::scene_files::SceneFiles;
use crate::limits;

use super::bad;

/// Fetches URIs. Each file is read once and held until this is dropped, however often the document
/// names it: otherwise a document of 5 kB could hold a file of 64 MB a hundred times.
pub(super) struct Uris<'a> {
    parts: &'a mut dyn SceneFiles,
    files: BTreeMap<String, Rc<Vec<u8>>>,
    /// Bytes that may still be fetched.
    left_bytes: u64,
}

impl<'a> Uris<'a> {
    pub(super) fn new(parts: &'a mut dyn SceneFiles) -> Self {
        Self { parts, files: BTreeMap::new(), left_bytes: limits::SCENE_PART_BYTES }
    }

    /// Where the files come from, and the budget of the scene.
    pub(super) fn parts(&mut self) -> &mut dyn SceneFiles {
        self.parts
    }

    /// The bytes of a URI.
    ///
    /// # Errors
    /// The file cannot be read, the base64 is damaged, or the files have more than
    /// [`limits::SCENE_PART_BYTES`] in all.
    pub(super) fn fetch(&mut self, uri: &str, place: &str) -> Result<Rc<Vec<u8>>, IngestError> {
        if let Some(data) = uri.strip_prefix("data:") {
            let (_, text) = data
                .split_once(";base64,")
                .ok_or_else(|| bad(place, "its data URI has no \";base64,\"".into()))?;
            // Fewer bytes than their text, which the document holds already.
            let bytes = BASE64.decode(text.as_bytes());
            return bytes.map(Rc::new).map_err(|e| bad(place, format!("its base64: {e}")));
        }
        if let Some(known) = self.files.get(uri) {
            return Ok(known.clone());
        }
        let bytes = Rc::new(self.parts.read(uri, self.left_bytes)?);
        // `read` has refused a file of more bytes, so that this does not underflow.
        self.left_bytes -= bytes.len() as u64;
        self.files.insert(uri.to_owned(), bytes.clone());
        Ok(bytes)
    }
}
