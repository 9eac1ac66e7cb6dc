//! Closes an observation: appends what was encoded, names the tensors, and updates the frame
//! history.

use std::mem;

use super::ObservationBuilder;
use super::repair::ObservationRepair;
use crate::error::SessionError;
use crate::limits;
use crate::observe::encode::{EncodedImage, ImageEncoding, PixelMaps};
use crate::observe::frame_history::{FrameHistory, PastFrame};
use crate::observe::layout::RigCapture;
use crate::observe::observation::{
    DType, ImageInfo, Observation, PastImageInfo, ResidencyStats, Tensor, TensorKind,
};
use crate::observe::trust::Trust;
use crate::repair::status::{ImageRepair, RepairState};
use crate::sensors::delivery::Delivery;
use crate::sensors::{ImageSensor, SensorReason};
use wildcity_options::CameraSensor;

/// A finished observation, and the data of it that its record and later observations need.
pub(crate) struct RenderedObservation {
    pub(crate) observation: Observation,
    /// The history after this observation; empty if it was built without one.
    pub(crate) frame_history: FrameHistory,
    /// The rendered captures, in order.
    pub(crate) captures: Vec<RigCapture>,
    /// The hash of each rendered image.
    pub(crate) hashes: Vec<blake3::Hash>,
    /// Result of the repair of each rendered image; empty unless the session asked for repair.
    pub(crate) repairs: Vec<ImageRepair>,
    /// State of the repair after this observation. `None` without repair, and for poses that the
    /// ego is not at.
    pub(crate) repair_state: Option<RepairState>,
    trusts: Vec<Option<Trust>>,
}

impl RenderedObservation {
    /// The trusts of the rendered images, including images that only later observations show. Empty
    /// if the session's images come without trust.
    pub(crate) fn trusts(&self) -> impl Iterator<Item = f64> {
        self.trusts.iter().flatten().map(|trust| trust.value)
    }
}

impl ObservationBuilder {
    /// Appends the encoded images and the earlier frames that the history has, and names every
    /// tensor.
    ///
    /// `history` has the frames of all earlier observations. Without it, as for `observe`, the
    /// observation shows no earlier frames.
    pub(crate) fn finish(
        mut self,
        history: Option<FrameHistory>,
        held_bytes: u64,
        limit_bytes: u64,
    ) -> Result<RenderedObservation, SessionError> {
        // Files are appended in the order in which the tensors are named: those of now, and then
        // those of earlier times.
        let shown = self.shown_images();
        self.append_files(&shown)?;
        let mut tensors = self.name_tensors(&shown);

        let mut frame_history = FrameHistory::default();
        let mut past_images = Vec::new();
        if let Some(history) = history {
            frame_history = history;
            past_images = self.append_earlier_frames(&mut frame_history, &mut tensors)?;
        }

        let mut images: Vec<ImageInfo> = shown.into_iter().map(|image| image.info).collect();
        // A client expects them by pose and camera; the captures come by time.
        images.sort_by_key(|image| [image.pose, image.camera]);
        let hashes = images.iter().map(|image| image.hash);
        let frame_hash = frame_hash(hashes.chain(self.sweeps.iter().map(|sweep| sweep.hash)));
        Ok(RenderedObservation {
            observation: Observation {
                buffer: self.buffer,
                tensors: tensors.list,
                images,
                sweeps: self.sweeps,
                history: past_images,
                frame_hash,
                history_count: self.history_count,
                timings: self.timings,
                residency: ResidencyStats { held_bytes, limit_bytes, ..self.residency },
            },
            frame_history,
            captures: self.captures,
            hashes: self.encoded.iter().map(|image| image.hash).collect(),
            repairs: self.encoded.iter().filter_map(|image| image.repair.clone()).collect(),
            repair_state: self.repair.and_then(ObservationRepair::into_state),
            trusts: self.encoded.iter().map(|image| image.trust).collect(),
        })
    }

    /// The images of the captures that the observation shows now.
    fn shown_images(&self) -> Vec<ShownImage> {
        let mut shown = Vec::new();
        let mut encoded = 0;
        let mut pose = 0;
        for capture in &self.captures {
            for &camera in &capture.cameras {
                // Images that are not shown were encoded too, so that the index counts them.
                if capture.shown {
                    let EncodedImage { hash, trust, ref repair, .. } = self.encoded[encoded];
                    let repair = repair.clone();
                    let (time_us, sensor) = self.delivered(capture, camera, encoded);
                    shown.push(ShownImage {
                        info: ImageInfo { camera, pose, time_us, hash, trust, repair, sensor },
                        encoded,
                    });
                }
                encoded += 1;
            }
            // A step has one pose, even if a camera shows a picture that was taken from another.
            // `observe` has a pose for each capture.
            pose += usize::from(capture.shown && !capture.has_sensor_effects);
        }
        shown
    }

