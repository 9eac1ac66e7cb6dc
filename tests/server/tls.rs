//! TLS, and a certificate that changes while the server runs.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use rcgen::{CertifiedKey, generate_simple_self_signed};
use wildcity_client::{Client, ConnectOptions, Open, Pose};
use wildcity_server::{Config, ServerError, TlsFiles};

use crate::support::{TEST_TIMEOUT, TestServer};

/// Writes a new certificate for 127.0.0.1, and returns a client's options that trust it alone.
fn certify(dir: &Path) -> ConnectOptions {
    let CertifiedKey { cert, signing_key } =
        generate_simple_self_signed(vec!["127.0.0.1".to_owned()]).unwrap();
    fs::write(dir.join("key.pem"), signing_key.serialize_pem()).unwrap();
    fs::write(dir.join("cert.pem"), cert.pem()).unwrap();
    let root_certificates_pem = cert.pem().into_bytes();
    ConnectOptions { root_certificates_pem, ..ConnectOptions::default() }
}

fn files(dir: &Path) -> TlsFiles {
    TlsFiles { cert: dir.join("cert.pem"), key: dir.join("key.pem") }
}

async fn drives(url: &str, options: &ConnectOptions) -> bool {
    let Ok(mut client) = Client::connect_with(url, "test", options).await else { return false };
    client.open(Open::twin("test")).await.unwrap();
    let pose = Pose { xyz: [1.0, 0.0, 0.0], q: [1.0, 0.0, 0.0, 0.0] };
    assert_eq!(client.step(pose).await.unwrap().metadata().step, 1);
    client.close().await.unwrap();
    true
}

#[tokio::test]
async fn a_session_over_tls_and_a_new_certificate_at_sighup() {
    let dir = tempfile::tempdir().unwrap();
    let first = certify(dir.path());
    let tls = files(dir.path());
    let server = TestServer::configured(|config| config.tls = Some(tls)).await;
    let url = server.running.url();
    assert!(url.starts_with("wss://127.0.0.1:"), "{url}");
    assert!(server.running.page().starts_with("https://"), "{}", server.running.page());
    assert!(drives(&url, &first).await);
    // The other end of a connection with TLS may be another machine.
    let sharing = ConnectOptions { shared_memory: true, ..first.clone() };
    let refused = Client::connect_with(&url, "test", &sharing).await.unwrap_err();
    assert!(refused.to_string().contains("the connection has TLS"), "{refused}");
    // Neither without trust nor without TLS.
    assert!(!drives(&url, &ConnectOptions::default()).await);
    assert!(!drives(&url.replace("wss:", "ws:"), &first).await);

    let hang_up = || {
        let status = Command::new("kill").args(["-HUP", &std::process::id().to_string()]).status();
        assert!(status.unwrap().success());
    };
    // A damaged file leaves the certificate as it is.
    fs::write(dir.path().join("cert.pem"), "nothing").unwrap();
    hang_up();
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(drives(&url, &first).await);
    let second = certify(dir.path());
    hang_up();
    let changed = async {
        while !drives(&url, &second).await {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, changed).await.expect("the new certificate");
    assert!(!drives(&url, &first).await);
}

#[tokio::test]
async fn unusable_certificates_are_named() {
    let dir = tempfile::tempdir().unwrap();
    certify(dir.path());
    let other = tempfile::tempdir().unwrap();
    certify(other.path());
    let server = TestServer::start().await;
    let missing = dir.path().join("missing.pem");
    for (tls, named) in [
        (TlsFiles { cert: missing, ..files(dir.path()) }, "missing.pem: "),
        (
            TlsFiles { cert: dir.path().join("key.pem"), ..files(dir.path()) },
            "key.pem: there is no certificate",
        ),
        (TlsFiles { key: dir.path().join("cert.pem"), ..files(dir.path()) }, "cert.pem: "),
        (TlsFiles { key: other.path().join("key.pem"), ..files(dir.path()) }, "key.pem: "),
    ] {
        let config = Config { tls: Some(tls), ..server.config() };
        let refused = wildcity_server::start(config).await.unwrap_err();
        assert!(matches!(refused, ServerError::Tls(_)), "{refused}");
        assert!(refused.to_string().contains(named), "{refused}");
    }
}
