//! Where the maps and the raw pixels of each capture lie in the buffer of an observation.

use std::mem;
use std::sync::Arc;

use wildcity_render::Target;

use crate::observe::encode::{ImageEncoding, PixelMaps};
use crate::observe::layout::{InPlaceBytes, ObservationLayout, RigCapture};

/// Where the next capture goes, in bytes from the buffer's start. Each kind of all captures lies
/// together, so that a kind is one block of the buffer:
///
/// ```text
/// | header | ego history, motion, floats of sweeps | floats of all captures | integers of sweeps |
/// | instances of all captures | classes of sweeps | classes of all captures | raw pixels of all |
/// ```
pub(super) struct BufferPlan {
    layout: Arc<ObservationLayout>,
    floats_at: usize,
    sweep_ids_at: usize,
    instances_at: usize,
    sweep_classes_at: usize,
    semantics_at: usize,
    raw_at: usize,
    end: usize,
}

impl BufferPlan {
    /// The plan for some captures, whose maps begin at `floats_at`, and for sweeps with ids and
    /// classes of so many bytes.
    pub(super) fn new(
        layout: Arc<ObservationLayout>,
        captures: &[RigCapture],
        floats_at: usize,
        [sweep_id_bytes, sweep_class_bytes]: [usize; 2],
    ) -> Self {
        let in_place = captures.iter().map(|capture| layout.in_place_bytes(capture));
        let all = in_place.fold(InPlaceBytes::default(), |sum, one| InPlaceBytes {
            floats: sum.floats + one.floats,
            instances: sum.instances + one.instances,
            semantics: sum.semantics + one.semantics,
            raw: sum.raw + one.raw,
        });
        let sweep_ids_at = floats_at + all.floats;
        let instances_at = sweep_ids_at + sweep_id_bytes;
        let sweep_classes_at = instances_at + all.instances;
        let semantics_at = sweep_classes_at + sweep_class_bytes;
        let raw_at = semantics_at + all.semantics;
        let end = raw_at + all.raw;
        Self {
            layout,
            floats_at,
            sweep_ids_at,
            instances_at,
            sweep_classes_at,
            semantics_at,
            raw_at,
            end,
        }
    }

    /// Where the integers of sweeps begin: rows, columns and instances of one sweep after the
    /// other.
    pub(super) fn sweep_ids_at(&self) -> usize {
        self.sweep_ids_at
    }

    /// Where the classes of sweeps begin, of one sweep after the other.
    pub(super) fn sweep_classes_at(&self) -> usize {
        self.sweep_classes_at
    }

    /// Where the buffer ends before the files of the images are appended.
    pub(super) fn end(&self) -> usize {
        self.end
    }

    /// Whether the buffer holds the pixels of a capture as they are, so that the renderer writes
    /// them there.
    fn holds_pixels(&self, capture: &RigCapture) -> bool {
        self.layout.encoding() == ImageEncoding::Raw && capture.shown
    }

    /// Where the pixels of each view of a capture are in the buffer, if the observation holds them
    /// there.
    pub(super) fn raw_places(&self, capture: &RigCapture) -> Vec<Option<usize>> {
        let holds_pixels = self.holds_pixels(capture);
        // Places of views that are not held are counted as well, but not returned.
        let mut next = self.raw_at;
        let place = |camera: &usize| {
            let at = next;
            // Red, green and blue, of a byte each.
            next += 3 * self.layout.cameras()[*camera].camera.pixels();
            holds_pixels.then_some(at)
        };
        capture.cameras.iter().map(place).collect()
    }

    /// Targets of a capture's images: the buffer for maps and pixels that the observation contains
    /// as rendered, and `images` for pixels that are encoded first.
    pub(super) fn targets<'a>(
        &'a mut self,
        buffer: &'a mut [u8],
        capture: &RigCapture,
        mut images: impl Iterator<Item = &'a mut [u8]>,
    ) -> Vec<Target<'a>> {
        let holds_pixels = self.holds_pixels(capture);
        let layout = &self.layout;
        let floats_at = self.floats_at;
        let instances_at = self.instances_at;
        let semantics_at = self.semantics_at;
        let raw_at = self.raw_at;
        let own = layout.in_place_bytes(capture);
        // Moved on by the whole capture, so that the next one begins behind it.
        self.floats_at += own.floats;
        self.instances_at += own.instances;
        self.semantics_at += own.semantics;
        self.raw_at += own.raw;
        // Disjoint slices for each target: threads can write all of them at once.
        // The last part first, because all places count from the start of the buffer.
        let (maps_part, raw_part) = buffer.split_at_mut(raw_at);
        let (maps_part, semantics_part) = maps_part.split_at_mut(semantics_at);
        let (float_part, instances_part) = maps_part.split_at_mut(instances_at);
        let mut float_part = &mut float_part[floats_at..floats_at + own.floats];
        let mut instances_part = &mut instances_part[..own.instances];
        let mut semantics_part = &mut semantics_part[..own.semantics];
        let mut raw_part = &mut raw_part[..own.raw];

        let mut targets = Vec::with_capacity(capture.cameras.len());
        for &camera in &capture.cameras {
            let camera = &layout.cameras()[camera];
            let pixels = camera.camera.pixels();
            let mut map = |held: bool, values: usize| {
                let bytes = 4 * pixels * values;
                (held && capture.shown).then(|| as_floats(split_off_front(&mut float_part, bytes)))
            };
            // In the order of the tensors.
            let PixelMaps { depth, opacity, normals, instances, semantics } = layout.maps();
            let depth_m = map(depth, 1);
            let opacity = map(opacity, 1);
            let normals = map(normals, 3);
            let instances = (instances && capture.shown)
                .then(|| as_ids(split_off_front(&mut instances_part, 2 * pixels)));
            let semantics =
                (semantics && capture.shown).then(|| split_off_front(&mut semantics_part, pixels));
            let rgb8 = if holds_pixels {
                split_off_front(&mut raw_part, 3 * pixels)
            } else {
                // There is one for each camera; the backend would refuse an empty one.
                images.next().unwrap_or_default()
            };
            targets.push(Target {
                rgba: None,
                rgb8: Some(rgb8),
                depth_m,
                opacity,
                normals,
                instances,
                semantics,
                appearance: Some(&camera.appearance),
            });
        }
        targets
    }
}

/// Splits the first bytes off a slice.
fn split_off_front<'a>(rest: &mut &'a mut [u8], bytes: usize) -> &'a mut [u8] {
    // The slice is taken out first, because a borrow through `rest` would not live as long as the
    // parts.
    let (front, others) = mem::take(rest).split_at_mut(bytes);
    *rest = others;
    front
}

/// The bytes as floats. They are aligned: the buffer's address is a multiple of 8, and the header's
/// room, the ego history and the maps before them are multiples of 4 bytes.
fn as_floats(bytes: &mut [u8]) -> &mut [f32] {
    bytemuck::cast_slice_mut(bytes)
}

/// The bytes as instances. They are aligned: all bytes before them are of floats, and of other
/// instances.
fn as_ids(bytes: &mut [u8]) -> &mut [u16] {
    bytemuck::cast_slice_mut(bytes)
}
