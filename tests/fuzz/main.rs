//! The fuzz targets with simple mutations, for a bounded time, on stable. A failure prints the
//! target, the seed and the bytes. `FUZZ_SECONDS=600 FUZZ_SEED=7 cargo test --test fuzz` runs
//! longer, and `FUZZ_TARGET=log` gives all of the time to one target.

#[path = "../support/root.rs"]
mod root;
mod targets;

use std::collections::BTreeMap;
use std::fs;
use std::panic::catch_unwind;
use std::path::Path;
use std::time::{Duration, Instant};

/// A linear congruential generator (Knuth, MMIX), of which the upper bits are used.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as usize) % limit.max(1)
    }
}

/// Values at which parsers tend to fail.
const WORDS: [&[u8]; 12] = [
    &[0],
    &[0xff],
    &[0xff; 4],
    &[0xff; 8],
    &[0, 0, 0, 0x80],
    b"-1",
    b"1e999",
    b"18446744073709551616",
    b"null",
    b"[[[[[[[[",
    b"{\"a\":",
    b"\\ud800",
];

/// Changes one to four places.
fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    for _ in 0..=random.below(4) {
        let at = random.below(bytes.len() + 1);
        let end = (at + random.below(16)).min(bytes.len());
        match random.below(6) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 => {
                let word = WORDS[random.below(WORDS.len())];
                bytes.splice(at..end, word.iter().copied());
            }
            2 => drop(bytes.drain(at..end)),
            3 => {
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
            4 if !other.is_empty() => {
                let from = random.below(other.len());
                let piece = &other[from..(from + random.below(64)).min(other.len())];
                bytes.splice(at..end, piece.iter().copied());
            }
            _ => bytes.truncate(at),
        }
    }
}

/// The files of a folder.
fn files(dir: &Path) -> Vec<Vec<u8>> {
    let Ok(entries) = fs::read_dir(dir) else { return Vec::new() };
    let mut paths: Vec<_> = entries.map(|entry| entry.expect("an entry").path()).collect();
    paths.sort();
    paths.retain(|path| !path.to_string_lossy().ends_with(".expected.json"));
    paths.iter().map(|path| fs::read(path).expect("a file")).collect()
}

/// The minimal files of each target: its folder in the corpus, or the golden vectors of the
/// protocol.
fn corpus() -> BTreeMap<&'static str, Vec<Vec<u8>>> {
    let of = |name: &'static str| {
        let folder = match name {
            "observation" => "protocol/vectors/observations".to_owned(),
            "request" => "protocol/vectors/requests".to_owned(),
            name => format!("tests/fuzz/corpus/{name}"),
        };
        (name, files(&root::root().join(folder)))
    };
    targets::TARGETS.iter().map(|(name, _)| of(name)).collect()
}

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

#[test]
fn targets_survive_mutations() {
    let seed = setting("FUZZ_SEED", 1);
    let time = Duration::from_secs(setting("FUZZ_SECONDS", 3));
    let corpus = corpus();
    let only = std::env::var("FUZZ_TARGET").ok();
    let is_chosen = |name: &str| only.as_deref().is_none_or(|only| only == name);
    let chosen = targets::TARGETS.into_iter().filter(|(name, _)| is_chosen(name));
    let count = chosen.clone().count() as u32;
    assert!(count > 0, "no target {only:?}");
    for (name, target) in chosen {
        let files = &corpus[name];
        assert!(!files.is_empty(), "target {name} has no corpus");
        let mut random = Random(seed);
        let end = Instant::now() + time / count;
        let mut rounds = 0;
        // The corpus as it is, and then mutations of it.
        while Instant::now() < end || rounds < files.len() + 50 {
            let mut bytes = files[rounds % files.len()].clone();
            if rounds >= files.len() {
                let other = &files[random.below(files.len())];
                mutate(&mut bytes, other, &mut random);
            }
            let begun = Instant::now();
            let survived = catch_unwind(|| target(&bytes)).is_ok();
            let took = begun.elapsed();
            if !survived || took > Duration::from_secs(2) {
                let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
                panic!("target {name}, seed {seed}, round {rounds}, after {took:?}: {hex}");
            }
            rounds += 1;
        }
    }
}

/// Each target is also one of libFuzzer.
#[test]
fn targets_are_those_of_the_manifest() {
    let manifest = fs::read_to_string(root::root().join("tests/fuzz/Cargo.toml")).unwrap();
    for (name, _) in targets::TARGETS {
        assert!(manifest.contains(&format!("path = \"fuzz_targets/{name}.rs\"")), "{name}");
    }
    assert_eq!(manifest.matches("[[bin]]").count(), targets::TARGETS.len());
}
