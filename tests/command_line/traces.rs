//! `wildcity serve --otlp-endpoint`.

#[cfg(not(feature = "otlp"))]
#[test]
fn a_program_without_otlp_says_how_to_build_one_with_it() {
    let arguments = ["serve", "--otlp-endpoint", "http://127.0.0.1:4318"];
    let refused = crate::wildcity().args(arguments).output().unwrap();
    let text = String::from_utf8(refused.stderr).unwrap();
    assert!(!refused.status.success() && text.contains("--features full,otlp"), "{text}");
}

#[cfg(feature = "otlp")]
mod with_otlp {
    use std::io::{BufRead, BufReader, Read, Write};
    use std::net::{TcpListener, TcpStream};
    use std::sync::mpsc::{self, Sender};

    use crate::served::Served;
    use crate::support::TEST_TIMEOUT;
    use crate::wildcity;

    /// Reads one request after the other from a connection, and passes on its path and its body.
    fn collect(stream: TcpStream, requests: &Sender<(String, Vec<u8>)>) -> std::io::Result<()> {
        let mut reader = BufReader::new(stream.try_clone()?);
        loop {
            let mut start = String::new();
            if reader.read_line(&mut start)? == 0 {
                return Ok(());
            }
            let mut length = 0;
            loop {
                let mut line = String::new();
                reader.read_line(&mut line)?;
                if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                if line.trim().is_empty() {
                    break;
                }
            }
            let mut body = vec![0; length];
            reader.read_exact(&mut body)?;
            // An empty message is the answer to a request of which everything was accepted.
            (&stream).write_all(b"HTTP/1.1 200 OK\r\ncontent-type: application/x-protobuf\r\ncontent-length: 0\r\n\r\n")?;
            if requests.send((start, body)).is_err() {
                return Ok(());
            }
        }
    }

    #[tokio::test]
    async fn a_collector_gets_the_spans_of_steps() {
        let collector = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("http://{}", collector.local_addr().unwrap());
        let (send, requests) = mpsc::channel();
        std::thread::spawn(move || {
            for stream in collector.incoming().flatten() {
                let send = send.clone();
                std::thread::spawn(move || collect(stream, &send));
            }
        });
        let served = Served::with(&["--otlp-endpoint", &endpoint]);
        served.whole_session(3).await;
        // Stopping sends the rest.
        assert_eq!(served.signal_and_wait(), Some(0));

        // Three steps of two cameras each. A name may be part of another text, too.
        let wanted = [
            ("wildcity", 1),
            ("request", 6),
            ("load", 3),
            ("render", 3),
            ("encode", 6),
            ("record", 3),
            ("step", 3),
        ];
        let mut bytes = Vec::new();
        let count = |bytes: &[u8], text: &str| {
            bytes.windows(text.len()).filter(|window| *window == text.as_bytes()).count()
        };
        while wanted.iter().any(|(name, least)| count(&bytes, name) < *least) {
            let Ok((start, body)) = requests.recv_timeout(TEST_TIMEOUT) else { break };
            assert!(start.starts_with("POST /v1/traces "), "{start}");
            bytes.extend(body);
        }
        for (start, _) in requests.try_iter() {
            assert!(start.starts_with("POST /v1/traces "), "{start}");
        }
        for (name, least) in wanted {
            let found = count(&bytes, name);
            assert!(found >= least, "{name}: {found} times in {} bytes", bytes.len());
        }
    }

    #[test]
    fn what_is_no_endpoint_is_refused() {
        let refused = wildcity().args(["serve", "--otlp-endpoint", "collector"]).output().unwrap();
        let text = String::from_utf8(refused.stderr).unwrap();
        assert!(!refused.status.success() && text.contains("--otlp-endpoint collector"), "{text}");
    }
}
