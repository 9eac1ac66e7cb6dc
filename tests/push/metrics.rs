//! `/metrics` counts the events of one server.

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::http::{get, in_cell, push};
use crate::support::TestServer;

/// The text of `/metrics`, its header included.
pub(crate) async fn scrape(server: &TestServer) -> String {
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let request = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    stream.write_all(request).await.unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).await.unwrap();
    text
}

#[tokio::test]
async fn events_are_counted() {
    let server = TestServer::start().await;
    let idle = TestServer::start().await;
    let mut driver = server.driver("a").await;
    for x in 1..=3 {
        driver.step(f64::from(x)).await;
    }
    get(&server, "/v1/uploads/nothing").await.refused(404, "unknown_upload");
    push(&server, &in_cell([0, 0], 40, 1), |_| {}).await;
    push(&server, &in_cell([1, 0], 1, 1), |_| {}).await;
    let text = scrape(&server).await;
    for line in [
        "wildcity_steps_total 3",
        "wildcity_step_seconds_count 3",
        "wildcity_sessions 1",
        "wildcity_connections 1",
        "wildcity_uploads_begun_total 2",
        "wildcity_uploads 2",
        "wildcity_pushes_open 0",
        "wildcity_frames_queued 0",
        "wildcity_refusals_total{code=\"unknown_upload\"} 1",
        "wildcity_pushes_total{outcome=\"ready\"} 1",
        "wildcity_pushes_total{outcome=\"refused\"} 1",
        "wildcity_residency_failed_damaged_total 0",
        "# EOF",
    ] {
        assert!(text.lines().any(|found| found == line), "no {line:?} in\n{text}");
    }
    assert!(text.contains("application/openmetrics-text"), "{text}");
    let number = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in\n{text}")).parse::<f64>().unwrap()
    };
    assert!(number("wildcity_residency_loads_total") >= 1.0);
    assert!(number("wildcity_residency_held_sections") >= 1.0);
    assert!(number("wildcity_residency_limit_bytes") > 1e6);
    assert!(text.contains("\nwildcity_build_info{version=\""), "{text}");
    // This process has existed for seconds, and has at least the files of the connection.
    assert!(number("process_start_time_seconds") > 1.7e9);
    assert!(number("process_resident_memory_bytes") > 1e6);
    assert!(number("process_cpu_seconds_total") > 0.0);
    assert!(number("process_open_fds") > 3.0 && number("process_max_fds") > 3.0);
    for directory in ["episodes", "uploads", "twins"] {
        assert!(number(&format!("wildcity_disk_free_bytes{{directory=\"{directory}\"}}")) > 1e6);
    }
    assert!(scrape(&idle).await.lines().any(|line| line == "wildcity_steps_total 0"));
}

/// The panels of the dashboard use metrics that the server has.
#[tokio::test]
async fn the_dashboard_names_existing_metrics() {
    let server = TestServer::start().await;
    get(&server, "/v1/uploads/nothing").await.refused(404, "unknown_upload");
    let text = scrape(&server).await;
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/grafana.json");
    let dashboard = std::fs::read_to_string(path).unwrap();
    let mut names: Vec<&str> = dashboard
        .split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'))
        .filter(|word| word.starts_with("wildcity_"))
        .collect();
    names.sort_unstable();
    names.dedup();
    assert!(names.len() > 15, "{names:?}");
    for name in names {
        let is_there = text
            .lines()
            .any(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with([' ', '{'])));
        assert!(is_there, "the server has no metric {name}");
    }
}
