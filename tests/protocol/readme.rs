//! `protocol/README.md` shows messages and bytes that are really so.

use schemars::schema_for;
use serde::de::DeserializeOwned;
use wildcity::protocol::error::Code;
use wildcity::protocol::http;
use wildcity::protocol::message::{Answer, Request};
use wildcity::protocol::observation::ObservationMetadata;

use super::read;

#[test]
fn every_json_example_is_a_message() {
    let page = page();
    let (page, http) = page.split_once("\n## HTTP\n").expect("a section on HTTP");
    let kinds: [Kind; 3] = [
        ("request", parses::<Request>),
        ("answer", parses::<Answer>),
        ("observation", parses::<ObservationMetadata>),
    ];
    // Each request but the two of `open` once, each answer once.
    assert_eq!(counted(page, kinds), [12, 7, 1]);
    let kinds: [Kind; 6] = [
        ("new upload", parses::<http::NewUpload>),
        ("upload", parses::<http::Upload>),
        ("new push", parses::<http::NewPush>),
        ("push", parses::<http::Push>),
        ("rollback", parses::<http::Rollback>),
        ("refusal", parses::<http::Refusal>),
    ];
    assert_eq!(counted(http, kinds), [1, 1, 1, 1, 1, 1]);
}

/// A kind of message, and what keeps a text from being one.
type Kind = (&'static str, fn(&str) -> Option<String>);

/// How many examples there are of each kind; every example is of exactly one.
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
    let (page, frame) = (page(), read("vectors/observations/raw.bin"));
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

/// Every code is explained, and no other.
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

/// The numbers on the page are those of the program.
#[test]
fn limits_are_those_of_the_configuration() {
    use wildcity::config;
    let page = page();
    let poses = config::HISTORY_POSES;
    let seconds = |limit: std::time::Duration| limit.as_secs();
    for row in [
        format!("| `ego.history_xyz` | F32 [{poses}, 3] |"),
        format!("| `ego.history_rot` | F32 [{poses}, 3, 3] |"),
        format!("| poses of one `observe` | {} |", config::OBSERVE_POSES),
        format!("| poses of one `prefetch` | {} |", config::PREFETCH_POSES),
        format!("| poses of one `trajectory` | {} |", config::PATH_POSES),
        format!("| time of a `trajectory` | {} s |", config::PATH_US / 1_000_000),
        format!(
            "±{} m/s², and curvature of the rear axle's way, ±{} 1/m",
            config::EGO_ACCELERATION_M_S2,
            config::EGO_CURVATURE_1_M
        ),
        format!("by at most {:.2} rad", config::EGO_STEERING_RAD),
        format!("Both go {} m/s at most", config::EGO_SPEED_M_S),
        format!("go back, {} m/s at most", config::EGO_REVERSE_M_S),
        format!("recorded drive within {} m", config::GROUND_NEAR_M),
        format!("| cameras of a rig | {} |", wildcity::scene::Rig::MAX_CAMERAS),
        format!("| message to the server | {} MiB |", config::INBOUND_MESSAGE_BYTES >> 20),
        format!("| `hello` after connecting | {} s |", seconds(config::HELLO_TIMEOUT)),
        format!("| silence between requests | {} s |", seconds(config::IDLE_TIMEOUT)),
        format!("| reading an answer | {} s |", seconds(config::SEND_TIMEOUT)),
        format!("| resuming | {} s |", seconds(config::RESUME_GRACE)),
        format!("hears nothing for {} s", seconds(config::ANSWER_TIMEOUT)),
        format!("headers up to {} MiB", config::OBSERVATION_HEADER_BYTES >> 20),
        format!(
            "| uploads kept, and their bytes | {}, {} GiB |",
            config::UPLOADS,
            config::SPOOL_BYTES >> 30
        ),
        format!("| one upload | {} GiB |", config::UPLOAD_BYTES >> 30),
        format!("| silence within an upload | {} s |", seconds(config::UPLOAD_SILENCE)),
        format!(
            "| an upload that nobody goes on with | {} h |",
            seconds(config::UPLOAD_AGE) / 3600
        ),
        format!("| pushes that wait or run | {} |", config::PUSHES),
        format!("| files of a push | {} |", config::PUSH_FILES),
        format!("| poses compared | {} |", config::GOLDEN_POSES),
        format!("frames up to {} GiB", config::OBSERVATION_BYTES as f64 / f64::from(1 << 30)),
    ] {
        assert!(page.contains(&row), "{row}");
    }
    let pixels =
        page.split("all images together | ").nth(1).and_then(|rest| rest.split(' ').next());
    let pixels = pixels.map(|pixels| pixels.replace(',', ""));
    assert_eq!(pixels, Some(config::ANSWER_PIXELS.to_string()));
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

/// What keeps a text from being of a type.
fn parses<T: DeserializeOwned>(text: &str) -> Option<String> {
    serde_json::from_str::<T>(text).err().map(|error| error.to_string())
}
