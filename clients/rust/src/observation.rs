//! Decoding the binary frame, without copying what can be read in place.

use std::borrow::Cow;
use std::io::Cursor;

use image::{ImageFormat, ImageReader, Limits};
use safetensors::{Dtype, SafeTensors, tensor::Metadata};
use tokio_tungstenite::tungstenite::Bytes;

use wildcity_protocol::message::Encoding;
use wildcity_protocol::observation as wire;

use super::error::FrameError;

/// What the ego sees: the decoded metadata, and the frame with the tensors in it.
///
/// Everything is checked on arrival but the contents of JPEG and PNG files, which are decoded when
/// asked for, and hashes, which are compared by [`Observation::verify`].
#[derive(Clone, Debug)]
pub struct Observation {
    metadata: wire::ObservationMetadata,
    tensors: Metadata,
    /// Where tensor bytes start in `frame`.
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
    /// Reads a binary frame.
    ///
    /// # Errors
    /// The frame is not in safetensors layout, or its tensors are not what its metadata says.
    pub fn decode(frame: impl Into<Bytes>) -> Result<Self, FrameError> {
        let frame = frame.into();
        check_header_length(&frame)?;
        let (header_bytes, tensors) =
            SafeTensors::read_metadata(&frame).map_err(FrameError::Layout)?;
        let text = tensors.metadata().as_ref().and_then(|m| m.get("observation"));
        let metadata = serde_json::from_str(text.ok_or(FrameError::NoObservation)?)
            .map_err(FrameError::Observation)?;
        let data_start = size_of::<u64>() + header_bytes;
        let observation = Self { metadata, tensors, data_start, frame };
        observation.check()?;
        Ok(observation)
    }

    /// What the observation says beside its tensors.
    pub fn metadata(&self) -> &wire::ObservationMetadata {
        &self.metadata
    }

    /// The frame as it came.
    pub fn frame(&self) -> &Bytes {
        &self.frame
    }

    /// Image `k`, in the order of `metadata().images`.
    pub fn image(&self, k: usize) -> Option<ImageView<'_>> {
        self.metadata.images.get(k).map(|metadata| ImageView { observation: self, metadata })
    }

    /// The image of a camera; of the first pose, if there are several.
    pub fn camera(&self, name: &str) -> Option<ImageView<'_>> {
        self.images().find(|image| image.metadata.camera == name)
    }

    /// All images, in order.
    pub fn images(&self) -> impl Iterator<Item = ImageView<'_>> {
        self.metadata.images.iter().map(|metadata| ImageView { observation: self, metadata })
    }

    /// The last frames of a camera, oldest first: as many as `outputs.frames` asked for, fewer at an
    /// episode's start, none between two decisions.
    pub fn frames(&self, camera: &str) -> Vec<ImageView<'_>> {
        let metadata = &self.metadata;
        let newest_first = metadata.images.iter().filter(|image| image.pose == 0);
        let of_camera = newest_first.chain(&metadata.history).filter(|i| i.camera == camera);
        let mut frames: Vec<_> =
            of_camera.map(|metadata| ImageView { observation: self, metadata }).collect();
        frames.sort_by_key(|frame| std::cmp::Reverse(frame.metadata.back));
        frames
    }

    /// Past positions of the rig, in metres in the rig frame of now: `[16, 3]`, oldest first, 0.1 s
    /// apart, the last one zero.
    pub fn history_xyz_m(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(HISTORY_XYZ))
    }

    /// Past rotations `rig(now)_from_rig(then)`: `[16, 3, 3]`, row by row, the last one identity.
    pub fn history_rot(&self) -> Cow<'_, [f32]> {
        floats(self.tensor_bytes(HISTORY_ROT))
    }

    /// Compares the frame hash with the images' hashes, and each lossless image's pixels with its
    /// hash, those of earlier frames too. A JPEG's pixels are not those that were hashed, so they are left out.
    ///
    /// # Errors
    /// Names the first hash that differs, or the first image that cannot be decoded.
    pub fn verify(&self) -> Result<(), FrameError> {
        let mut frame_hasher = blake3::Hasher::new();
        for metadata in &self.metadata.history {
            ImageView { observation: self, metadata }.verify()?;
        }
        for image in self.images() {
            image.verify()?;
            // A hash that is no hash differs from every frame hash.
            let hash = blake3::Hash::from_hex(&image.metadata.hash).map_err(|_| {
                let (name, expected) = (image.metadata.tensor.clone(), "64 hex digits".to_owned());
                FrameError::Hash { name, found: image.metadata.hash.clone(), expected }
            })?;
            frame_hasher.update(hash.as_bytes());
        }
        let found = frame_hasher.finalize().to_hex().to_string();
        compare_hashes("frame_hash", found, &self.metadata.frame_hash)
    }

    /// Every tensor that the metadata names is there, with the type and shape it must have.
    fn check(&self) -> Result<(), FrameError> {
        self.expect(HISTORY_XYZ, Dtype::F32, &[wildcity_protocol::limits::HISTORY_POSES, 3])?;
        self.expect(HISTORY_ROT, Dtype::F32, &[wildcity_protocol::limits::HISTORY_POSES, 3, 3])?;
        let history = self.metadata.history.iter();
        let history = history.map(|metadata| ImageView { observation: self, metadata });
        for image in self.images().chain(history) {
            let wire::Image { tensor, width, height, .. } = image.metadata;
            let side = |px: u64| usize::try_from(px).unwrap_or(usize::MAX);
            let size = [side(*height), side(*width)];
            match image.metadata.encoding {
                Encoding::Raw => self.expect(tensor, Dtype::U8, &[size[0], size[1], 3])?,
                Encoding::Jpeg | Encoding::Png => self.expect_file(tensor)?,
            }
            let maps =
                [("depth", &size[..]), ("opacity", &size), ("normals", &[size[0], size[1], 3])];
            for (output, shape) in maps {
                let name = image.sibling(output);
                if self.tensors.info(&name).is_some() {
                    self.expect(&name, Dtype::F32, shape)?;
                }
            }
        }
        Ok(())
    }

    fn expect(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<(), FrameError> {
        let info = self.tensors.info(name).ok_or_else(|| missing(name))?;
        if info.dtype == dtype && info.shape == shape {
            return Ok(());
        }
        let found = format!("{} {:?}", info.dtype, info.shape);
        Err(FrameError::Tensor {
            name: name.to_owned(),
            found,
            expected: format!("{dtype} {shape:?}"),
        })
    }

    /// A JPEG or PNG file: bytes, as many as there are.
    fn expect_file(&self, name: &str) -> Result<(), FrameError> {
        let info = self.tensors.info(name).ok_or_else(|| missing(name))?;
        self.expect(name, Dtype::U8, &[info.shape.iter().product()])
    }

    /// The bytes of a tensor that [`Observation::check`] saw; none if there is no such tensor.
    fn tensor_bytes(&self, name: &str) -> &[u8] {
        let Some(info) = self.tensors.info(name) else { return &[] };
        let (start, end) = info.data_offsets;
        &self.frame[self.data_start + start..self.data_start + end]
    }
}

