//! Streamed SOG: lod-meta.json and a SOG folder per block of every level of detail.
//!
//! Every leaf of its tree has one range of Gaussians per level, 0 being the finest. A twin makes
//! its own levels of detail, so only one range of every leaf is read: the finest, or that of a
//! level that is asked for. A leaf without that level gives the next coarser one that it has, or
//! else its coarsest.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use crate::ingest::notes::Reading;
use crate::ingest::scene_files::SceneFiles;
use crate::ingest::validate::Field;
use crate::ingest::{IngestError, check_count};
use crate::limits;
use wildcity_scene::Gaussians;

use super::{bad, read_one};

pub(super) const NAME: &str = "lod-meta.json";

/// The keys of lod-meta.json that are used; others are skipped.
#[derive(Deserialize)]
struct LodMeta {
    version: Option<u32>,
    /// Paths of meta.json files.
    filenames: Vec<String>,
    /// Path of one more, with the surroundings of the scene.
    environment: Option<String>,
    tree: Node,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Node>,
    #[serde(default)]
    lods: BTreeMap<u32, FileRange>,
}

/// Gaussians `offset` to `offset + count - 1` of a file.
#[derive(Clone, Copy, Deserialize)]
struct FileRange {
    file: usize,
    offset: u64,
    count: u64,
}

/// Reads one level, and the environment around it.
pub(super) fn read(
    json: &[u8],
    folder: &str,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let meta: LodMeta = serde_json::from_slice(json).map_err(|e| bad(NAME, e.to_string()))?;
    if let Some(version) = meta.version.filter(|&version| version != 1) {
        return Err(bad(NAME, format!("version {version}; 1, with or without a number, is read")));
    }
    // Each file of a scene is read once, so that a repeated name could not be read.
    let mut names = BTreeSet::new();
    if let Some(twice) = meta.filenames.iter().find(|name| !names.insert(name.as_str())) {
        return Err(bad(NAME, format!("file {twice:?} is named twice")));
    }
    let level = reading.take_level();
    let places = ranges_by_file(&meta, level.unwrap_or(0))?;
    let total = places.values().flatten().map(|place| u128::from(place.count)).sum::<u128>();
    check_count(u64::try_from(total).unwrap_or(u64::MAX))?;
    let mut all = Gaussians::default();
    // File by file, so that each is decoded once and one block at a time is in memory.
    for (file, places) in places {
        let block = read_block(&meta.filenames[file], folder, parts, reading)?;
        for FileRange { offset, count, .. } in places {
            let held = block.len() as u64;
            let end = offset.saturating_add(count);
            if end > held {
                let reason =
                    format!("Gaussians to {end} of {:?}, which has {held}", meta.filenames[file]);
                return Err(bad(NAME, reason));
            }
            all.append_range(&block, offset as usize..end as usize);
        }
    }
    if let Some(environment) = &meta.environment {
        let block = read_block(environment, folder, parts, reading)?;
        all.append(&block);
    }
    reading.accept(all, &Field::plain_name)
}

/// The ranges of a level in every file, in order, and checked not to overlap.
fn ranges_by_file(
    meta: &LodMeta,
    level: u32,
) -> Result<BTreeMap<usize, Vec<FileRange>>, IngestError> {
    let mut places: BTreeMap<usize, Vec<FileRange>> = BTreeMap::new();
    let mut levels = BTreeSet::new();
    // Without recursion, because the depth of the tree is up to the file.
    let mut nodes = vec![&meta.tree];
    while let Some(node) = nodes.pop() {
        nodes.extend(&node.children);
        levels.extend(node.lods.keys());
        let coarser = node.lods.range(level..).next();
        if let Some((_, place)) = coarser.or_else(|| node.lods.last_key_value()) {
            if place.file >= meta.filenames.len() {
                let reason = format!("file {}; there are {}", place.file, meta.filenames.len());
                return Err(bad(NAME, reason));
            }
            places.entry(place.file).or_default().push(*place);
        }
    }
    // Level 0 is the finest that each leaf has, whatever its number is.
    if level > 0 && !levels.contains(&level) {
        return Err(IngestError::NoLevel { level, levels: levels.into_iter().collect() });
    }
    for (file, places) in &mut places {
        places.sort_by_key(|place| place.offset);
        let apart =
            places.windows(2).all(|w| w[0].offset.saturating_add(w[0].count) <= w[1].offset);
        if !apart {
            let reason = format!("two leaves share Gaussians of {:?}", meta.filenames[*file]);
            return Err(bad(NAME, reason));
        }
    }
    Ok(places)
}

fn read_block(
    name: &str,
    folder: &str,
    parts: &mut dyn SceneFiles,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let path = format!("{folder}{name}");
    let json = parts.read(&path, limits::SCENE_JSON_BYTES)?;
    let folder = path.rfind('/').map_or("", |slash| &path[..=slash]);
    let block = read_one(&json, name, folder, parts, reading)?;
    // Ranges count Gaussians of the whole block, so they are left out when all blocks are joined.
    if reading.drops_bad() { Ok(block) } else { reading.accept(block, &Field::plain_name) }
}
