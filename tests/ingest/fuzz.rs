//! Arbitrary and nearly right bytes never panic and never ask for absurd memory.

use proptest::prelude::*;

use crate::read;
use crate::scene_files::{gaussians, gsplat_tensors, inria_columns, ply, safetensors};

/// Words of a PLY header, so that random ones get past the first line.
fn header_line() -> impl Strategy<Value = String> {
    let word = prop_oneof![
        Just("element".to_owned()),
        Just("property".to_owned()),
        Just("vertex".to_owned()),
        Just("chunk".to_owned()),
        Just("list".to_owned()),
        Just("float".to_owned()),
        Just("uint".to_owned()),
        Just("x".to_owned()),
        Just("packed_position".to_owned()),
        Just("f_rest_0".to_owned()),
        Just("end_header".to_owned()),
        any::<u64>().prop_map(|n| n.to_string()),
        "[ -~]{0,12}",
    ];
    prop::collection::vec(word, 0..5).prop_map(|words| words.join(" "))
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(512) })]

    #[test]
    fn arbitrary_headers_end_in_an_answer(
        lines in prop::collection::vec(header_line(), 0..30),
        body in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let header = format!("ply\nformat binary_little_endian 1.0\n{}\n", lines.join("\n"));
        let _ = read(&[header.as_bytes(), &body].concat());
    }

    #[test]
    fn arbitrary_bytes_end_in_an_answer(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = read(&bytes);
        let _ = read(&[b"ply\n", &bytes[..]].concat());
        let json = [&(bytes.len() as u64 + 1).to_le_bytes(), &b"{"[..], &bytes].concat();
        prop_assert!(read(&json).is_err());
    }

    #[test]
    fn a_changed_byte_is_refused_or_harmless(at in 0usize..1 << 20, byte in any::<u8>()) {
        let scene = gaussians(3, 1, 1.0, 1);
        let files = [ply(&scene, &inria_columns(1, false)), safetensors(&gsplat_tensors(&scene), &[])];
        for mut file in files {
            let at = at % file.len();
            file[at] = byte;
            if let Ok(read) = read(&file) {
                prop_assert!(read.len() <= 3);
                prop_assert_eq!(read.sh.len(), read.len() * 3 * wildcity::scene::sh::coefficients(read.sh_degree));
            }
        }
    }
}
