//! Decoding of the binary frame. Tensors are read in place, without a copy, where that is possible.

use std::borrow::Cow;
use std::cmp::Reverse;

use safetensors::{Dtype, SafeTensors, tensor::Metadata};
use tokio_tungstenite::tungstenite::Bytes;

use wildcity_protocol::limits::{HISTORY_POSES, OBSERVATION_HEADER_BYTES};
use wildcity_protocol::message::Encoding;
use wildcity_protocol::observation::{self as wire, ObservationMetadata};

use crate::decode::{self, DecodeError};
use crate::error::FrameError;

const HISTORY_XYZ: &str = "ego.history_xyz";
const HISTORY_ROT: &str = "ego.history_rot";
const IMU: &str = "sensor.imu";
const WHEEL_SPEED: &str = "sensor.wheel_speed";

/// An observation of the ego at one time: metadata, images, and the ego's past poses.
///
/// [`Observation::decode`] checks everything except the contents of JPEG and PNG files, which are
/// decoded on demand by [`ImageView::rgb`], and the hashes, which [`Observation::verify`] compares.
///
/// ```
/// use wildcity_client::Observation;
///
/// let frame = include_bytes!("../../../protocol/vectors/observations/raw.bin");
/// let observation = Observation::decode(frame.to_vec())?;
/// assert_eq!(observation.metadata().step, 2);
/// let image = observation.camera("front").expect("this camera is in the frame");
/// assert_eq!((image.metadata().width, image.metadata().height), (4, 3));
/// // The top left pixel: red, green, blue.
/// assert_eq!(image.rgb()?[..3], [10, 5, 3]);
/// observation.verify()?;
/// # Ok::<(), wildcity_client::FrameError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Observation {
    metadata: ObservationMetadata,
    tensors: Metadata,
    /// Offset of the first tensor's bytes in `frame`.
    data_start: usize,
    frame: Bytes,
}

/// One image of an observation.
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    observation: &'a Observation,
    metadata: &'a wire::Image,
}

impl Observation {
    /// Decodes a binary frame.
    ///
    /// # Errors
    /// The frame is not in safetensors layout, or a tensor is missing or differs from the metadata.
    pub fn decode(frame: impl Into<Bytes>) -> Result<Self, FrameError> {
        let frame = frame.into();
        check_header_length(&frame)?;
        let (header_bytes, tensors) =
            SafeTensors::read_metadata(&frame).map_err(FrameError::Layout)?;
        let texts = tensors.metadata().as_ref();
        let text =
            texts.and_then(|texts| texts.get("observation")).ok_or(FrameError::NoObservation)?;
        let metadata = serde_json::from_str(text).map_err(FrameError::Observation)?;
        // A safetensors file begins with the length of its header, in eight bytes.
        let data_start = size_of::<u64>() + header_bytes;
        let observation = Self { metadata, tensors, data_start, frame };
        observation.check_tensors()?;
        Ok(observation)
    }

    /// All values of the observation except its tensors.
    pub fn metadata(&self) -> &ObservationMetadata {
        &self.metadata
    }

    /// The frame as it was received.
    pub fn frame(&self) -> &Bytes {
        &self.frame
    }

