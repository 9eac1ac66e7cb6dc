//! The images that a frame needs and no answer contains.

use wildcity_render::View;

use crate::limits;

/// Buffers that a render thread keeps between frames, so that no step allocates and zeroes them. A backend writes every
/// value of an image, so what they held before does not matter. Each list has a buffer for each view.
#[derive(Debug, Default)]
pub struct Scratch {
    /// RGB images that are encoded.
    pub(crate) images: Vec<Vec<u8>>,
    /// Opacity that only trust is computed from.
    pub(crate) opacity: Vec<Vec<f32>>,
    /// Depth, in metres, that only a repair needs.
    pub(crate) depth_m: Vec<Vec<f32>>,
    /// Normals that only a repair needs.
    pub(crate) normals: Vec<Vec<f32>>,
}

impl Scratch {
    /// Frees the buffers that only unusually large images need.
    pub(crate) fn free_large(&mut self) {
        self.images.retain(|image| image.capacity() <= limits::SCRATCH_IMAGE_BYTES);
        for maps in [&mut self.opacity, &mut self.depth_m, &mut self.normals] {
            maps.retain(|map| size_of_val(&map[..]) <= limits::SCRATCH_IMAGE_BYTES);
        }
    }
}

/// A buffer of so many values per pixel for each view.
pub(crate) fn for_views<'a, T: Copy + Default>(
    buffers: &'a mut Vec<Vec<T>>,
    views: &[View],
    values: usize,
) -> impl Iterator<Item = &'a mut [T]> {
    buffers.resize_with(buffers.len().max(views.len()), Vec::new);
    let sizes = views.iter().map(move |view| values * view.camera.pixels());
    buffers.iter_mut().zip(sizes).map(|(buffer, size)| {
        if buffer.len() < size {
            buffer.resize(size, T::default());
        }
        &mut buffer[..size]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_of_unusually_large_images_are_freed() {
        let small = vec![0.0; 1000];
        let mut scratch = Scratch {
            images: vec![vec![0; limits::SCRATCH_IMAGE_BYTES + 1], vec![0; 1000]],
            normals: vec![small.clone(), vec![0.0; limits::SCRATCH_IMAGE_BYTES / 4 + 1]],
            ..Scratch::default()
        };
        scratch.free_large();
        assert_eq!(scratch.images, [vec![0; 1000]]);
        assert_eq!(scratch.normals, [small]);
    }
}
