//! Arbitrary and nearly valid bytes never cause a panic or an absurd allocation.
//!
//! [`every_parser_survives_random_damage`] is the fuzz target of every parser: it damages the
//! corpus, one small scene per format and a mesh, beneath checksums. It runs for a second by
//! default; to run it for a night:
//!
//! ```text
//! WILDCITY_FUZZ_SECONDS=30000 WILDCITY_FUZZ_SEED=7 cargo test -p wildcity-twin --test ingest random_damage
//! ```
//!
//! A failure prints seed, round, format and the damaged file's bytes in hex.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use proptest::prelude::*;

use crate::corpus::{corpus, one};
use crate::meshes::square;
use crate::scene_files::Random;

use crate::read;
use crate::scene_files::{gaussians, gsplat_tensors, inria_columns, ply, safetensors};

/// Words of a PLY header, so that random headers get past the first line.
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
                prop_assert_eq!(read.sh.len(), read.len() * 3 * wildcity_scene::sh::coefficients(read.sh_degree));
            }
        }
    }
}

/// A number from an environment variable.
fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// Byte values at which formats tend to fail.
const WORDS: [&[u8]; 10] = [
    &[0],
    &[0xff],
    &[0x7f],
    &[0xff; 4],
    &[0xff; 8],
    &[0, 0, 0, 0x80],
    &[0, 0, 0xc0, 0x7f],
    &[0, 0, 0, 0, 0, 0, 0, 0x10],
    b"18446744073709551615",
    b"-1",
];

/// Changes up to four places.
fn damage(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let mut below = |n: usize| (random.unit() * n as f64) as usize;
    for _ in 0..=below(4) {
        let at = below(bytes.len() + 1);
        let end = (at + below(16)).min(bytes.len());
        match below(6) {
            0 if at < bytes.len() => bytes[at] ^= 1 << below(8),
            1 => {
                let word = WORDS[below(WORDS.len())];
                let end = (at + word.len()).min(bytes.len());
                bytes.splice(at..end, word.iter().copied());
            }
            2 => drop(bytes.drain(at..end)),
            3 => {
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
            4 if !other.is_empty() => {
                let from = below(other.len());
                let piece = &other[from..(from + below(32)).min(other.len())];
                bytes.splice(at..end, piece.iter().copied());
            }
            _ => bytes.truncate(at),
        }
    }
}

#[test]
fn every_parser_survives_random_damage() {
    let seed = setting("WILDCITY_FUZZ_SEED", 1);
    let end = Instant::now() + Duration::from_secs(setting("WILDCITY_FUZZ_SECONDS", 1));
    let mut random = Random(seed);
    let mut cases = corpus();
    cases.push(one("mesh", square("", "")));
    let folders: Vec<_> = cases.iter().map(|_| tempfile::tempdir().unwrap()).collect();
    cases.iter().zip(&folders).for_each(|(case, folder)| case.write(folder.path()));
    let mut rounds = 0;
    while Instant::now() < end || rounds < 50 {
        for (case, folder) in cases.iter().zip(&folders) {
            let part = (random.unit() * case.files.len() as f64) as usize;
            let other = &case.files[(random.unit() * case.files.len() as f64) as usize].1;
            let mut bytes = case.files[part].1.clone();
            damage(&mut bytes, other, &mut random);
            let read = || case.read_with(folder.path(), part, &bytes);
            let survived = catch_unwind(AssertUnwindSafe(|| match read() {
                Ok(g) => {
                    let colours = 3 * wildcity_scene::sh::coefficients(g.sh_degree);
                    assert_eq!(g.sh.len(), g.len() * colours);
                    // A mesh always gets the full number of Gaussians, however small its surface
                    // is.
                    let most = if case.name == "mesh" { 210_000 } else { 10_000 };
                    assert!(g.len() < most, "{} Gaussians", g.len());
                }
                Err(error) => assert!(!error.to_string().is_empty()),
            }));
            if survived.is_err() {
                let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                let name = &case.files[part].0;
                panic!("seed {seed}, round {rounds}, {}, {name}: {hex}", case.name);
            }
            // Restored before the other files are damaged.
            let _ = case.read_with(folder.path(), part, &case.files[part].1);
        }
        rounds += 1;
    }
}
