//! What a build has without the feature `full`, and that it names the rest. Compiled with and
//! without that feature.

use std::process::{Command, Output};

/// Commands, and the feature that each needs.
const LEFT_OUT: [(&[&str], &str); 16] = [
    (&["actor", "push"], "http"),
    (&["alpasim"], "alpasim"),
    (&["dev", "bisect"], "gpu"),
    (&["dev", "devices"], "gpu"),
    (&["dev", "stress"], "stress"),
    (&["episode"], "suite"),
    (&["eval"], "eval"),
    (&["log"], "log"),
    (&["push"], "http"),
    (&["report"], "report"),
    (&["scenario", "check"], "suite"),
    (&["scenario", "from-log"], "log"),
    (&["scenario", "import"], "convert"),
    (&["train"], "train"),
    (&["twin", "map", "import"], "convert"),
    (&["twin", "views"], "eval"),
];

const BUILD: &str = "cargo build --release --features full";

fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let dir = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.args(arguments).current_dir(dir.path()).env("XDG_DATA_HOME", dir.path());
    command.env("XDG_STATE_HOME", dir.path());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), format!("{}{}", text(stdout), text(stderr)))
}

fn text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes).unwrap()
}

#[test]
fn a_command_is_there_or_says_what_to_build() {
    let (_, help) = run(&["--help"]);
    assert_eq!(help.contains(BUILD), !cfg!(feature = "full"), "{help}");
    for (words, feature) in LEFT_OUT {
        let (code, said) = run(&[words, &["--help"]].concat());
        if cfg!(feature = "full") {
            assert_eq!(code, Some(0), "{words:?}: {said}");
            continue;
        }
        assert_eq!(code, Some(2), "{words:?}: {said}");
        assert!(said.contains(&format!("built without `{feature}`: {BUILD}")), "{said}");
        assert!(help.contains(&words.join(" ")), "{words:?} is not in the help: {help}");
    }
}

#[test]
#[cfg(not(feature = "full"))]
fn an_option_says_what_to_build() {
    for (arguments, feature) in [
        (&["demo", "--backend", "gpu"][..], "gpu"),
        (&["demo", "--gpu-memory-gib", "2"], "gpu"),
        (&["demo", "--off-trajectory", "3", "--backend", "cpu"], "eval"),
        (&["twin", "list", "--twins", "s3://bucket/twins"], "object-store"),
        (&["serve", "--alpasim", "127.0.0.1:0"], "alpasim"),
        (&["serve", "--mcap", "--backend", "cpu"], "mcap"),
        (&["serve", "--backend", "cpu", "--tls-cert", "cert.pem", "--tls-key", "key.pem"], "tls"),
    ] {
        let (code, said) = run(arguments);
        assert_eq!(code, Some(1), "{arguments:?}: {said}");
        assert!(said.contains(&format!("built without `{feature}`: {BUILD}")), "{said}");
    }
}

#[test]
fn an_unknown_command_is_no_command_of_a_feature() {
    let (code, said) = run(&["evil"]);
    assert!(code == Some(2) && said.contains("unrecognized subcommand"), "{said}");
}

#[test]
fn the_demo_drives() {
    let (code, said) = run(&["demo", "--steps", "2", "--backend", "cpu"]);
    assert!(code == Some(0) && said.contains("drove 2 steps of six cameras"), "{said}");
}