    /// Image number `index`, in the order of `metadata().images`.
    pub fn image(&self, index: usize) -> Option<ImageView<'_>> {
        self.metadata.images.get(index).map(|metadata| self.view(metadata))
    }

    /// The image of a camera. If the observation has several poses, that of the first one.
    pub fn camera(&self, name: &str) -> Option<ImageView<'_>> {
        self.images().find(|image| image.metadata.camera == name)
    }

    /// All images of this time, in order.
    pub fn images(&self) -> impl Iterator<Item = ImageView<'_>> {
        self.metadata.images.iter().map(|metadata| self.view(metadata))
    }

    /// The last frames of a camera, oldest first: as many as `outputs.frames` asked for, fewer at
    /// the start of an episode, and none between two decisions.
    pub fn frames(&self, camera: &str) -> Vec<ImageView<'_>> {
        let current = self.metadata.images.iter().filter(|image| image.pose == 0);
        let mut frames: Vec<_> = current
            .chain(&self.metadata.history)
            .filter(|image| image.camera == camera)
            .map(|metadata| self.view(metadata))
            .collect();
        frames.sort_by_key(|frame| Reverse(frame.metadata.back));
        frames
    }

    /// Past positions of the rig, f32 `[16, 3]`, in metres in the current rig frame: oldest first,
    /// 0.1 s apart. The last one is now, which is zero.
    pub fn history_xyz_m(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(HISTORY_XYZ))
    }

    /// Past rotations `rig(now)_from_rig(then)`, f32 `[16, 3, 3]`, row by row: oldest first, 0.1 s
    /// apart. The last one is now, which is the identity.
    pub fn history_rot(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(HISTORY_ROT))
    }

    /// Samples of the inertial measurement unit, f32 `[n, 6]`: specific force in m/s² and angular
    /// velocity in rad/s, in the rig's axes, for each step since the previous observation. Empty
    /// unless the session asked for it.
    pub fn imu(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(IMU))
    }

    /// Speed in m/s as the wheels measured it, f32 `[n]`, at the times of [`Self::imu`]. Empty
    /// unless the session asked for it.
    pub fn wheel_speed(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(WHEEL_SPEED))
    }

    /// Compares the hash of each lossless image, earlier frames included, with its pixels, and the
    /// frame hash with the images' hashes. JPEG images are skipped: they are hashed before
    /// encoding, and JPEG changes their pixels.
    ///
    /// # Errors
    /// The first hash that differs, or the first image that cannot be decoded.
    pub fn verify(&self) -> Result<(), FrameError> {
        for metadata in &self.metadata.history {
            self.view(metadata).verify()?;
        }
        let mut frame_hasher = blake3::Hasher::new();
        for image in self.images() {
            image.verify()?;
            let text = &image.metadata.hash;
            // A text that is not a hash equals no hash.
            let hash = blake3::Hash::from_hex(text).map_err(|_| FrameError::Hash {
                name: image.metadata.tensor.clone(),
                found: text.clone(),
                expected: "64 hex digits".to_owned(),
            })?;
            // Of the images' hashes and not of their pixels, so that it can be compared for JPEG
            // images, too.
            frame_hasher.update(hash.as_bytes());
        }
        let found = frame_hasher.finalize().to_hex().to_string();
        compare_hashes("frame_hash", found, &self.metadata.frame_hash)
    }

    fn view<'a>(&'a self, metadata: &'a wire::Image) -> ImageView<'a> {
        ImageView { observation: self, metadata }
    }

    /// Checks that every tensor that the metadata names exists, with the type and shape that it
    /// must have.
    fn check_tensors(&self) -> Result<(), FrameError> {
        self.check_tensor(HISTORY_XYZ, Dtype::F32, &[HISTORY_POSES, 3])?;
        self.check_tensor(HISTORY_ROT, Dtype::F32, &[HISTORY_POSES, 3, 3])?;
        // These exist only if the session asked for them.
        for (name, columns) in [(IMU, &[6][..]), (WHEEL_SPEED, &[])] {
            if let Some(info) = self.tensors.info(name) {
                // The number of samples is that of the steps since the last observation: any is
                // right.
                let samples = info.shape.first().copied().unwrap_or_default();
                self.check_tensor(name, Dtype::F32, &[&[samples], columns].concat())?;
            }
        }
        for metadata in self.metadata.images.iter().chain(&self.metadata.history) {
            let image = self.view(metadata);
            let [width, height] = image.size();
            match metadata.encoding {
                Encoding::Raw => {
                    self.check_tensor(&metadata.tensor, Dtype::U8, &[height, width, 3])?;
                }
                Encoding::Jpeg | Encoding::Png => self.check_file(&metadata.tensor)?,
            }
            // These exist only if the session asked for them.
            let maps: [(&str, &[usize]); 3] = [
                ("depth", &[height, width]),
                ("opacity", &[height, width]),
                ("normals", &[height, width, 3]),
            ];
            for (output, shape) in maps {
                let name = image.sibling_tensor(output);
                if self.tensors.info(&name).is_some() {
                    self.check_tensor(&name, Dtype::F32, shape)?;
                }
            }
            let name = image.sibling_tensor("instances");
            if self.tensors.info(&name).is_some() {
                self.check_tensor(&name, Dtype::U16, &[height, width])?;
            }
            let name = image.sibling_tensor("semantics");
            if self.tensors.info(&name).is_some() {
                self.check_tensor(&name, Dtype::U8, &[height, width])?;
            }
        }
        Ok(())
    }

    fn check_tensor(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<(), FrameError> {
        let info = self.tensors.info(name).ok_or_else(|| missing(name))?;
        if info.dtype == dtype && info.shape == shape {
            return Ok(());
        }
        Err(FrameError::Tensor {
            name: name.to_owned(),
            found: format!("{} {:?}", info.dtype, info.shape),
            expected: format!("{dtype} {shape:?}"),
        })
    }

    /// Checks that the tensor of a JPEG or PNG file is one-dimensional bytes, of any length.
    fn check_file(&self, name: &str) -> Result<(), FrameError> {
        let info = self.tensors.info(name).ok_or_else(|| missing(name))?;
        // The size of a compressed file is not known beforehand: only that it has one dimension.
        let bytes = info.shape.iter().product();
        self.check_tensor(name, Dtype::U8, &[bytes])
    }

    /// The bytes of a tensor that [`Observation::check_tensors`] checked; empty if there is no such
    /// tensor.
    fn tensor_bytes(&self, name: &str) -> &[u8] {
        let Some(info) = self.tensors.info(name) else { return &[] };
        let (start, end) = info.data_offsets;
        &self.frame[self.data_start + start..self.data_start + end]
    }
}

