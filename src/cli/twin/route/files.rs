//! Files of the route commands.

use std::path::Path;

use anyhow::Context;

use crate::cli::limits;
use wildcity_scene::Trajectory;
use wildcity_twin::ingest;

/// Reads the times of another clock: a JSON list of whole microseconds.
pub(super) fn read_times_us(path: &Path) -> anyhow::Result<Vec<i64>> {
    let text = ingest::read_whole(path, limits::SETTINGS_FILE_BYTES)
        .with_context(|| format!("--times {}", path.display()))?;
    serde_json::from_slice(&text).with_context(|| {
        format!(
            "--times {}: expected a JSON list of whole microseconds, for example [0, 100000]",
            path.display()
        )
    })
}

/// A drive as the text of its JSON file.
pub(super) fn to_json(trajectory: &Trajectory) -> anyhow::Result<Vec<u8>> {
    let mut text = serde_json::to_vec(trajectory)?;
    text.push(b'\n');
    Ok(text)
}
