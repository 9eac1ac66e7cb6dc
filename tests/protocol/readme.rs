//! The examples in `protocol/README.md` are valid messages and bytes.

use schemars::schema_for;
use serde::de::DeserializeOwned;
use wildcity_protocol::error::Code;
use wildcity_protocol::message::{Answer, Request};

use super::read;

#[test]
fn every_json_example_is_a_message() {
    let kinds: [Kind; 2] = [("request", parses::<Request>), ("answer", parses::<Answer>)];
    assert_eq!(counted(&page(), kinds), [2, 1]);
}

/// A kind of message, and a parser that returns the error if a text is not one.
type Kind = (&'static str, fn(&str) -> Option<String>);

/// Number of examples of each kind. Every example is of exactly one kind.
fn counted<const N: usize>(page: &str, kinds: [Kind; N]) -> [usize; N] {
    let mut counts = [0; N];
    for example in blocks(page, "json") {
        let errors = kinds.map(|(kind, parses)| (kind, parses(example)));
        let matches = errors.iter().filter(|(_, error)| error.is_none()).count();
        assert_eq!(matches, 1, "{example}\n{errors:#?}");
        for (count, (_, error)) in counts.iter_mut().zip(errors) {
            *count += usize::from(error.is_none());
        }
    }
    counts
}

#[test]
fn the_hex_example_is_the_golden_frame() {
    let page = page();
    let frame = read("vectors/observations/raw.bin");
    let dump: Vec<&str> = blocks(&page, "hex").flat_map(str::lines).collect();
    assert_eq!(dump.len(), 6);
    for line in dump {
        let (offset, bytes) = line.split_once(": ").expect(line);
        let offset = usize::from_str_radix(offset, 16).unwrap();
        let bytes: Vec<u8> =
            bytes.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        assert_eq!(frame[offset..offset + bytes.len()], bytes, "{line}");
    }
    assert!(page.contains("(3,384 bytes) has N = 0x928 = 2,344"));
    assert_eq!((frame.len(), &frame[..8]), (3384, &2344_u64.to_le_bytes()[..]));
}

/// The table of errors has every code, and no other.
#[test]
fn every_error_code_has_its_row() {
    let page = page();
    let section = page.split("\n## Errors").nth(1).expect("a section on errors");
    let section = section.split("\n## ").next().expect("split gives at least one");
    let mut rows: Vec<&str> =
        section.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next()).collect();
    let schema = serde_json::to_value(schema_for!(Code)).unwrap();
    let variants = schema["oneOf"].as_array().expect("one variant per code");
    let mut codes: Vec<&str> = variants.iter().map(|v| v["const"].as_str().unwrap()).collect();
    codes.sort_unstable();
    rows.sort_unstable();
    assert_eq!(rows, codes);
}

fn page() -> String {
    String::from_utf8(read("README.md")).unwrap()
}

/// The fenced blocks of a language.
fn blocks<'a>(page: &'a str, language: &str) -> impl Iterator<Item = &'a str> {
    let fence = format!("```{language}\n");
    page.split("\n```")
        .zip(page.split("\n```").skip(1))
        .map(|(_, block)| block)
        .filter_map(move |block| block.strip_prefix(&fence[3..]))
}

/// The error if a text is not of a type.
fn parses<T: DeserializeOwned>(text: &str) -> Option<String> {
    serde_json::from_str::<T>(text).err().map(|error| error.to_string())
}
