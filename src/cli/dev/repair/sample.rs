//! An image with neutral values for every role.

use wildcity_repair::{Image, View};

/// Depth everywhere, in metres.
const DEPTH_M: f32 = 10.0;

/// An image, with neutral values for the other roles.
pub(super) struct Sample {
    rendered: Image,
    ones: Vec<f32>,
    depth_m: Vec<f32>,
    normals: Vec<f32>,
}

impl Sample {
    pub(super) fn new(rendered: Image) -> Sample {
        let pixels = rendered.width * rendered.height;
        let mut normals = vec![0.0; 2 * pixels];
        // Towards the camera, which looks along z.
        normals.resize(3 * pixels, -1.0);
        Sample { rendered, ones: vec![1.0; pixels], depth_m: vec![DEPTH_M; pixels], normals }
    }

    pub(super) fn rendered(&self) -> &Image {
        &self.rendered
    }

    pub(super) fn view(&self) -> View<'_> {
        View {
            rendered: &self.rendered,
            reference: Some(&self.rendered),
            reference_warped: Some(&self.rendered),
            reference_valid: Some(&self.ones),
            depth_m: Some(&self.depth_m),
            opacity: Some(&self.ones),
            normals: Some(&self.normals),
            mask: Some(&self.ones),
            trust: Some(0.5),
        }
    }
}
