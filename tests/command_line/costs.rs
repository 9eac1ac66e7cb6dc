//! The table of costs, measured: a server of its own gets the worst message or request of each row,
//! and its memory, its processor time and what it writes to the disk are compared with the row.
#![cfg(target_os = "linux")]

use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;

use data_encoding::BASE64;
use image::{GrayImage, ImageFormat};
use serde_json::{Value, json};

use wildcity_client::{ConnectOptions, HttpClient};
use wildcity_session::limits::{LONGEST_POLL, NOTES_BYTES};

use crate::http;
use crate::root::root;
use crate::served::Served;
use crate::support::{Agent, Reply, pose, refused};

const MIB: u64 = 1 << 20;

/// Pages of code that run for the first time, and of threads that start.
const FIRST_TIME: u64 = 4 * MIB;

/// Largest message that a server receives.
const MESSAGE_BYTES: usize = wildcity_protocol::limits::INBOUND_MESSAGE_BYTES;

/// What a row allows.
#[derive(Clone, Copy)]
struct Row {
    memory_bytes: u64,
    time_s: f64,
    disk_bytes: u64,
}

/// The rows of the page, which is that of the code.
fn rows() -> BTreeMap<String, Row> {
    let page = fs::read_to_string(root().join("docs/reference/costs.md")).unwrap();
    let rows = page.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| `")?.split(" | ");
        let of = cells.next()?.trim_end_matches('`').to_owned();
        let [memory_mib, time_s, disk_mib]: [f64; 3] =
            [cells.next()?, cells.next()?, cells.next()?].map(|cell| cell.parse().unwrap_or(-1.0));
        let bytes = |mib: f64| (mib * MIB as f64) as u64;
        let row = Row { memory_bytes: bytes(memory_mib), time_s, disk_bytes: bytes(disk_mib) };
        (time_s >= 0.0).then_some((of, row))
    });
    let rows: BTreeMap<String, Row> = rows.collect();
    assert!(rows.len() > 40, "only {} rows can be read", rows.len());
    rows
}

/// What a server took for some work, and the most that a poll took in it.
struct Taken {
    memory_bytes: u64,
    time_s: f64,
    disk_bytes: u64,
    poll_s: f64,
}

async fn taken<T>(served: &Served, work: impl Future<Output = T>) -> Taken {
    served.forget_peak();
    let memory = served.rss();
    let time_s = served.processor_s();
    let disk = served.disk_bytes();
    work.await;
    let memory_bytes = served.peak().saturating_sub(memory);
    let time_s = served.processor_s() - time_s;
    let disk_bytes = served.disk_bytes().saturating_sub(disk);
    let poll_s = metric(served, "wildcity_poll_longest_seconds").await;
    Taken { memory_bytes, time_s, disk_bytes, poll_s }
}

/// A number of `/metrics`.
async fn metric(served: &Served, name: &str) -> f64 {
    let reply = http::send(served.address, "GET /metrics HTTP/1.1", b"").await;
    assert_eq!(reply.status, 200);
    let line = reply.text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.unwrap().parse().unwrap()
}

/// Fails if some work took more than its row allows.
fn check(of: &str, row: Row, taken: &Taken) {
    let Taken { memory_bytes, time_s, disk_bytes, poll_s } = *taken;
    let in_mib = |bytes: u64| bytes as f64 / MIB as f64;
    let [mib, most_mib] = [memory_bytes, row.memory_bytes].map(in_mib);
    let [disk_mib, most_disk_mib] = [disk_bytes, row.disk_bytes].map(in_mib);
    eprintln!(
        "{of}: {mib:.1} of {most_mib:.1} MiB, {time_s:.2} of {} s, {disk_mib:.2} of {most_disk_mib:.1} MiB on the disk, \
         longest poll {:.1} ms",
        row.time_s,
        poll_s * 1e3
    );
    assert!(memory_bytes <= row.memory_bytes + FIRST_TIME, "{of}: {mib:.1} of {most_mib:.1} MiB");
    // The page has tenths.
    assert!(
        disk_bytes <= row.disk_bytes + MIB / 10,
        "{of}: {disk_mib:.2} of {most_disk_mib:.1} MiB on the disk"
    );
    // Whole seconds, rounded down.
    assert!(time_s < row.time_s + 1.0, "{of}: {time_s} s of a processor");
}