impl<'a> ImageView<'a> {
    /// Camera, size, intrinsics, times and hash of the image.
    pub fn metadata(&self) -> &'a wire::Image {
        self.metadata
    }

    /// The image as it was received: raw pixels, or a JPEG or PNG file.
    pub fn encoded(&self) -> &'a [u8] {
        self.observation.tensor_bytes(&self.metadata.tensor)
    }

    /// Pixels, u8 `[height, width, 3]`: red, green, blue, row by row from the top left. Raw images
    /// are returned in place, the others are decoded by every call.
    ///
    /// # Errors
    /// The JPEG or PNG file cannot be decoded, or its size differs from the metadata.
    pub fn rgb(&self) -> Result<Cow<'a, [u8]>, FrameError> {
        let size = self.size();
        let decoded = match self.metadata.encoding {
            Encoding::Raw => return Ok(Cow::Borrowed(self.encoded())),
            Encoding::Jpeg => decode::jpeg(self.encoded(), size),
            Encoding::Png => decode::png(self.encoded(), size),
        };
        let name = &self.metadata.tensor;
        decoded.map(Cow::Owned).map_err(|error| match error {
            DecodeError::Invalid(reason) => FrameError::Image { name: name.clone(), reason },
            DecodeError::Size([width, height]) => FrameError::Tensor {
                name: name.clone(),
                found: format!("an image of {width}x{height} px"),
                expected: format!("{}x{} px", size[0], size[1]),
            },
        })
    }

    /// Depth in metres, f32 `[height, width]`, 0 where the opacity is 0: camera z, or distance for
    /// wide lenses. `None` if the session did not ask for it.
    pub fn depth_m(&self) -> Option<Cow<'a, [f32]>> {
        self.map("depth")
    }

    /// Accumulated opacity, 0 to 1, f32 `[height, width]`. `None` if the session did not ask for
    /// it.
    pub fn opacity(&self) -> Option<Cow<'a, [f32]>> {
        self.map("opacity")
    }

    /// Unit normals of the visible surface in camera axes (x right, y down, z forward), f32
    /// `[height, width, 3]`, 0 where there is no depth. `None` if the session did not ask for it.
    pub fn normals(&self) -> Option<Cow<'a, [f32]>> {
        self.map("normals")
    }

    /// Whose Gaussian each pixel shows, u16 `[height, width]`: 0 none, 1 the twin, else the
    /// [`Actor::instance`](wildcity_protocol::observation::Actor::instance) of an actor. `None` if
    /// the session did not ask for it.
    pub fn instances(&self) -> Option<Vec<u16>> {
        let name = self.sibling_tensor("instances");
        self.observation.tensors.info(&name)?;
        let bytes = self.observation.tensor_bytes(&name);
        Some(bytes.chunks_exact(2).map(|two| u16::from_le_bytes([two[0], two[1]])).collect())
    }

    /// The class of the Gaussian that each pixel shows, u8 `[height, width]`: an index of
    /// [`OpenedSemantics::classes`](wildcity_protocol::message::OpenedSemantics::classes). `None`
    /// if the session did not ask for it.
    pub fn semantics(&self) -> Option<&'a [u8]> {
        let name = self.sibling_tensor("semantics");
        self.observation.tensors.info(&name)?;
        Some(self.observation.tensor_bytes(&name))
    }

    /// Width and height, in pixels.
    fn size(&self) -> [usize; 2] {
        [self.metadata.width, self.metadata.height]
            // A size that does not fit equals the shape of no tensor, and so is refused.
            .map(|side_px| usize::try_from(side_px).unwrap_or(usize::MAX))
    }

    fn map(&self, output: &str) -> Option<Cow<'a, [f32]>> {
        let name = self.sibling_tensor(output);
        self.observation.tensors.info(&name)?;
        Some(floats(self.observation.tensor_bytes(&name)))
    }

    /// Compares the pixels of a lossless image with its hash.
    fn verify(&self) -> Result<(), FrameError> {
        if self.metadata.encoding == Encoding::Jpeg {
            return Ok(());
        }
        let found = blake3::hash(&self.rgb()?).to_hex().to_string();
        compare_hashes(&self.metadata.tensor, found, &self.metadata.hash)
    }

    /// Name of another tensor of the same image: `camera/front/rgb` and `depth` give
    /// `camera/front/depth`.
    fn sibling_tensor(&self, output: &str) -> String {
        let tensor = &self.metadata.tensor;
        format!("{}{output}", tensor.strip_suffix("rgb").unwrap_or(tensor))
    }
}

