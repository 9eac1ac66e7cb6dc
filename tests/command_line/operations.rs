//! `wildcity doctor`.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Output;

use serde_json::Value;

use crate::{support, wildcity};

fn doctor(twins: &Path, episodes: &Path, uploads: &Path) -> Output {
    let mut command = wildcity();
    command.args(["doctor", "--json", "--twins"]).arg(twins);
    command.arg("--episodes").arg(episodes).arg("--uploads").arg(uploads);
    command.output().unwrap()
}

/// The findings of the doctor about one thing: their levels and texts.
fn about(output: &Output, subject: &str) -> Vec<(String, String)> {
    let findings: Value = serde_json::from_slice(&output.stdout).unwrap();
    let text = |finding: &Value, field: &str| finding[field].as_str().unwrap().to_owned();
    let findings = findings.as_array().unwrap().iter();
    let found = findings.filter(|finding| finding["about"] == subject);
    found.map(|finding| (text(finding, "level"), text(finding, "text"))).collect()
}

#[test]
fn the_doctor_finds_nothing_wrong_with_this_machine() {
    let dir = tempfile::tempdir().unwrap();
    let below = |name: &str| dir.path().join(name);
    let output = doctor(&below("twins"), &below("episodes"), &below("uploads"));
    assert!(output.status.success(), "{output:?}");
    for subject in ["gpu", "processors", "memory", "clock", "episodes", "uploads", "twins"] {
        let found = about(&output, subject);
        assert!(!found.is_empty(), "nothing about {subject}");
        assert!(found.iter().all(|(level, _)| level != "bad"), "{subject}: {found:?}");
    }
    // The checks create no file.
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn the_doctor_names_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let twins = support::twins();
    fs::write(twins.path().join("test/log/0000000002"), "").unwrap();
    let output = doctor(twins.path(), Path::new("/proc/episodes"), dir.path());
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let [(level, text)] = &about(&output, "episodes")[..] else { panic!("{output:?}") };
    assert!(level == "bad" && text.contains("/proc cannot be written"), "{text}");
    let damaged = about(&output, "twins");
    let is_named = |(level, text): &(String, String)| {
        level == "bad" && text.starts_with("test is damaged") && text.contains("fsck test")
    };
    assert!(damaged.iter().any(is_named), "{damaged:?}");
}

