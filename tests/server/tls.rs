//! TLS, and a certificate that changes while the server runs.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, CertifiedKey, DnType, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, generate_simple_self_signed,
};
use wildcity_client::{Client, ConnectOptions, Open, Pose};
use wildcity_server::{Config, ServerError, TlsFiles};

use crate::support::{TEST_TIMEOUT, TestServer};

/// Writes a new certificate for 127.0.0.1, and returns a client's options that trust only this
/// certificate.
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

    // Returns when the files have been read.
    let hang_up = async || {
        let before = server.running.reloads();
        let status = Command::new("kill").args(["-HUP", &std::process::id().to_string()]).status();
        assert!(status.unwrap().success());
        let read = async {
            while server.running.reloads() == before {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(TEST_TIMEOUT, read).await.expect("a SIGHUP that was carried out");
    };
    // A damaged file leaves the certificate as it is.
    fs::write(dir.path().join("cert.pem"), "nothing").unwrap();
    hang_up().await;
    assert!(drives(&url, &first).await);
    let second = certify(dir.path());
    hang_up().await;
    assert!(drives(&url, &second).await);
    assert!(!drives(&url, &first).await);
}

/// curl and Python's ssl trust the server by its private authority, and by nothing else.
#[tokio::test(flavor = "multi_thread")]
async fn other_clients_trust_a_private_authority() {
    let dir = tempfile::tempdir().unwrap();
    let mut authority = CertificateParams::new(Vec::new()).unwrap();
    authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    authority.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    // With equal names OpenSSL takes the server's certificate as signed by itself.
    authority.distinguished_name.push(DnType::CommonName, "test authority");
    let authority_key = KeyPair::generate().unwrap();
    let root = authority.self_signed(&authority_key).unwrap();
    let issuer = Issuer::new(authority, authority_key);
    let key = KeyPair::generate().unwrap();
    let names = vec!["127.0.0.1".to_owned(), "localhost".to_owned()];
    let mut cert = CertificateParams::new(names).unwrap();
    // Python requires the key identifier of the signer.
    cert.use_authority_key_identifier_extension = true;
    let cert = cert.signed_by(&key, &issuer).unwrap();
    fs::write(dir.path().join("ca.pem"), root.pem()).unwrap();
    fs::write(dir.path().join("cert.pem"), cert.pem()).unwrap();
    fs::write(dir.path().join("key.pem"), key.serialize_pem()).unwrap();
    let tls = files(dir.path());
    let server = TestServer::configured(|config| config.tls = Some(tls)).await;
    let port = server.address().port();
    let ca = dir.path().join("ca.pem").display().to_string();
    let curl = |arguments: &[&str]| {
        let mut command = Command::new("curl");
        command.args(["--silent", "--output", "/dev/null", "--write-out", "%{http_code}"]);
        let url = format!("https://localhost:{port}/v1/twins");
        let output = command.args(["--noproxy", "*"]).args(arguments).arg(url).output();
        let output = output.expect("this test needs curl");
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    assert_eq!(curl(&["--cacert", &ca]), (Some(0), "200".to_owned()));
    // 60: the peer's certificate cannot be verified.
    assert_eq!(curl(&[]).0, Some(60));
    let foreign = ["--cacert", &ca, "--header", "Origin: https://evil.example.org"];
    assert_eq!(curl(&foreign), (Some(0), "403".to_owned()));
    let host = ["--cacert", &ca, "--header", "Host: evil.example.org"];
    assert_eq!(curl(&host), (Some(0), "403".to_owned()));

    let script = "import socket, ssl, sys\n\
        port, ca, origin = int(sys.argv[1]), sys.argv[2] or None, sys.argv[3]\n\
        raw = socket.create_connection(('127.0.0.1', port))\n\
        tls = ssl.create_default_context(cafile=ca).wrap_socket(raw, server_hostname='localhost')\n\
        lines = ['GET /v1/session HTTP/1.1', 'Host: localhost', 'Connection: Upgrade', \
        'Upgrade: websocket', 'Sec-WebSocket-Version: 13', 'Sec-WebSocket-Protocol: wildcity.v1', \
        'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==', f'Origin: {origin}', '', '']\n\
        tls.sendall('\\r\\n'.join(lines).encode())\n\
        print(tls.recv(4096).split()[1].decode())\n";
    let python = |ca: &str, origin: &str| {
        let mut command = Command::new("python3");
        command.args(["-c", script, &port.to_string(), ca, origin]);
        let output = command.output().expect("this test needs python3");
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        (String::from_utf8(output.stdout).unwrap().trim().to_owned(), error)
    };
    assert_eq!(python(&ca, "https://localhost:1"), ("101".to_owned(), String::new()));
    assert_eq!(python(&ca, "https://evil.example.org").0, "403");
    let (answer, error) = python("", "https://localhost:1");
    assert!(answer.is_empty() && error.contains("CERTIFICATE_VERIFY_FAILED"), "{answer} {error}");
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
