//! The files that a SOG consists of, for a program that packs them.

use serde::Deserialize;

use crate::ingest::IngestError;

use super::bad;

/// The files that a description of a SOG names, relative to its folder.
#[derive(Debug, PartialEq, Eq)]
pub struct SogFiles {
    /// Other descriptions: the blocks of a streamed scene, and its surroundings.
    pub descriptions: Vec<String>,
    pub images: Vec<String>,
}

/// The keys that name files, of meta.json and of lod-meta.json.
#[derive(Deserialize)]
struct Keys {
    #[serde(default)]
    filenames: Vec<String>,
    environment: Option<String>,
    means: Option<Images>,
    scales: Option<Images>,
    quats: Option<Images>,
    sh0: Option<Images>,
    #[serde(rename = "shN")]
    sh_n: Option<Images>,
}

#[derive(Deserialize)]
struct Images {
    files: Vec<String>,
}

impl SogFiles {
    /// Reads a description. Error messages contain `name`.
    ///
    /// # Errors
    /// It is not JSON, or a key that names files has another type.
    pub fn from_json(json: &[u8], name: &str) -> Result<Self, IngestError> {
        let keys: Keys = serde_json::from_slice(json).map_err(|e| bad(name, e.to_string()))?;
        let Keys { filenames, environment, means, scales, quats, sh0, sh_n } = keys;
        let images = [means, scales, quats, sh0, sh_n].into_iter().flatten();
        Ok(Self {
            descriptions: filenames.into_iter().chain(environment).collect(),
            images: images.flat_map(|images| images.files).collect(),
        })
    }
}