#[test]
fn the_doctor_reads_a_configuration() {
    let dir = tempfile::tempdir().unwrap();
    let twins = support::twins();
    let at = |name: &str| dir.path().join(name).display().to_string();
    let certify = |not_after| {
        let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        params.not_after = not_after;
        let key = rcgen::KeyPair::generate().unwrap();
        fs::write(at("cert.pem"), params.self_signed(&key).unwrap().pem()).unwrap();
        fs::write(at("key.pem"), key.serialize_pem()).unwrap();
    };
    let config = |more: &str| {
        let text = format!(
            "listen = \"127.0.0.1:0\"\ntwins = \"{}\"\nepisodes = \"{}\"\nuploads = \"{}\"\n\
             scenarios = \"{}\"\ntokens = \"{}\"\ntls_cert = \"{}\"\ntls_key = \"{}\"\n{more}",
            twins.path().display(),
            at("episodes"),
            at("uploads"),
            at("scenarios"),
            at("tokens.json"),
            at("cert.pem"),
            at("key.pem"),
        );
        fs::write(at("serve.toml"), text).unwrap();
        wildcity().args(["doctor", "--json", "--config"]).arg(at("serve.toml")).output().unwrap()
    };
    let tokens = |token: &str| {
        let text =
            format!(r#"{{"tokens": [{{"name": "a", "role": "drive", "token": "{token}"}}]}}"#);
        fs::write(at("tokens.json"), text).unwrap();
        fs::set_permissions(at("tokens.json"), fs::Permissions::from_mode(0o600)).unwrap();
    };
    tokens("0123456789abcdef");
    certify(rcgen::date_time_ymd(2999, 1, 1));
    let good = config(&format!("audit_log = \"{}\"\n", at("audit.jsonl")));
    assert!(good.status.success(), "{good:?}");
    for subject in ["listen", "tokens", "certificate", "audit log", "scenarios", "twins"] {
        let found = about(&good, subject);
        assert!(!found.is_empty(), "nothing about {subject}");
        assert!(found.iter().all(|(level, _)| level == "ok"), "{subject}: {found:?}");
    }
    assert!(!dir.path().join("audit.jsonl").exists(), "looking creates nothing");

    // Tokens that others can read, and a server that uses the folders, are noted.
    fs::set_permissions(at("tokens.json"), fs::Permissions::from_mode(0o640)).unwrap();
    fs::create_dir_all(at("uploads")).unwrap();
    let lock = fs::File::create(dir.path().join("uploads/lock")).unwrap();
    lock.lock().unwrap();
    let noted = config("");
    assert!(noted.status.success(), "{noted:?}");
    for (subject, wanted) in [("tokens", "mode 640"), ("uploads", "a server uses")] {
        let found = about(&noted, subject);
        let is_noted = |(level, text): &(String, String)| level == "note" && text.contains(wanted);
        assert!(found.iter().any(is_noted), "{found:?}");
    }
    drop(lock);

    tokens("short");
    certify(rcgen::date_time_ymd(2020, 1, 1));
    let bad = config("audit_log = \"/proc/audit.jsonl\"\n");
    assert_eq!(bad.status.code(), Some(1), "{bad:?}");
    for (subject, text) in [
        ("tokens", "at least 16 characters"),
        ("certificate", "expired"),
        ("audit log", "cannot be written"),
    ] {
        let [(level, found)] = &about(&bad, subject)[..] else { panic!("{subject}: {bad:?}") };
        assert!(level == "bad" && found.contains(text), "{found}");
    }
    // A key of another certificate.
    let key = rcgen::KeyPair::generate().unwrap();
    fs::write(at("key.pem"), key.serialize_pem()).unwrap();
    let [(level, found)] = &about(&config(""), "certificate")[..] else { panic!("no certificate") };
    assert!(level == "bad" && found.contains("key.pem"), "{found}");
}

/// The reader of the output has gone, as with `| head`: the exit code is still that of the result.
#[test]
fn a_reader_that_has_gone_is_no_error() {
    let dir = tempfile::tempdir().unwrap();
    let twins = support::twins();
    let unheard = |arguments: &[&str]| {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let mut command = wildcity();
        command.args(arguments).arg("--twins").arg(twins.path()).stdout(writer);
        command.output().unwrap()
    };
    let listed = unheard(&["twin", "list"]);
    assert!(listed.status.success() && listed.stderr.is_empty(), "{listed:?}");
    fs::write(twins.path().join("test/log/0000000002"), "").unwrap();
    let episodes = dir.path().to_str().unwrap();
    let checked = unheard(&["doctor", "--episodes", episodes, "--uploads", episodes]);
    assert_eq!(checked.status.code(), Some(1), "{checked:?}");
    assert!(String::from_utf8_lossy(&checked.stderr).contains("checks failed"), "{checked:?}");
}

#[test]
fn an_old_command_says_what_to_run() {
    for (line, new) in [
        (&["bench", "step", "--help"][..], "cargo run --release -p wildcity-bench -- step --help"),
        (&["inspect", "street", "--json"], "wildcity twin show street --json"),
        (&["replay", "a.jsonl", "--verify"], "wildcity episode verify a.jsonl"),
    ] {
        let output = wildcity().args(line).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(said.contains("has moved") && said.ends_with(&format!("  {new}\n")), "{said}");
    }
}

#[test]
fn rare_options_are_in_the_whole_help_alone() {
    let help = |arguments: &[&str]| {
        let output = wildcity().args(arguments).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    for command in [&["serve"][..], &["twin", "list"], &["render"]] {
        let short = help(&[command, &["--help"]].concat());
        let whole = help(&[command, &["--help-all"]].concat());
        assert!(short.contains("--help-all") && !short.contains("--cache-gib"), "{short}");
        assert!(whole.contains("--cache-gib") && whole.contains("--twins"), "{whole}");
    }
    let whole = help(&["serve", "--help-all"]);
    assert!(whole.contains("--idle-timeout-s") && whole.contains("Limits:"), "{whole}");
    // A command without rare options takes it, too, and does not mention it.
    assert_eq!(help(&["twin", "--help"]), help(&["twin", "--help-all"]));
    assert!(!help(&["twin", "--help"]).contains("--help-all"));
}

#[test]
fn completions_have_every_command_and_option() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let output = wildcity().args(["completions", shell]).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        let script = String::from_utf8(output.stdout).unwrap();
        for word in ["from-colmap", "cache-gib"] {
            assert!(script.contains(word), "{shell}: {word}");
        }
    }
    let syntax = "source /dev/stdin && complete -p wildcity";
    let mut bash = std::process::Command::new("bash");
    bash.args(["-ec", syntax]).stdin(std::process::Stdio::piped());
    let mut running = bash.stdout(std::process::Stdio::piped()).spawn().unwrap();
    let script = wildcity().args(["completions", "bash"]).output().unwrap().stdout;
    std::io::Write::write_all(&mut running.stdin.take().unwrap(), &script).unwrap();
    let completed = running.wait_with_output().unwrap();
    assert!(completed.status.success(), "{completed:?}");
    assert!(String::from_utf8_lossy(&completed.stdout).contains("wildcity"), "{completed:?}");
}
