//! The bytes of an asset.

use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::limits;
use wildcity_scene::actor::{ActorAsset, AssetDescription, AssetLevel};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_scene::record::Clamped;
use wildcity_scene::{RecordFormat, sh};

use crate::store::chunk_file::{self, LevelOfBlock};
use crate::store::{Catalog, StoreError};

use super::StoredLevel;

const MAGIC: [u8; 8] = *b"WILDACTR";
const FORMAT: u32 = 1;
/// Bytes before the header.
const START_BYTES: usize = 16;
/// Number of first bytes that contain the header and everything before it.
pub(super) const HEAD_BYTES: usize = START_BYTES + limits::ACTOR_HEADER_BYTES;

/// The header of an asset.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Header {
    pub(super) description: AssetDescription,
    pub(super) sh_degree: u8,
    pub(super) record: RecordFormat,
    /// Whether its Gaussians have classes; as in a chunk's entry of a manifest.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(super) classes: bool,
    pub(super) levels: Vec<StoredLevel>,
}

impl Catalog {
    /// The bytes of an asset, and its header.
    ///
    /// # Errors
    /// [`StoreError::Clamped`] if the record format cannot hold its values; it cannot be
    /// compressed.
    pub(super) fn encode_actor(
        &self,
        asset: &ActorAsset,
        record: RecordFormat,
    ) -> Result<(Header, Vec<u8>), StoreError> {
        let mut content = Vec::new();
        let mut levels = Vec::with_capacity(asset.levels.len());
        // Degree and classes are those of level 0, and the header has them once for all levels.
        let sh_degree = asset.levels.first().map_or(0, |level| level.chunk.sh_degree());
        let classes = asset.levels.first().is_some_and(|level| level.chunk.classes().is_some());
        for (index, AssetLevel { error_m, chunk }) in asset.levels.iter().enumerate() {
            let mut clamped = Clamped::default();
            // An asset is stored like block 0 of a cell at the origin.
            let level = LevelOfBlock { block: 0, level: index as u8, error_m: *error_m };
            let packed = chunk_file::pack(chunk, level, record, &mut clamped)
                .map_err(StoreError::io("compress for", self.dir()))?;
            let own = packed.into_bytes();
            // Merged Gaussians are approximations anyway: only level 0 counts.
            let gaussians = chunk.len() as u64;
            if let Some((field, count)) = clamped.worst().filter(|_| index == 0)
                && count as f64 > limits::CLAMPED_SHARE * gaussians as f64
            {
                return Err(StoreError::Clamped { record, field, count, gaussians });
            }
            let count = chunk.len() as u32;
            levels.push(StoredLevel { count, error_m: *error_m, bytes: own.len() as u32 });
            content.extend(own);
        }
        let description = asset.description.clone();
        let header = Header { description, sh_degree, record, classes, levels };
        let json = self.encode(&header)?;
        let mut bytes = MAGIC.to_vec();
        bytes.extend(FORMAT.to_le_bytes());
        bytes.extend((json.len() as u32).to_le_bytes());
        bytes.extend(json);
        bytes.extend(content);
        Ok((header, bytes))
    }
}

impl Header {
    /// The header of an asset, and the bytes after it. The error describes their damage.
    pub(super) fn read(bytes: &[u8]) -> Result<(Self, &[u8]), String> {
        let start = bytes.split_first_chunk::<START_BYTES>();
        let (start, rest) = start.ok_or("it is shorter than its start")?;
        let word = |at: usize| {
            u32::from_le_bytes([start[at], start[at + 1], start[at + 2], start[at + 3]])
        };
        if start[..8] != MAGIC {
            return Err("it does not start as an actor".to_owned());
        }
        if word(8) != FORMAT {
            return Err(format!("it has format {}; this build reads format {FORMAT}", word(8)));
        }
        let length = word(12) as usize;
        // `bytes` may be only the first [`HEAD_BYTES`], which have no room for a longer header.
        if length > limits::ACTOR_HEADER_BYTES {
            return Err("its header is longer than it may be".to_owned());
        }
        let json = rest.get(..length).ok_or("it ends in its header")?;
        let header: Self = serde_json::from_slice(json).map_err(|error| error.to_string())?;
        header.check()?;
        Ok((header, &rest[length..]))
    }

    /// Checks the rules that the type does not express.
    fn check(&self) -> Result<(), String> {
        self.description.box_.check().map_err(|error| error.to_string())?;
        if self.sh_degree > sh::MAX_DEGREE {
            return Err(format!("SH degree is {}, not 0 to 3", self.sh_degree));
        }
        let first = self.levels.first().ok_or("it has no levels")?;
        // The counts fall from level to level, which is checked below, so that this bounds all of
        // them.
        if first.count as usize > ActorAsset::MOST_GAUSSIANS {
            return Err(format!("{} Gaussians are too many for an actor", first.count));
        }
        // Each condition states what must hold, so that NaN fails it.
        let rising = self.levels.is_sorted_by(|a, b| a.error_m <= b.error_m && a.count >= b.count);
        let finite = self.levels.iter().all(|level| level.error_m.is_finite());
        if rising && finite && first.error_m == 0.0 { Ok(()) } else { Err("wrong levels".into()) }
    }

    /// The levels of detail, from the bytes after the header. The error describes their damage.
    pub(super) fn levels(&self, mut rest: &[u8]) -> Result<Vec<AssetLevel>, String> {
        let mut levels = Vec::with_capacity(self.levels.len());
        for (index, level) in self.levels.iter().enumerate() {
            let of_level = |reason: String| format!("level {index}: {reason}");
            let own = rest
                .get(..level.bytes as usize)
                .ok_or_else(|| of_level("it ends before its last byte".to_owned()))?;
            // Levels follow each other without gaps: what is left after the last one is damage.
            rest = &rest[own.len()..];
            let (entry, section) = section(level, self.classes);
            let chunk =
                chunk_file::unpack(own, &entry, &section, self.sh_degree, self.record, None)
                    .map_err(of_level)?;
            levels.push(AssetLevel { error_m: level.error_m, chunk: Arc::new(chunk) });
        }
        if rest.is_empty() {
            Ok(levels)
        } else {
            Err(format!("{} bytes are left over", rest.len()))
        }
    }
}

/// A level in the form of a chunk's section: what [`chunk_file::unpack`] reads of it is the count,
/// the cell, the origin and whether there are classes.
fn section(level: &StoredLevel, classes: bool) -> (ChunkEntry, Section) {
    let entry = ChunkEntry {
        cell: [0, 0],
        object: String::new(),
        count: level.count.into(),
        bytes: level.bytes.into(),
        bounds: Bounds::EMPTY,
        origin_m: DVec3::ZERO,
        classes,
        sections: Vec::new(),
    };
    let section = Section {
        block: 0,
        level: 0,
        count: level.count,
        error_m: level.error_m,
        min_m: [0.0; 3],
        max_m: [0.0; 3],
        offset_bytes: 0,
        bytes: level.bytes,
        hash: [0; 32],
    };
    (entry, section)
}