    /// When an image was taken by its camera's clock, in microseconds, and the effects of the
    /// camera on it.
    fn delivered(
        &self,
        capture: &RigCapture,
        camera: usize,
        encoded: usize,
    ) -> (i64, Option<ImageSensor>) {
        // Without effects, a picture is taken when its capture is.
        if !capture.has_sensor_effects || self.layout.sensor(camera).is_none() {
            return (capture.time_us, None);
        }
        let Delivery { stamp_us, taken_us, missing } =
            self.layout.delivery(camera, self.effect_seed, capture.due_us);
        let has_effects = |sensor: &CameraSensor| {
            [
                missing,
                // A picture from before its stamp is one that the camera repeats.
                (taken_us < stamp_us).then_some(SensorReason::Frozen),
                sensor.noise.map(|_| SensorReason::Noise),
                sensor.exposure.map(|_| SensorReason::Exposure),
                sensor.dirt.map(|_| SensorReason::Dirt),
            ]
        };
        let reasons = self.layout.sensor(camera).map_or([None; 5], has_effects);
        let effects = self.encoded[encoded].effects;
        let sensor = ImageSensor {
            due_us: capture.due_us,
            taken_us,
            reasons,
            stops: effects.and_then(|effects| effects.stops),
            clean_hash: effects.map(|effects| effects.clean_hash),
        };
        (stamp_us, Some(sensor))
    }

    /// Appends the files of the shown images. Raw pixels are in the buffer already.
    fn append_files(&mut self, shown: &[ShownImage]) -> Result<(), SessionError> {
        let files: Vec<&[u8]> = match self.layout.encoding() {
            ImageEncoding::Raw => Vec::new(),
            ImageEncoding::Jpeg(_) | ImageEncoding::Png => {
                shown.iter().map(|image| &self.encoded[image.encoded].file[..]).collect()
            }
        };
        self.buffer.append(&files)
    }

    /// The tensors of the ego history and of the shown images, in the order of the buffer.
    fn name_tensors(&self, shown: &[ShownImage]) -> TensorList {
        let layout = &self.layout;
        let mut tensors = TensorList { list: Vec::new(), end: 0 };
        let poses = limits::HISTORY_POSES;
        tensors.push(TensorKind::HistoryXyz, DType::F32, vec![poses, 3]);
        tensors.push(TensorKind::HistoryRotation, DType::F32, vec![poses, 3, 3]);
        let [imu, wheel_speed] = self.motion_samples;
        if let Some(samples) = imu {
            tensors.push(TensorKind::Imu, DType::F32, vec![samples, 6]);
        }
        if let Some(samples) = wheel_speed {
            tensors.push(TensorKind::WheelSpeed, DType::F32, vec![samples]);
        }
        for (index, sweep) in self.sweeps.iter().enumerate() {
            tensors.push(TensorKind::Points(index), DType::F32, vec![sweep.returns, 3]);
            tensors.push(TensorKind::Intensity(index), DType::F32, vec![sweep.returns]);
        }
        let PixelMaps { depth, opacity, normals, instances, semantics } = layout.maps();
        // Each with its place among the images.
        // At most 256 images: to compare all pairs is cheap.
        let place = |image: &ShownImage| {
            let key = |one: &ShownImage| [one.info.pose, one.info.camera];
            // Pose and camera are unique, so that the number of smaller ones is the place.
            shown.iter().filter(|other| key(other) < key(image)).count()
        };
        let placed: Vec<(usize, &ShownImage)> =
            shown.iter().map(|image| (place(image), image)).collect();
        // Floats of all images, then instances, then bytes: by falling size, so that each tensor is
        // aligned without gaps.
        for &(index, image) in &placed {
            let [height, width] = layout.size_px(image.info.camera);
            if depth {
                tensors.push(TensorKind::Depth(index), DType::F32, vec![height, width]);
            }
            if opacity {
                tensors.push(TensorKind::Opacity(index), DType::F32, vec![height, width]);
            }
            if normals {
                tensors.push(TensorKind::Normals(index), DType::F32, vec![height, width, 3]);
            }
        }
        for (index, sweep) in self.sweeps.iter().enumerate() {
            for kind in [TensorKind::Rows, TensorKind::Columns, TensorKind::PointInstances] {
                tensors.push(kind(index), DType::U16, vec![sweep.returns]);
            }
        }
        for &(index, image) in placed.iter().filter(|_| instances) {
            let [height, width] = layout.size_px(image.info.camera);
            tensors.push(TensorKind::Instances(index), DType::U16, vec![height, width]);
        }
        for (index, sweep) in self.sweeps.iter().enumerate().filter(|_| semantics) {
            tensors.push(TensorKind::PointClasses(index), DType::U8, vec![sweep.returns]);
        }
        for &(index, image) in placed.iter().filter(|_| semantics) {
            let [height, width] = layout.size_px(image.info.camera);
            tensors.push(TensorKind::Semantics(index), DType::U8, vec![height, width]);
        }
        for &(index, image) in &placed {
            let file_bytes = self.encoded[image.encoded].file.len();
            let shape = layout.colour_shape(image.info.camera, file_bytes);
            tensors.push(TensorKind::Rgb(index), DType::U8, shape);
        }
        tensors
    }

