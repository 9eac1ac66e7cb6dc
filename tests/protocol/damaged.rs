//! Damaged frames: each is refused with an error that names its damage.

use std::fs;

use safetensors::SafeTensorError;
use serde_json::{Value, json};
use wildcity_client::{FrameError, Observation};

use super::frames::{Frame, assemble, png};
use super::observations::{png_frame, raw_frame};
use super::{check_file, check_json, protocol_path, read};

/// Whether an error is the expected one.
type Refusal = fn(&FrameError) -> bool;

/// A damaged frame, and the error that it must cause.
struct Damaged {
    name: &'static str,
    what: &'static str,
    bytes: Vec<u8>,
    /// Whether only the image is damaged, so that decoding the frame succeeds and decoding the
    /// image fails.
    image_only: bool,
    refused: Refusal,
}

#[test]
fn damaged_frames_are_refused() {
    let index: Vec<Value> = damaged()
        .iter()
        .map(|d| {
            let when = if d.image_only { "image" } else { "frame" };
            json!({"file": format!("{}.bin", d.name), "what": d.what, "refused_at": when})
        })
        .collect();
    check_json("vectors/damaged/index.json", &index);
    for Damaged { name, bytes, image_only, refused, .. } in damaged() {
        let file = format!("vectors/damaged/{name}.bin");
        check_file(&file, &bytes);
        let decoded = Observation::decode(read(&file));
        let error = if image_only {
            let observation = decoded.unwrap_or_else(|e| panic!("{name}: {e}"));
            observation.camera("front").unwrap().rgb().map(|_| ()).expect_err(name)
        } else {
            decoded.map(|_| ()).expect_err(name)
        };
        assert!(refused(&error), "{name} was refused for another reason: {error}");
    }
    // No file is left over from an earlier list.
    let files = fs::read_dir(protocol_path("vectors/damaged")).unwrap().count();
    assert_eq!(files, index.len() + 1);
}

/// A cut frame is an error. A flipped byte is an error, or an observation with the same pixels, or
/// one that `verify` refuses. Nothing panics.
#[test]
fn no_prefix_and_no_flipped_byte_panics() {
    let frame = png_frame();
    let bytes = frame.bytes();
    for length in 0..bytes.len() {
        assert!(Observation::decode(bytes[..length].to_vec()).is_err(), "{length} bytes");
    }
    let pixels = |observation: &Observation| -> Vec<Vec<u8>> {
        observation.images().map(|image| image.rgb().unwrap().into_owned()).collect()
    };
    let good = pixels(&Observation::decode(bytes.clone()).unwrap());
    let images_bytes: usize = frame.tensors[2..].iter().map(|tensor| tensor.bytes.len()).sum();
    for position in 0..bytes.len() {
        let mut flipped = bytes.clone();
        flipped[position] ^= 0x15;
        let Ok(observation) = Observation::decode(flipped) else { continue };
        let verified = observation.verify();
        // Some bytes of a PNG file, for example its last checksum, do not affect its pixels.
        if position >= bytes.len() - images_bytes && verified.is_ok() {
            assert_eq!(pixels(&observation), good, "byte {position} was flipped");
        }
    }
}

fn damaged() -> Vec<Damaged> {
    let good = raw_frame().bytes();
    let cut = |length: usize| good[..length].to_vec();
    let with_length = |length: u64| [&length.to_le_bytes(), &good[8..]].concat();
    let case =
        |name, what, bytes, refused| Damaged { name, what, bytes, image_only: false, refused };
    let mut cases = vec![
        case("empty", "no bytes at all", vec![], layout),
        case("short_length", "ends within the header length", cut(5), layout),
        case("short_header", "ends within the header", cut(100), layout),
        case("short_data", "ends within the last tensor", cut(good.len() - 7), layout),
        case("trailing", "bytes behind the last tensor", [&good[..], &[0; 4]].concat(), layout),
        case(
            "header_beyond_frame",
            "the header is longer than the frame",
            with_length(good.len() as u64),
            layout,
        ),
        case(
            "header_2_60",
            "a header of 2^60 bytes",
            with_length(1 << 60),
            |e| matches!(e, FrameError::HeaderTooLong { bytes, .. } if *bytes == 1 << 60),
        ),
        case("header_not_json", "the header is not JSON", assemble("{\"a\": ", &[]), layout),
        case("header_not_object", "the header is a JSON array", assemble("[]", &[]), layout),
        case("header_not_utf8", "the header is not UTF-8", not_utf8(), layout),
        case("no_metadata", "no __metadata__", without_metadata(), |e| {
            matches!(e, FrameError::NoObservation)
        }),
    ];
    cases.extend(damaged_tables());
    cases.extend(damaged_images());
    cases
}