impl<'a> ImageView<'a> {
    /// Camera, size, intrinsics, times and hash.
    pub fn metadata(&self) -> &'a wire::Image {
        self.metadata
    }

    /// The image as it travelled: raw pixels, or a JPEG or PNG file.
    pub fn encoded(&self) -> &'a [u8] {
        self.observation.tensor_bytes(&self.metadata.tensor)
    }

    /// Compares lossless pixels with their hash.
    fn verify(&self) -> Result<(), FrameError> {
        if self.metadata.encoding == Encoding::Jpeg {
            return Ok(());
        }
        let found = blake3::hash(&self.rgb()?).to_hex().to_string();
        compare_hashes(&self.metadata.tensor, found, &self.metadata.hash)
    }

    /// Pixels, u8 `[height, width, 3]`: raw ones in place, others decoded.
    ///
    /// # Errors
    /// The JPEG or PNG file cannot be decoded, or is of another size than the metadata says.
    pub fn rgb(&self) -> Result<Cow<'a, [u8]>, FrameError> {
        let format = match self.metadata.encoding {
            Encoding::Raw => return Ok(Cow::Borrowed(self.encoded())),
            Encoding::Jpeg => ImageFormat::Jpeg,
            Encoding::Png => ImageFormat::Png,
        };
        let wire::Image { tensor: name, width, height, .. } = self.metadata;
        let mut reader = ImageReader::with_format(Cursor::new(self.encoded()), format);
        // Checked before decoding, so that a small file cannot ask for a large buffer.
        let mut limits = Limits::default();
        limits.max_image_width = u32::try_from(*width).ok();
        limits.max_image_height = u32::try_from(*height).ok();
        reader.limits(limits);
        let image =
            reader.decode().map_err(|cause| FrameError::Image { name: name.clone(), cause })?;
        if (u64::from(image.width()), u64::from(image.height())) != (*width, *height) {
            let found = format!("an image of {}x{} px", image.width(), image.height());
            let expected = format!("{width}x{height} px");
            return Err(FrameError::Tensor { name: name.clone(), found, expected });
        }
        Ok(Cow::Owned(image.into_rgb8().into_raw()))
    }

    /// Expected camera z in metres, f32 `[height, width]`, 0 where opacity is 0; if asked for.
    pub fn depth_m(&self) -> Option<Cow<'a, [f32]>> {
        self.floats("depth")
    }

    /// Accumulated opacity in [0, 1], f32 `[height, width]`; if asked for.
    pub fn opacity(&self) -> Option<Cow<'a, [f32]>> {
        self.floats("opacity")
    }

    fn floats(&self, output: &str) -> Option<Cow<'a, [f32]>> {
        let name = self.sibling(output);
        self.observation.tensors.info(&name)?;
        Some(floats(self.observation.tensor_bytes(&name)))
    }

    /// Unit normals of what is seen, in the camera's axes, f32 `[height, width, 3]`, 0 where there is no
    /// depth; if asked for.
    pub fn normals(&self) -> Option<Cow<'a, [f32]>> {
        self.floats("normals")
    }

    /// Name of the tensor beside the colour: `camera/front/rgb` and `depth` give
    /// `camera/front/depth`.
    fn sibling(&self, output: &str) -> String {
        let tensor = &self.metadata.tensor;
        format!("{}{output}", tensor.strip_suffix("rgb").unwrap_or(tensor))
    }
}

const HISTORY_XYZ: &str = "ego.history_xyz";
const HISTORY_ROT: &str = "ego.history_rot";

fn check_header_length(frame: &[u8]) -> Result<(), FrameError> {
    let limit = wildcity_protocol::limits::OBSERVATION_HEADER_BYTES;
    match frame.first_chunk().map(|length| u64::from_le_bytes(*length)) {
        Some(bytes) if bytes > limit => Err(FrameError::HeaderTooLong { bytes, limit }),
        // A frame too short for a length is refused with the rest of the layout.
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

/// Little-endian floats: in place where they lie on a multiple of four bytes (behind a JPEG of odd
/// length they do not) and the machine is little-endian, else copied.
fn floats(bytes: &[u8]) -> Cow<'_, [f32]> {
    match bytemuck::try_cast_slice(bytes) {
        Ok(floats) if cfg!(target_endian = "little") => Cow::Borrowed(floats),
        _ => Cow::Owned(
            bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
        ),
    }
}
