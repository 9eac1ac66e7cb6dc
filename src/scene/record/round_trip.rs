//! What a record makes of a scene, and how many bytes it takes.

use std::sync::Arc;

use crate::chunk::{LANES, Lanes, columns};
use crate::record::{Clamped, PART_GAUSSIANS};
use crate::{Chunk, RecordFormat, Scene};

/// A scene as it comes out of a record.
#[derive(Clone, Debug)]
pub struct RoundTrip {
    /// The scene.
    pub scene: Scene,
    /// Bytes of all parts, as coded.
    pub coded_bytes: u64,
    /// Values that did not fit, and were clamped.
    pub clamped: u64,
}

/// Codes every chunk of a scene in parts, and decodes them again.
pub fn round_trip(scene: &Scene, record: RecordFormat) -> RoundTrip {
    let empty = Scene { chunks: Vec::new(), sky: scene.sky.clone() };
    let mut all = RoundTrip { scene: empty, coded_bytes: 0, clamped: 0 };
    for chunk in &scene.chunks {
        let mut lanes = vec![Lanes([0.0; LANES]); chunk.len().div_ceil(LANES) * width(chunk)];
        let mut clamped = Clamped::default();
        for start in (0..chunk.len()).step_by(PART_GAUSSIANS) {
            let end = (start + PART_GAUSSIANS).min(chunk.len());
            let part = record.encode(chunk, start..end, &mut clamped);
            all.coded_bytes += part.len() as u64;
            let own = start / LANES * width(chunk)..end.div_ceil(LANES) * width(chunk);
            record
                .decode(&part, chunk.sh_degree(), end - start, &mut lanes[own])
                .expect("a part has the size that its record just gave it");
        }
        all.clamped += clamped.worst().map_or(0, |(_, count)| count);
        let (cell, origin_m, degree) = (chunk.cell(), chunk.origin_m(), chunk.sh_degree());
        let again = Chunk::from_lanes(cell, origin_m, degree, chunk.len(), lanes);
        all.scene.chunks.push(Arc::new(again));
    }
    all
}

fn width(chunk: &Chunk) -> usize {
    columns(chunk.sh_degree())
}