/// The header is JSON, but its tensor table is invalid.
fn damaged_tables() -> Vec<Damaged> {
    let edits: [(&str, &str, &str, Value, Refusal); 11] = [
        (
            "overlap",
            "two tensors overlap",
            "/ego.history_rot/data_offsets",
            json!([188, 764]),
            offset,
        ),
        (
            "gap",
            "bytes between tensors",
            "/ego.history_rot/data_offsets",
            json!([196, 772]),
            offset,
        ),
        (
            "offset_past_end",
            "a tensor reaches beyond the end",
            "/camera~1rear~1opacity/data_offsets",
            json!([984, 1_u64 << 40]),
            layout,
        ),
        (
            "reversed_offsets",
            "ends before it starts",
            "/ego.history_xyz/data_offsets",
            json!([192, 0]),
            offset,
        ),
        (
            "negative_offset",
            "starts before zero",
            "/ego.history_xyz/data_offsets",
            json!([-4, 188]),
            layout,
        ),
        (
            "unknown_dtype",
            "a type that there is not",
            "/ego.history_xyz/dtype",
            json!("F33"),
            layout,
        ),
        (
            "wrong_dtype",
            "integers where floats must be",
            "/ego.history_xyz/dtype",
            json!("I32"),
            tensor,
        ),
        (
            "wrong_shape",
            "height and width swapped",
            "/camera~1front~1rgb/shape",
            json!([4, 3, 3]),
            tensor,
        ),
        (
            "shape_not_bytes",
            "a shape of another size",
            "/camera~1front~1rgb/shape",
            json!([3, 4]),
            layout,
        ),
        (
            "shape_overflow",
            "a shape beyond 2^64 bytes",
            "/camera~1front~1rgb/shape",
            json!([1_u64 << 62, 8, 3]),
            layout,
        ),
        (
            "shape_not_numbers",
            "a shape of texts",
            "/camera~1front~1rgb/shape",
            json!(["3"]),
            layout,
        ),
    ];
    let mut cases: Vec<Damaged> = edits
        .into_iter()
        .map(|(name, what, pointer, value, refused)| {
            let (header, data) = raw_frame().header();
            let mut header = Value::Object(header);
            *header.pointer_mut(pointer).expect(pointer) = value;
            let bytes = assemble(&header.to_string(), &data);
            Damaged { name, what, bytes, image_only: false, refused }
        })
        .collect();

    let mut unnamed = raw_frame();
    unnamed.metadata.images[1].tensor = "camera/left/rgb".into();
    cases.push(Damaged {
        name: "missing_tensor",
        what: "an image that names a missing tensor",
        bytes: unnamed.bytes(),
        image_only: false,
        refused: |e| matches!(e, FrameError::Missing { name } if name == "camera/left/rgb"),
    });
    for (name, what, text) in [
        ("observation_not_json", "__metadata__.observation is not JSON", "{\"seq\": 3,"),
        ("observation_incomplete", "__metadata__.observation lacks fields", "{\"seq\": 3}"),
    ] {
        let (mut header, data) = raw_frame().header();
        header["__metadata__"]["observation"] = json!(text);
        let bytes = assemble(&Value::Object(header).to_string(), &data);
        let refused: Refusal = |e| matches!(e, FrameError::Observation(_));
        cases.push(Damaged { name, what, bytes, image_only: false, refused });
    }
    cases
}

/// The frame is valid, but the PNG file in it is damaged.
fn damaged_images() -> [Damaged; 2] {
    let with_file = |bytes: Vec<u8>| {
        let mut frame: Frame = png_frame();
        // One camera and no other PNG file, so that the frame does not depend on the encoder.
        frame.tensors.truncate(3);
        frame.metadata.images.truncate(1);
        frame.tensors[2].shape = vec![bytes.len() as u64];
        frame.tensors[2].bytes = bytes;
        frame.bytes()
    };
    [
        Damaged {
            name: "image_not_png",
            what: "the PNG file is none",
            bytes: with_file(b"not a PNG file".to_vec()),
            image_only: true,
            refused: |e| matches!(e, FrameError::Image { .. }),
        },
        Damaged {
            name: "image_of_other_size",
            what: "the PNG file is smaller than its metadata says",
            bytes: with_file(png(&[0; 2 * 3], 2, 1)),
            image_only: true,
            refused: tensor,
        },
    ]
}

fn not_utf8() -> Vec<u8> {
    let mut bytes = raw_frame().bytes();
    bytes[8 + 30] = 0xff;
    bytes
}

fn without_metadata() -> Vec<u8> {
    let (mut header, data) = raw_frame().header();
    header.remove("__metadata__");
    assemble(&Value::Object(header).to_string(), &data)
}

fn layout(error: &FrameError) -> bool {
    matches!(error, FrameError::Layout(_))
}

fn offset(error: &FrameError) -> bool {
    matches!(error, FrameError::Layout(SafeTensorError::InvalidOffset(_)))
}

fn tensor(error: &FrameError) -> bool {
    matches!(error, FrameError::Tensor { .. })
}
