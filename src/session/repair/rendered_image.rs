//! What is rendered of an image that may be repaired.

/// An image as it was rendered, and what the model may need beside it. Maps that it does not need are empty.
#[derive(Debug, Default)]
pub(crate) struct RenderedImage {
    /// `[height, width, 3]`.
    pub(crate) rgb8: Vec<u8>,
    /// `[height, width]`, in metres.
    pub(crate) depth_m: Vec<f32>,
    /// `[height, width]`.
    pub(crate) opacity: Vec<f32>,
    /// `[height, width, 3]`.
    pub(crate) normals: Vec<f32>,
    /// The trust by which it was selected.
    pub(crate) trust: f64,
}
