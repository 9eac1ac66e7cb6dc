//! Encodes a scene in a record format and decodes it again, to measure size and error.

use std::sync::Arc;

use crate::chunk::columns;
use crate::record::{Clamped, PART_GAUSSIANS};
use crate::{Chunk, LanePages, RecordFormat, Scene};

/// The result of [`round_trip`].
#[derive(Clone, Debug)]
pub struct RoundTrip {
    pub scene: Scene,
    /// Size of all encoded parts before compression, in bytes.
    pub coded_bytes: u64,
    /// Number of values that were out of range and clamped.
    pub clamped: u64,
}

/// Encodes every chunk of a scene in parts and decodes them again.
pub fn round_trip(scene: &Scene, record: RecordFormat) -> RoundTrip {
    let empty = Scene { chunks: Vec::new(), ..scene.clone() };
    let mut all = RoundTrip { scene: empty, coded_bytes: 0, clamped: 0 };
    for chunk in &scene.chunks {
        let mut lanes = LanePages::new(columns(chunk.sh_degree()), None);
        let mut clamped = Clamped::default();
        for start in (0..chunk.len()).step_by(PART_GAUSSIANS) {
            let end = (start + PART_GAUSSIANS).min(chunk.len());
            let part = record.encode(chunk, start..end, &mut clamped);
            all.coded_bytes += part.len() as u64;
            record
                .decode(&part, chunk.sh_degree(), end - start, &mut lanes)
                // `decode` fails only for a wrong size.
                .expect("a part has the size that its record just gave it");
        }
        all.clamped += clamped.worst().map_or(0, |(_, count)| count);
        let decoded = Chunk::from_lanes(
            chunk.cell(),
            chunk.origin_m(),
            chunk.sh_degree(),
            chunk.len(),
            lanes,
        );
        let classes = chunk.classes().map(<[_]>::to_vec);
        all.scene.chunks.push(Arc::new(decoded.with_classes(classes)));
    }
    all
}
