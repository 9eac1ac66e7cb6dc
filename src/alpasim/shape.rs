//! How many messages a request contains, counted before it is decoded.
//!
//! An empty message has two bytes on the wire, and up to 700 in memory. So a request is walked
//! first, by the fields that may repeat.

use tonic::Status;

use crate::limits;
use crate::wire::common::Empty;
use crate::wire::physics::GroundIntersectionRequest;
use crate::wire::sensorsim::{
    AggregatedRenderRequest, BatchRgbRenderRequest, LidarRenderRequest, RgbRenderRequest,
    SceneRequest,
};

/// The fields of a message that contain messages: their numbers, whether each counts, and its own
/// fields.
pub(crate) type Shape = &'static [(u64, bool, Fields)];

/// The fields of a field's message. A type of its own, since an alias cannot name itself.
#[derive(Clone, Copy)]
pub(crate) struct Fields(Shape);

const LEAF: Fields = Fields(&[]);
const POSES: Fields = Fields(&[(1, true, LEAF)]);
const RGB: Fields = Fields(&[(8, true, LEAF)]);
const LIDAR: Fields = Fields(&[(6, true, LEAF)]);
const ITEM: Fields = Fields(&[(2, false, RGB)]);
const EGO: Fields = Fields(&[(3, false, POSES)]);

/// A request that can be counted.
pub(crate) trait Counted {
    const SHAPE: Shape;
}

impl Counted for Empty {
    const SHAPE: Shape = &[];
}

impl Counted for SceneRequest {
    const SHAPE: Shape = &[];
}

impl Counted for RgbRenderRequest {
    const SHAPE: Shape = RGB.0;
}

impl Counted for BatchRgbRenderRequest {
    const SHAPE: Shape = &[(1, true, ITEM)];
}

impl Counted for AggregatedRenderRequest {
    const SHAPE: Shape = &[(1, true, RGB), (2, true, LIDAR)];
}

impl Counted for LidarRenderRequest {
    const SHAPE: Shape = LIDAR.0;
}

impl Counted for GroundIntersectionRequest {
    const SHAPE: Shape = &[(4, false, EGO), (5, true, LEAF)];
}

/// Refuses a request with too many messages in it.
///
/// # Errors
/// `INVALID_ARGUMENT`.
pub(crate) fn check<Asked: Counted>(bytes: &[u8]) -> Result<(), Status> {
    let most = limits::SUBMESSAGES;
    let mut count = 0;
    walk(bytes, Asked::SHAPE, &mut count);
    if count <= most {
        return Ok(());
    }
    Err(Status::invalid_argument(format!(
        "more than {most} messages in one request: send several requests"
    )))
}

/// Counts until there are too many, or the bytes are no message: decoding says what is wrong then.
fn walk(mut bytes: &[u8], shape: Shape, count: &mut usize) -> Option<()> {
    while !bytes.is_empty() && *count <= limits::SUBMESSAGES {
        let key = varint(&mut bytes)?;
        let length = match key & 7 {
            0 => {
                varint(&mut bytes)?;
                continue;
            }
            1 => 8,
            5 => 4,
            2 => usize::try_from(varint(&mut bytes)?).ok()?,
            // Groups are not used.
            _ => return None,
        };
        let (field, rest) = bytes.split_at_checked(length)?;
        bytes = rest;
        let known = shape.iter().find(|(number, ..)| *number == key >> 3);
        if let Some((_, counts, fields)) = known.filter(|_| key & 7 == 2) {
            *count += usize::from(*counts);
            walk(field, fields.0, count)?;
        }
    }
    Some(())
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (byte, rest) = bytes.split_first()?;
        *bytes = rest;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    use super::*;
    use crate::wire::sensorsim::{BatchRgbRenderRequestItem, DynamicObject};

    fn batch(images: usize, objects: usize) -> Vec<u8> {
        let request = RgbRenderRequest {
            scene_id: "demo@1+log+0".to_owned(),
            dynamic_objects: vec![DynamicObject::default(); objects],
            ..RgbRenderRequest::default()
        };
        let item = BatchRgbRenderRequestItem { request: Some(request), ..Default::default() };
        BatchRgbRenderRequest { items: vec![item; images] }.encode_to_vec()
    }

    #[test]
    fn a_request_has_as_many_messages_as_it_has_images_and_objects() {
        let mut count = 0;
        walk(&batch(10, 20), BatchRgbRenderRequest::SHAPE, &mut count).unwrap();
        assert_eq!(count, 10 + 10 * 20);
        check::<BatchRgbRenderRequest>(&batch(limits::BATCH_IMAGES, 250)).unwrap();
        // 400 kB, which would take 45 MB.
        let bomb = batch(1, 2 * limits::SUBMESSAGES);
        assert!(bomb.len() < 400_000);
        assert!(check::<BatchRgbRenderRequest>(&bomb).is_err());
        // The same field again is merged into one message, with the objects of both.
        let twice = [batch(1, limits::SUBMESSAGES), batch(1, limits::SUBMESSAGES)].concat();
        assert!(check::<BatchRgbRenderRequest>(&twice).is_err());
    }

    #[test]
    fn damaged_bytes_are_left_to_the_decoder() {
        for bytes in [&[0x0a, 0xff][..], &[0xff; 20], &[0x0b], &[0x0a, 0x05, 0x01]] {
            check::<BatchRgbRenderRequest>(bytes).unwrap();
            assert!(BatchRgbRenderRequest::decode(bytes).is_err(), "{bytes:?}");
        }
    }
}
