//! Probes a model when it is loaded: its shapes, whether it is deterministic, and its halo.

use crate::error::RepairError;
use crate::halo::{Halo, Probe};
use crate::image::{Image, View};
use crate::manifest::{Fit, Input};
use crate::onnx::Feed;
use crate::planes::{Planes, Rect};
use crate::runner::Runner;
use crate::tiles::Window;

/// The results of the probe.
pub(crate) struct Probed {
    /// Whether three runs gave the same bytes.
    pub(crate) is_deterministic: bool,
    /// The halo, if the fit is `tile`.
    pub(crate) halo: Option<usize>,
}

/// Runs the model on a pattern, and checks shape, NaN, time and repeated bytes; then measures the
/// halo.
pub(crate) fn probe(runner: &Runner) -> Result<Probed, RepairError> {
    let manifest = &runner.manifest;
    let size = &manifest.size;
    let spatial = |input: &Input| (input.role.channels().unwrap_or(0), input.range);
    let probe = Probe {
        inputs: runner.pixel_inputs().map(spatial).collect(),
        multiple_of: size.multiple(),
        fixed: size.fixed.map(|sides| sides.map(|side| side as usize)),
        scale: manifest.output().scale as usize,
    };
    // `scalars` reads nothing of a view but its trust.
    let blank = Image { width: 1, height: 1, rgb8: vec![0; 3] };
    let view = View { trust: Some(0.5), ..View::new(&blank) };
    let scalars = runner.scalars(&view)?;
    // Any size that the model takes will do; a small one keeps the load short.
    let side = 64_usize.next_multiple_of(probe.multiple_of);
    let [height, width] = probe.fixed.unwrap_or([side; 2]);
    let images = probe.images(height, width);

    // Three runs must be equal for the bytes to be called deterministic.
    let first = runner.run(&images, &scalars)?;
    // A model whose output is not finite for an ordinary image is of no use.
    runner.check_finite(&first)?;
    let again = [runner.run(&images, &scalars)?, runner.run(&images, &scalars)?];
    let is_deterministic = again.iter().all(|again| *again == first);
    if size.fit != Fit::Tile {
        return Ok(Probed { is_deterministic, halo: None });
    }

    let halo = match probe.halo(&mut |planes| runner.run(planes, &scalars))? {
        Halo::Pixels(halo) => halo,
        Halo::Whole => {
            let message =
                "an output pixel depends on the whole image, or the model hides NaN".to_owned();
            return Err(RepairError::Tiles { message });
        }
    };
    // A model of a fixed size cannot run on a larger image, with which its tiles would be compared.
    if probe.fixed.is_none() {
        check_tiles(runner, &probe, halo, &scalars)?;
    }
    Ok(Probed { is_deterministic, halo: Some(halo) })
}

/// Compares two tiles in each direction with the whole.
fn check_tiles(
    runner: &Runner,
    probe: &Probe,
    halo: usize,
    scalars: &[Feed],
) -> Result<(), RepairError> {
    let tiling = runner.tiling(halo);
    // One multiple more than a tile: two windows along each axis.
    let [height, width] = tiling.tile.map(|side| side + probe.multiple_of);
    let images = probe.images(height, width);
    let whole = runner.run(&images, scalars)?;
    for Window { seen, used } in tiling.windows(height, width)? {
        let tile: Vec<Planes> = images.iter().map(|planes| planes.crop(seen)).collect();
        let returned = runner.run(&tile, scalars)?;
        let used_out = used.scaled(probe.scale);
        let seen_out = seen.scaled(probe.scale);
        let within = Rect {
            top: used_out.top - seen_out.top,
            left: used_out.left - seen_out.left,
            ..used_out
        };
        // Equal to the bit: a difference means that the halo was too small, or that the kernels
        // depend on the size.
        if returned.crop(within) != whole.crop(used_out) {
            let message = format!("with the measured halo of {halo} px they differ from the whole");
            return Err(RepairError::Tiles { message });
        }
    }
    Ok(())
}