/// Measures a row on servers of its own. Up to three times, until no poll is long: a system that
/// stops the thread which holds a lock makes those late that wait for it.
async fn measure(of: &str, row: Row, work: impl AsyncFn(&Served) -> Taken) {
    for _ in 0..3 {
        let taken = work(&Served::start()).await;
        check(of, row, &taken);
        if taken.poll_s <= LONGEST_POLL.as_secs_f64() {
            return;
        }
    }
    panic!("{of}: a task holds a thread that answers requests for more than {LONGEST_POLL:?}");
}

/// JSON of a size that takes the most memory for its bytes.
fn dense_json(bytes: usize) -> String {
    format!("[{}[0]]", "[0],".repeat(bytes / 4 - 2))
}

async fn greeted(served: &Served) -> Agent {
    let mut agent = Agent::connect(served.address).await;
    agent.hello().await;
    agent
}

/// Sends the text of a request, and waits for whatever comes.
async fn send_text(agent: &mut Agent, text: &str) {
    agent.send_text(text).await;
    agent.seq += 1;
    let _answer = agent.receive().await;
}

/// The largest message of each type, which the server has to parse to refuse it.
#[tokio::test]
async fn the_largest_messages_cost_what_the_table_says() {
    for (of, row) in rows() {
        if of.contains(' ') || of == "error" {
            continue;
        }
        let largest = async |served: &Served| {
            let mut agent = greeted(served).await;
            agent.open(json!({})).await;
            agent.step(1.0).await;
            let mut junk = format!(r#"{{"type":"{of}","seq":{},"junk":"#, agent.seq);
            junk.push_str(&dense_json(MESSAGE_BYTES - junk.len() - 2));
            junk.push('}');
            assert!((MESSAGE_BYTES - 8..=MESSAGE_BYTES).contains(&junk.len()));
            taken(served, send_text(&mut agent, &junk)).await
        };
        measure(&of, row, largest).await;
    }
}

/// An `open` with the largest scenario, and one with the largest overlay.
#[tokio::test]
async fn the_worst_open_costs_what_the_table_says() {
    let row = rows()["open"];
    // As many values as a scenario may have after its sweep.
    let scenario = json!({ "format": "wildcity.scenario/1", "name": "wide", "twin": { "name": "test" },
        "actors": vec![json!(["$v"]); 10_000], "sweep": { "v": ["x".repeat(90)] } });
    let mut file = Cursor::new(Vec::new());
    GrayImage::new(4096, 4096).write_to(&mut file, ImageFormat::Png).unwrap();
    let overlay = format!("data:image/png;base64,{}", BASE64.encode(&file.into_inner()));
    let camera = camera("front", 4096, Some(overlay));
    for (of, more) in [
        ("open, a scenario", json!({ "scenario": scenario })),
        ("open, an overlay", json!({ "rig": { "name": "large", "cameras": [camera] } })),
    ] {
        let served = Served::start();
        let mut agent = greeted(&served).await;
        let taken = taken(&served, agent.try_open(more)).await;
        check(of, row, &taken);
    }
}

fn camera(name: &str, side_px: u32, overlay: Option<String>) -> Value {
    let mut camera = json!({ "name": name, "width": side_px, "height": side_px,
        "fx": side_px, "fy": side_px, "cx": side_px / 2, "cy": side_px / 2,
        "camera_to_rig": { "xyz": [0, 0, 1.5], "q": [0.5, -0.5, 0.5, -0.5] } });
    if let Some(overlay) = overlay {
        camera["overlay"] = overlay.into();
    }
    camera
}

/// Answers of an eighth of the largest size: the row has their share of an answer, beside what the
/// session has reserved. And a step whose simulation takes as long as it may.
#[tokio::test]
async fn the_worst_answers_cost_what_the_table_says() {
    const PART: u64 = 8;
    let rows = rows();
    let served = Served::start();
    let mut agent = greeted(&served).await;
    let cameras: Vec<_> = ["a", "b", "c", "d"].map(|name| camera(name, 1024, None)).into();
    let outputs = json!({ "encoding": "raw", "depth": true, "opacity": true });
    let rig = json!({ "name": "large", "cameras": cameras });
    agent.open(json!({ "rig": rig, "outputs": outputs })).await;
    let reserved = metric(&served, "wildcity_residency_reserved_bytes").await as u64;
    for (of, request) in [
        (
            "observe",
            json!({ "type": "observe", "poses": [pose(1.0), pose(2.0), pose(3.0), pose(4.0)] }),
        ),
        (
            "step",
            json!({ "type": "step", "pose": pose(1.0), "notes": "n".repeat(NOTES_BYTES - 2) }),
        ),
        ("reset", json!({ "type": "reset" })),
    ] {
        let row = rows[of];
        let row = Row { memory_bytes: row.memory_bytes / PART + reserved, ..row };
        let looked = async {
            agent.send(request).await;
            let Reply::Binary(bytes) = agent.receive().await else { panic!("no observation") };
            assert!(bytes.len() as u64 > 40 * MIB, "{of}: {} bytes", bytes.len());
        };
        let taken = taken(&served, looked).await;
        check(&format!("{of}, an eighth"), row, &taken);
    }
}

#[tokio::test]
async fn the_longest_simulation_costs_what_the_table_says() {
    let row = rows()["step"];
    let served = Served::start();
    let mut agent = greeted(&served).await;
    let attacker = |index: usize| {
        let xyz = [(index % 16) as f64 * 2.5, (index / 16) as f64 * 2.5, 0.0];
        let attack = json!({ "pose": { "xyz": xyz, "q": [1, 0, 0, 0] }, "speed": 6, "ticks": 1 });
        json!({ "name": format!("a{index}"), "size": [2.0, 1.0, 1.5], "attack": attack })
    };
    let crowd = json!({ "format": "wildcity.scenario/1", "name": "crowd", "twin": { "name": "test" },
        "ego": { "dynamics": { "model": "kinematic" } },
        "actors": (0..256).map(attacker).collect::<Vec<_>>() });
    let rig = json!({ "name": "small", "cameras": [camera("a", 16, None)] });
    agent.open(json!({ "scenario": crowd, "deadline_ms": 1000, "rig": rig })).await;
    let longest = json!({ "type": "step", "action": { "acceleration": 0, "curvature": 0 },
                          "until_us": 60_000_000 });
    let taken = taken(&served, async {
        let answer = agent.ask(longest).await;
        refused(&answer, "deadline_exceeded");
    });
    let taken = taken.await;
    // Its deadline, and not that of the server.
    check("step, a minute of 256 actors", Row { time_s: 1.0 + 1.0, ..row }, &taken);
}

/// A record of this many bytes, of an episode that was driven.
async fn write_records(served: &Served, count: usize, bytes: u64) {
    served.whole_session(2).await;
    let first = fs::read_dir(served.episodes.path()).unwrap().find_map(|entry| {
        let path = entry.unwrap().path();
        path.extension().is_some_and(|extension| extension == "jsonl").then_some(path)
    });
    let text = fs::read_to_string(first.unwrap()).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let (last, before) = lines.split_last().unwrap();
    let (step, head) = before.split_last().unwrap();
    let mut step: Value = serde_json::from_str(step).unwrap();
    step["notes"] = json!({ "text": "n".repeat(60_000) });
    let step = step.to_string();
    let mut record = head.join("\n");
    while (record.len() as u64) < bytes - step.len() as u64 - 1000 {
        record.push('\n');
        record.push_str(&step);
    }
    record = format!("{record}\n{last}\n");
    for number in 1..=count {
        fs::write(served.episodes.path().join(format!("large-{number}.jsonl")), &record).unwrap();
    }
}

/// Every route with a body that the server has to parse, and those whose answer is large.
#[tokio::test]
async fn the_worst_requests_cost_what_the_table_says() {
    let junk = format!(r#"{{"junk":{}}}"#, dense_json(MESSAGE_BYTES - 100));
    for (of, row) in rows() {
        let Some((method, path)) = of.split_once(' ') else { continue };
        if NOT_REQUESTS.contains(&&*of) {
            continue;
        }
        let worst = async |served: &Served| {
            if path.starts_with("/v1/episodes") {
                let (count, bytes) =
                    if path == "/v1/episodes" { (20, 12 * MIB) } else { (1, 60 * MIB) };
                write_records(served, count, bytes).await;
            }
            if path.ends_with("/mcap") {
                let file = served.episodes.path().join("large-1.mcap");
                fs::write(file, vec![b'm'; 60 << 20]).unwrap();
            }
            if path.ends_with("{actor}") {
                generate_actors(served);
            }
            let upload = upload(served).await;
            let id = if path.contains("/pushes/") { push(served).await } else { upload };
            let path = path
                .replace("{actor}", &first_actor(served).await)
                .replace("{twin}", "test")
                .replace("{name}", "log")
                .replace("{episode}", "large-1")
                .replace("{id}", &id);
            let part = vec![0; UPLOAD_BYTES];
            let (headers, body): (&str, &[u8]) = match method {
                "POST" => ("", junk.as_bytes()),
                "PATCH" => ("\r\nUpload-Offset: 0", &part),
                _ => ("", b""),
            };
            let head =
                format!("{method} {path} HTTP/1.1\r\nContent-Length: {}{headers}", body.len());
            // Not found would cost nothing.
            let asked = async {
                let reply = http::send(served.address, &head, body).await;
                assert!(![401, 404, 405].contains(&reply.status), "{of}: {}", reply.head);
            };
            taken(served, asked).await
        };
        measure(&of, row, worst).await;
    }
}

/// Routes that the test of requests leaves out: a test of its own, a shared answer, and
/// `tests/server/scenarios.rs`.
const NOT_REQUESTS: [&str; 3] =
    ["GET /v1/session", "GET /v1/sessions/{session}/watch", "GET /v1/twins/{twin}/scenarios"];

#[tokio::test]
async fn connections_cost_what_the_table_says() {
    let rows = rows();
    let [connection, ..] = NOT_REQUESTS;
    let connect = async |served: &Served| {
        // The first one runs much code for the first time.
        drop(greeted(served).await);
        taken(served, greeted(served)).await
    };
    measure(connection, rows[connection], connect).await;
}

/// The assets that come with the program.
fn generate_actors(served: &Served) {
    let generate =
        crate::wildcity().args(["actor", "generate", "--twins"]).arg(served.dir()).output();
    assert!(generate.unwrap().status.success());
}

/// The hash of an asset; none before there are any.
async fn first_actor(served: &Served) -> String {
    let listed = http::send(served.address, "GET /v1/actors HTTP/1.1", b"").await;
    listed.body["actors"][0]["hash"].as_str().unwrap_or("none").to_owned()
}

/// Begins a push, and returns its id.
async fn push(served: &Served) -> String {
    let address = format!("http://{}", served.address);
    let client = HttpClient::new(&address, &ConnectOptions::default()).unwrap();
    let scene = crate::scene_files::gaussians(1_000, 0, 8.0, 1);
    let scene = http::write(served.dir(), "scene.ply", &scene);
    let uploaded = client.upload(&scene, &mut |_, _| {}).await.unwrap();
    let begun = client.push("test", &http::new_push(&[&uploaded.id])).await.unwrap();
    // Its own cost is that of another row.
    client.wait_for_push(begun, &mut |_| {}).await.unwrap().id
}

/// Bytes of an upload.
const UPLOAD_BYTES: usize = 32 << 20;

/// Announces an upload, and returns its id.
async fn upload(served: &Served) -> String {
    let body = json!({ "name": "a.ply", "size": UPLOAD_BYTES, "digest": format!("blake3:{}", "0".repeat(64)) });
    let body = body.to_string();
    let head = format!("POST /v1/uploads HTTP/1.1\r\nContent-Length: {}", body.len());
    let reply = http::send(served.address, &head, body.as_bytes()).await;
    reply.body["id"].as_str().unwrap_or_else(|| panic!("{reply:?}")).to_owned()
}
