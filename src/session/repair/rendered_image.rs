//! The pixels and maps of an image that may be repaired.

/// An image as it was rendered, and the maps that the model may need. Maps that it does not need
/// are empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedImage {
    /// `[height, width, 3]`: sRGB, 8 bits.
    pub rgb8: Vec<u8>,
    /// `[height, width]`, in metres; 0 where there is no depth.
    pub depth_m: Vec<f32>,
    /// `[height, width]`, 0 to 1.
    pub opacity: Vec<f32>,
    /// `[height, width, 3]`: unit vectors in the camera's axes.
    pub normals: Vec<f32>,
    /// The trust by which it was selected, 0 to 1.
    pub trust: f64,
}
