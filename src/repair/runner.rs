//! Runs the graph of a model on planes, and checks the shape that comes back.

use std::time::Duration;

use parking_lot::Mutex;

use crate::error::RepairError;
use crate::image::View;
use crate::manifest::{Input, InputRole, Layout, Manifest};
use crate::onnx::{Feed, Worker};
use crate::planes::Planes;
use crate::roles;
use crate::signature;
use crate::tiles::Tiling;

/// A manifest and the worker that runs its graph, one image at a time.
pub(crate) struct Runner {
    pub(crate) manifest: Manifest,
    worker: Mutex<Worker>,
}

impl Runner {
    pub(crate) fn new(manifest: Manifest, worker: Worker) -> Self {
        Self { manifest, worker: Mutex::new(worker) }
    }

    /// Whether the model is withdrawn: no run will succeed any more.
    pub(crate) fn is_withdrawn(&self) -> bool {
        self.worker.lock().is_withdrawn()
    }

    /// The inputs that have pixels.
    pub(crate) fn pixel_inputs(&self) -> impl Iterator<Item = &Input> {
        self.manifest.inputs.iter().filter(|input| input.role.channels().is_some())
    }

    pub(crate) fn scalars(&self, view: &View<'_>) -> Result<Vec<Feed>, RepairError> {
        let inputs = self.manifest.inputs.iter().filter(|input| input.role.channels().is_none());
        let feed = |input: &Input| {
            let shape: Vec<i64> = match input.role {
                // A batch of one.
                InputRole::Trust => vec![1, 1],
                _ => input.shape.iter().map(|side| i64::from(*side)).collect(),
            };
            // The product of no sides is 1: a scalar. `check_inputs` bounds it.
            let count = shape.iter().product::<i64>() as usize;
            let values = vec![roles::scalar(view, input)?; count];
            Ok(Feed { name: input.name.clone(), shape, dtype: input.dtype, values })
        };
        inputs.map(feed).collect()
    }

    /// The sizes with which images are cut into windows, with a halo in pixels.
    pub(crate) fn tiling(&self, halo: usize) -> Tiling {
        let size = &self.manifest.size;
        // Without a tile the whole image is one window.
        let tile = size.fixed.or(size.tile).unwrap_or([u32::MAX; 2]).map(|side| side as usize);
        Tiling { tile, multiple_of: size.multiple(), halo }
    }

    /// Runs the graph on planes that have a size it takes, and checks the shape of the output.
    pub(crate) fn run(&self, planes: &[Planes], scalars: &[Feed]) -> Result<Planes, RepairError> {
        let layout = self.manifest.layout;
        let mut feeds = scalars.to_vec();
        for (input, planes) in self.pixel_inputs().zip(planes) {
            let sides = [planes.height as i64, planes.width as i64];
            feeds.push(Feed {
                name: input.name.clone(),
                shape: signature::image_shape(layout, planes.channels as i64, sides),
                dtype: input.dtype,
                values: to_layout(planes, layout),
            });
        }
        let output = self.manifest.output();
        let scale = output.scale as usize;
        let channels = output.role.channels();
        let height = planes[0].height * scale;
        let width = planes[0].width * scale;
        let limit = Duration::from_millis(self.manifest.timeout_ms);
        // Held for the run only; a second image waits here.
        let mut worker = self.worker.lock();
        let returned = worker.run(feeds, &output.name, limit)?;
        drop(worker);
        let wanted = signature::image_shape(layout, channels as i64, [height as i64, width as i64]);
        if returned.shape != wanted {
            return Err(RepairError::Shape {
                output: output.name.clone(),
                wanted,
                found: returned.shape,
            });
        }
        Ok(from_layout(returned.values, channels, [height, width], layout))
    }

    pub(crate) fn check_finite(&self, output: &Planes) -> Result<(), RepairError> {
        let count = output.values.iter().filter(|value| !value.is_finite()).count();
        if count == 0 {
            return Ok(());
        }
        let name = self.manifest.output().name.clone();
        Err(RepairError::NotFinite { output: name, count, of: output.values.len() })
    }
}

fn to_layout(planes: &Planes, layout: Layout) -> Vec<f32> {
    if layout == Layout::Nchw {
        return planes.values.clone();
    }
    let pixels = planes.height * planes.width;
    let channels = planes.channels;
    // Place `at` of the interleaved image is channel at % channels of pixel at / channels.
    (0..pixels * channels).map(|at| planes.values[at % channels * pixels + at / channels]).collect()
}

fn from_layout(
    values: Vec<f32>,
    channels: usize,
    [height, width]: [usize; 2],
    layout: Layout,
) -> Planes {
    if layout == Layout::Nchw {
        return Planes { channels, height, width, values };
    }
    let pixels = height * width;
    let planar =
        // The other way: place `at` of the planes is pixel at % pixels of channel at / pixels.
        (0..pixels * channels).map(|at| values[at % pixels * channels + at / pixels]).collect();
    Planes { channels, height, width, values: planar }
}
