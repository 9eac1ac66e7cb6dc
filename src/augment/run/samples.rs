//! Samples of rendered images, and writing them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::mpsc;

use super::view_sessions::Drawn;
use crate::{
    Folder, Place, Sample, SampleFiles, TrainingCamera, counted, depth_mm, mask_png,
    millimetres_png, rgb_png, weight,
};

/// Writes the samples of each received place to the folder, until the channel is closed.
pub(super) fn write_samples(
    mut folder: Folder,
    cameras: &[TrainingCamera],
    mut receiver: mpsc::Receiver<(Place, Vec<Drawn>)>,
    done: &AtomicU64,
) -> anyhow::Result<Folder> {
    while let Some((place, drawn)) = receiver.blocking_recv() {
        for (camera, drawn) in cameras.iter().zip(drawn) {
            let name = place.image_name(&camera.name);
            if !folder.has(&name) {
                let (sample, files) = sample(name, &place, camera, drawn)?;
                folder.put(sample, &files)?;
                done.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
    Ok(folder)
}

/// Makes a sample and its files of a rendered image.
fn sample(
    name: String,
    place: &Place,
    training: &TrainingCamera,
    drawn: Drawn,
) -> anyhow::Result<(Sample, SampleFiles)> {
    let camera = &training.camera;
    let size_px = [camera.width_px, camera.height_px];
    let counts = counted(camera, &drawn.opacity)?;
    let depth_mm = depth_mm(&drawn.depth_m, &counts)?;
    let rendered = rgb_png(&drawn.rendered, size_px)?;
    let (image, rendered) = match &drawn.repaired {
        Some(repaired) => (rgb_png(repaired, size_px)?, Some(rendered)),
        None => (rendered, None),
    };
    let mask = mask_png(&counts, size_px)?;
    let depth = millimetres_png(&depth_mm, size_px)?;
    let counted = counts.iter().filter(|counts| **counts).count() as f64 / counts.len() as f64;
    let sample = Sample {
        name,
        trajectory: place.trajectory.clone(),
        station_m: place.station_m,
        offset_m: place.offset_m,
        camera: training.name.clone(),
        world_from_camera: place.world_from_rig * training.rig_from_camera,
        trust: drawn.trust,
        weight: weight(drawn.trust),
        counted,
        repair: drawn.repair,
        files: BTreeMap::new(),
    };
    Ok((sample, SampleFiles { image, rendered, mask, depth }))
}
