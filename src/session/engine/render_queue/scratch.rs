//! The images that a frame needs and no answer contains.

use wildcity_render::View;

use crate::limits;

/// Buffers that a render thread keeps between frames, so that no step allocates and zeroes them. A
/// backend writes every value of an image, so what they held before does not matter.
#[derive(Debug, Default)]
pub struct Scratch {
    /// RGB images that are encoded.
    pub(crate) images: Buffers<u8>,
    /// Opacity that only trust is computed from.
    pub(crate) opacity: Buffers<f32>,
    /// Depth, in metres, that only a repair needs.
    pub(crate) depth_m: Buffers<f32>,
    /// Normals that only a repair needs.
    pub(crate) normals: Buffers<f32>,
}

impl Scratch {
    /// Frees buffers beyond [`limits::SCRATCH_BYTES`] in all: first those that the fewest frames
    /// need.
    pub(crate) fn free_excess(&mut self) {
        let Self { images, opacity, depth_m, normals } = self;
        let mut left = limits::SCRATCH_BYTES;
        // Every frame needs images, and only some need the maps.
        images.keep_within(&mut left);
        for maps in [opacity, depth_m, normals] {
            maps.keep_within(&mut left);
        }
    }
}

/// Buffers for one image of each view of a frame. There may be more of them, and larger ones, than
/// the frame needs.
#[derive(Debug, Default)]
pub(crate) struct Buffers<T>(Vec<Vec<T>>);

impl<T: Copy + Default> Buffers<T> {
    /// A buffer for each view, with a number of values per pixel.
    pub(crate) fn for_views(
        &mut self,
        views: &[View],
        values_per_pixel: usize,
    ) -> impl Iterator<Item = &mut [T]> {
        // Buffers only grow here; `free_excess` bounds them after the frame.
        self.0.resize_with(self.0.len().max(views.len()), Vec::new);
        let counts = views.iter().map(move |view| values_per_pixel * view.camera.pixels());
        self.0.iter_mut().zip(counts).map(|(buffer, count)| {
            // Exactly: `Vec` would otherwise reserve up to twice as much.
            buffer.reserve_exact(count.saturating_sub(buffer.len()));
            buffer.resize(count.max(buffer.len()), T::default());
            &mut buffer[..count]
        })
    }

    /// Takes the buffers from the bytes that are left, and frees those that are too many.
    fn keep_within(&mut self, left: &mut usize) {
        self.0.retain(|buffer| {
            // One that does not fit is freed, and a smaller one after it may still fit.
            let rest = left.checked_sub(buffer.capacity() * size_of::<T>());
            *left = rest.unwrap_or(*left);
            rest.is_some()
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::geometry::{Camera, Pose};

    fn view(width_px: u32) -> View {
        let pinhole = Pinhole { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        View::new(Camera::from_pinhole(width_px, 1, pinhole), Pose::IDENTITY)
    }

    #[test]
    fn every_view_has_a_buffer_of_its_size() {
        let mut buffers = Buffers::default();
        let mut sizes = |widths: &[u32], values: usize| {
            let views: Vec<View> = widths.iter().map(|&width| view(width)).collect();
            let counts = |buffer: &mut [f32]| {
                let had_values = buffer.contains(&9.0);
                buffer.fill(9.0);
                (buffer.len(), had_values)
            };
            buffers.for_views(&views, values).map(counts).collect::<Vec<_>>()
        };
        // Each image has a row: 4 and 5 pixels of one value. Both buffers are fresh.
        assert_eq!(sizes(&[4, 5], 1), [(4, false), (5, false)]);
        // Two buffers are those from above, enlarged, and the third one is fresh.
        assert_eq!(sizes(&[2, 9, 3], 3), [(6, true), (27, true), (9, false)]);
        // Fewer views keep the other buffers, which the next frame has again.
        assert_eq!(sizes(&[1], 1), [(1, true)]);
        assert_eq!(sizes(&[4, 9, 3], 3), [(12, true), (27, true), (9, true)]);
    }

    #[test]
    fn a_thread_keeps_a_bounded_number_of_bytes() {
        let third = limits::SCRATCH_BYTES / 3;
        let mut scratch = Scratch::default();
        // In thirds of the limit: images 1 and 3, opacity 1, depth 2 and 1. After an image and the
        // opacity one third is left, for the second depth.
        // Its capacity counts, and not its length.
        scratch.images.0 = vec![Vec::with_capacity(third), Vec::with_capacity(3 * third)];
        scratch.opacity.0 = vec![vec![0.0; third / 4]];
        scratch.depth_m.0 = vec![vec![0.0; third / 2], vec![0.0; third / 4]];
        scratch.normals.0 = vec![vec![0.0; 1000]];
        scratch.free_excess();
        let kept = |maps: &Buffers<f32>| maps.0.iter().map(Vec::len).collect::<Vec<_>>();
        assert_eq!(scratch.images.0.len(), 1);
        assert_eq!([&scratch.opacity, &scratch.depth_m].map(kept), [[third / 4], [third / 4]]);
        assert!(scratch.normals.0.is_empty());
    }
}