    /// Moves the images that later observations show into the history, appends images of earlier
    /// times that this one shows, and drops images from the history that no later one shows.
    fn append_earlier_frames(
        &mut self,
        history: &mut FrameHistory,
        tensors: &mut TensorList,
    ) -> Result<Vec<PastImageInfo>, SessionError> {
        // Without a capture there is no time, and nothing that could be kept.
        let Some(now_us) = self.captures.last().map(|capture| capture.due_us) else {
            return Ok(Vec::new());
        };
        let mut index = 0;
        for capture in &self.captures {
            for &camera in &capture.cameras {
                if self.layout.is_shown_later(capture, camera) {
                    let (time_us, sensor) = self.delivered(capture, camera, index);
                    let EncodedImage { hash, trust, ref repair, .. } = self.encoded[index];
                    let repair = repair.clone();
                    // Moved and not copied: if this observation shows the image too, its file was
                    // appended above.
                    let bytes = mem::take(&mut self.encoded[index].file);
                    let due_us = capture.due_us;
                    let frame =
                        PastFrame { camera, due_us, time_us, hash, trust, repair, sensor, bytes };
                    history.add(&self.budget, frame)?;
                }
                index += 1;
            }
        }
        let layout = &self.layout;

        let mut past_images = Vec::new();
        if layout.schedule().is_decision(now_us) {
            let earlier = layout.earlier_frames(history, now_us);
            // Earlier frames come after all images of now.
            let files: Vec<&[u8]> = earlier.iter().map(|one| &one.frame.bytes[..]).collect();
            self.buffer.append(&files)?;
            for (index, one) in earlier.iter().enumerate() {
                let PastFrame {
                    camera, time_us, hash, trust, sensor, ref repair, ref bytes, ..
                } = *one.frame;
                let repair = repair.clone();
                let shape = layout.colour_shape(camera, bytes.len());
                tensors.push(TensorKind::PastRgb(index), DType::U8, shape);
                let back = one.back;
                past_images.push(PastImageInfo {
                    camera,
                    back,
                    time_us,
                    hash,
                    trust,
                    repair,
                    sensor,
                });
            }
        }
        // After they were shown: frames that only this decision needed go now.
        history.drop_unneeded(layout.schedule(), now_us);
        Ok(past_images)
    }
}

/// An image that the observation shows, and its index among the encoded ones.
struct ShownImage {
    info: ImageInfo,
    encoded: usize,
}

/// Tensors that lie one after the other.
struct TensorList {
    list: Vec<Tensor>,
    end: usize,
}

impl TensorList {
    fn push(&mut self, kind: TensorKind, dtype: DType, shape: Vec<usize>) {
        let bytes = shape.iter().product::<usize>() * dtype.bytes();
        let start = self.end;
        self.end += bytes;
        self.list.push(Tensor { kind, dtype, shape, bytes: start..self.end });
    }
}

/// The hash of a frame: BLAKE3 of the hashes of its images and sweeps, in order.
fn frame_hash(images: impl Iterator<Item = blake3::Hash>) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    for hash in images {
        hasher.update(hash.as_bytes());
    }
    hasher.finalize()
}
