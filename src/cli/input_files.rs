//! JSON files that several commands read: rigs, and recorded drives.

use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::de::DeserializeOwned;

use crate::cli::limits;
use wildcity_scene::{Rig, Trajectory};
use wildcity_twin::ingest;
use wildcity_twin::store::StoreError;

/// Reads the cameras of a vehicle, and checks them.
pub(super) fn read_rig(path: &Path) -> anyhow::Result<Rig> {
    let rig: Rig = read_json(path)?;
    rig.check().with_context(|| format!("{}", path.display()))?;
    Ok(rig)
}

/// Reads several recorded drives. Their names must differ.
pub(super) fn read_trajectories(paths: &[PathBuf]) -> anyhow::Result<Vec<Trajectory>> {
    let mut read: Vec<Trajectory> = Vec::with_capacity(paths.len());
    for path in paths {
        let trajectory = read_trajectory(path)?;
        if read.iter().any(|before| before.name == trajectory.name) {
            return Err(StoreError::DuplicateTrajectory { name: trajectory.name })
                .with_context(|| format!("{}", path.display()));
        }
        read.push(trajectory);
    }
    Ok(read)
}

/// Reads a recorded drive, and checks it.
pub(super) fn read_trajectory(path: &Path) -> anyhow::Result<Trajectory> {
    let trajectory: Trajectory = read_json(path)?;
    trajectory.check().with_context(|| format!("{}", path.display()))?;
    Ok(trajectory)
}

fn read_json<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = ingest::read_whole(path, limits::SETTINGS_FILE_BYTES)
        .with_context(|| format!("{}", path.display()))?;
    // serde reads a list as the fields of an object in their order, and then complains about their
    // number.
    if text.trim_ascii_start().first() == Some(&b'[') {
        anyhow::bail!(
            "{} is a JSON list, but must be one JSON object: `wildcity import --help` shows an example",
            path.display()
        );
    }
    serde_json::from_slice(&text).with_context(|| format!("cannot read {}", path.display()))
}
