//! `wss://` and `https://`, against servers with a certificate that this test makes.

use std::sync::Arc;

use rcgen::{CertifiedKey, generate_simple_self_signed};
use rustls::ServerConfig;
use rustls::crypto::ring;
use rustls::pki_types::PrivateKeyDer;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio_rustls::TlsAcceptor;
use wildcity_client::{
    Client, ClientError, ConnectOptions, HttpClient, HttpError, Open, Pose, PushState,
};

use super::fake_server::{FakeServer, Reply};

const PUSH: &str =
    r#"{"id": "p1", "twin": "street", "state": "queued", "progress": {"done": 0, "total": 0}}"#;

/// A server's side of TLS for `localhost`, and a client's options that trust it.
fn certified() -> (TlsAcceptor, ConnectOptions) {
    let CertifiedKey { cert, signing_key } =
        generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
    let key = PrivateKeyDer::try_from(signing_key.serialize_der()).unwrap();
    let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![cert.der().clone()], key)
        .unwrap();
    let root_certificates_pem = cert.pem().into_bytes();
    let trusting = ConnectOptions { root_certificates_pem, ..ConnectOptions::default() };
    (TlsAcceptor::from(Arc::new(config)), trusting)
}

#[tokio::test]
async fn wss_carries_a_session_and_reconnects() {
    let (acceptor, trusting) = certified();
    let first = vec![Reply::Golden("welcome"), Reply::Golden("opened"), Reply::HangUp];
    let second = vec![
        Reply::Golden("welcome"),
        Reply::Text(
            r#"{"type":"resumed","seq":1,"session":"run-17","last_seq":1,"step":0,"time_us":0}"#
                .into(),
        ),
        Reply::Observation(0),
    ];
    let server = FakeServer::start_tls(vec![first, second], acceptor).await;
    let mut client = Client::connect_with(&server.url, "test", &trusting).await.unwrap();
    client.open(Open::twin("street")).await.unwrap();
    let pose = Pose { xyz: [1.0, 2.0, 3.0], q: [1.0, 0.0, 0.0, 0.0] };
    let lost = client.step(pose).await;
    assert!(matches!(lost, Err(ClientError::Disconnected(_))), "{lost:?}");
    client.reconnect().await.unwrap();
    let observation = client.step(pose).await.unwrap();
    assert_eq!(observation.camera("front").unwrap().rgb().unwrap()[..3], [10, 5, 3]);
}

#[tokio::test]
async fn wss_refuses_certificates_that_it_cannot_trust() {
    let (acceptor, trusting) = certified();
    let server = FakeServer::start_tls(vec![vec![Reply::Golden("welcome")]], acceptor).await;
    // Signed by no authority that the system knows, and for another host than 127.0.0.1.
    let by_address = server.url.replace("localhost", "127.0.0.1");
    for (url, options) in [(&server.url, &ConnectOptions::default()), (&by_address, &trusting)] {
        let refused = Client::connect_with(url, "test", options).await;
        let Err(ClientError::Connect { reason, .. }) = refused else {
            panic!("{url} was trusted: {refused:?}");
        };
        assert!(reason.contains("certificate"), "{reason}");
    }
    // The server is well: a client that trusts it connects.
    Client::connect_with(&server.url, "test", &trusting).await.unwrap();
}

#[tokio::test]
async fn https_carries_requests() {
    let (acceptor, trusting) = certified();
    let url = https_server(acceptor).await;
    let trusting = ConnectOptions { token: Some("secret".to_owned()), ..trusting };
    let client = HttpClient::new(&url, &trusting).unwrap();
    assert_eq!(client.push_status("street", "p1").await.unwrap().state, PushState::Queued);

    let stranger = HttpClient::new(&url, &ConnectOptions::with_token(trusting.token)).unwrap();
    let refused = stranger.push_status("street", "p1").await;
    let Err(HttpError::NoAnswer { reason, .. }) = refused else {
        panic!("the certificate was trusted: {refused:?}");
    };
    assert!(reason.contains("certificate"), "{reason}");
}

#[test]
fn unusable_root_certificates_are_named() {
    let broken = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
    for (pem, expected) in [("no certificate", "holds no certificate"), (broken, "damaged")] {
        let options =
            ConnectOptions { root_certificates_pem: pem.into(), ..ConnectOptions::default() };
        let error = HttpClient::new("https://localhost", &options).unwrap_err();
        assert!(matches!(error, HttpError::Tls { .. }), "{error:?}");
        assert!(error.to_string().contains(expected), "{error}");
        // Without TLS nothing needs them.
        HttpClient::new("http://localhost:8080", &options).unwrap();
    }
}

/// Answers every request for a push with [`PUSH`], and gives its address.
async fn https_server(acceptor: TlsAcceptor) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("https://localhost:{}", listener.local_addr().unwrap().port());
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            let Ok(mut stream) = acceptor.accept(stream).await else { continue };
            let mut head = Vec::new();
            while !head.ends_with(b"\r\n\r\n") {
                head.push(stream.read_u8().await.unwrap());
            }
            let head = String::from_utf8(head).unwrap().to_lowercase();
            assert!(head.starts_with("get /v1/twins/street/pushes/p1 http/1.1\r\n"), "{head}");
            assert!(head.contains("authorization: bearer secret\r\n"), "{head}");
            let length = PUSH.len();
            let answer = format!("HTTP/1.1 200 OK\r\nContent-Length: {length}\r\n\r\n{PUSH}");
            stream.write_all(answer.as_bytes()).await.unwrap();
            stream.shutdown().await.unwrap();
        }
    });
    url
}