/// Refuses a long header before anything is allocated for it. A frame that is too short to have a
/// length is refused later, with the rest of the layout.
pub(crate) fn check_header_length(frame: &[u8]) -> Result<(), FrameError> {
    let limit = OBSERVATION_HEADER_BYTES;
    match frame.first_chunk().map(|length| u64::from_le_bytes(*length)) {
        Some(bytes) if bytes > limit => Err(FrameError::HeaderTooLong { bytes, limit }),
        _ => Ok(()),
    }
}

fn missing(name: &str) -> FrameError {
    FrameError::Missing { name: name.to_owned() }
}

fn compare_hashes(name: &str, found: String, expected: &str) -> Result<(), FrameError> {
    if found == expected {
        return Ok(());
    }
    Err(FrameError::Hash { name: name.to_owned(), found, expected: expected.to_owned() })
}

/// Little-endian floats: in place if the machine is little-endian and the bytes are aligned to 4,
/// otherwise copied. Bytes after a JPEG of odd length are not aligned.
fn floats(bytes: &[u8]) -> Cow<'_, [f32]> {
    // The cast fails if the bytes are not aligned, or no multiple of four.
    match bytemuck::try_cast_slice(bytes) {
        Ok(floats) if cfg!(target_endian = "little") => Cow::Borrowed(floats),
        _ => Cow::Owned(
            bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
        ),
    }
}
