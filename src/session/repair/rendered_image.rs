//! What is rendered of an image that may be repaired.

/// An image as it was rendered, and what the model may need beside it. Maps that it does not need are empty.
#[derive(Clone, Debug, Default)]
pub struct RenderedImage {
    /// `[height, width, 3]`.
    pub rgb8: Vec<u8>,
    /// `[height, width]`, in metres.
    pub depth_m: Vec<f32>,
    /// `[height, width]`.
    pub opacity: Vec<f32>,
    /// `[height, width, 3]`.
    pub normals: Vec<f32>,
    /// The trust by which it was selected.
    pub trust: f64,
}
