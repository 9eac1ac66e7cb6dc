//! A table of bad requests: each has exactly one code and one field, and changes nothing.

use serde_json::{Value, json};

use crate::support::{Agent, Reply, TestServer};

const POSE: &str = r#"{"xyz":[0,0,0],"q":[1,0,0,0]}"#;

/// A line of the table.
struct Row {
    number: usize,
    code: &'static str,
    field: Option<&'static str>,
    request: &'static str,
}

/// The rows of each section, by its name.
fn table() -> Vec<(&'static str, Vec<Row>)> {
    let mut sections: Vec<(&str, Vec<Row>)> = Vec::new();
    for (index, line) in include_str!("bad_requests.txt").lines().enumerate() {
        if let Some(name) = line.strip_prefix("## ") {
            sections.push((name, Vec::new()));
            continue;
        }
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let mut parts = line.splitn(3, '|').map(str::trim);
        let [Some(code), Some(field), Some(request)] = [parts.next(), parts.next(), parts.next()]
        else {
            panic!("line {}: {line}", index + 1);
        };
        let field = Some(field).filter(|field| *field != "-");
        let row = Row { number: index + 1, code, field, request };
        sections.last_mut().expect("a section").1.push(row);
    }
    sections
}

/// The text of a request with the next number.
fn text(request: &str, seq: u64) -> String {
    let open = r#"{"type":"open","seq":N,"twin":"test""#;
    let camera =
        r#""name":"c","width":8,"height":8,"fx":8,"fy":8,"cx":4,"cy":4,"camera_to_rig":POSE"#;
    let step = r#"{"type":"step","seq":N,"pose":"#;
    let action = r#"{"type":"step","seq":N,"action":"#;
    let whole = match request.strip_prefix("RIG") {
        Some(camera) => format!(r#"OPEN,"rig":{{"name":"r","cameras":[{camera}]}}}}"#),
        None => request.to_owned(),
    };
    let macros = [("OPEN", open), ("CAM", camera), ("STEP", step), ("CAR", action), ("POSE", POSE)];
    let whole = macros.iter().fold(whole, |text, (name, body)| text.replace(name, body));
    let number = format!(r#""seq":{seq}"#);
    whole.replace(r#""seq":N"#, &number)
}

#[tokio::test]
async fn every_bad_request_has_its_code_and_field() {
    let server = TestServer::start().await;
    let mut wrong = Vec::new();
    let mut count = 0;
    for (section, rows) in table() {
        let (mut agent, next) = connect_agent(&server, section).await;
        for Row { number, code, field, request } in rows {
            let text = text(request, agent.seq);
            agent.send_text(&text).await;
            let Reply::Text(answer) = agent.receive().await else {
                panic!("line {number}: {request} was accepted")
            };
            let seq = answer["seq"].as_u64();
            let has_seq = text.contains(&format!(r#""seq":{}"#, agent.seq));
            let is_json = code != "malformed_json" && text.starts_with('{');
            let is_right = answer["type"] == "error"
                && answer["code"] == code
                && answer["field"] == json!(field)
                && answer["fatal"] == false
                && (!is_json || !has_seq || seq == Some(agent.seq) || field == Some("seq"));
            let message = answer["message"].as_str().unwrap_or_default();
            // Whole words: the random id of a session may contain any of these digits.
            let rust = ["u64", "i64", "f64", "u8", "usize", "enum", "struct", "tuple"];
            let mut words = message.split(|c: char| !c.is_alphanumeric());
            if !is_right || words.any(|word| rust.contains(&word)) {
                wrong.push(format!("line {number}: {request}\n    {answer}"));
            }
            count += 1;
        }
        // The refused requests have changed nothing.
        next(agent).await;
    }
    assert!(wrong.is_empty(), "{} of {count}:\n{}", wrong.len(), wrong.join("\n"));
    assert!(count >= 580, "{count}");
    server.still_serves().await;
}

type Check = fn(Agent) -> std::pin::Pin<Box<dyn Future<Output = ()>>>;

/// A client in the state of a section, and a check that it still is.
async fn connect_agent(server: &TestServer, section: &str) -> (Agent, Check) {
    fn hello(mut agent: Agent) -> std::pin::Pin<Box<dyn Future<Output = ()>>> {
        Box::pin(async move { assert_eq!(agent.hello().await["type"], "welcome") })
    }
    fn open(mut agent: Agent) -> std::pin::Pin<Box<dyn Future<Output = ()>>> {
        Box::pin(async move {
            agent.open(json!({})).await;
        })
    }
    fn step(mut agent: Agent) -> std::pin::Pin<Box<dyn Future<Output = ()>>> {
        Box::pin(async move { assert_eq!(agent.step(1.0).await.meta["step"], 1) })
    }
    fn drive(mut agent: Agent) -> std::pin::Pin<Box<dyn Future<Output = ()>>> {
        Box::pin(async move {
            let action = json!({ "acceleration": 1, "curvature": 0 });
            let seen = agent.look(json!({ "type": "step", "action": action })).await;
            assert_eq!(seen.meta["step"], 1);
        })
    }
    let opened = |more: Value| async move {
        let mut agent = server.agent().await;
        agent.open(more).await;
        agent
    };
    match section {
        "fresh" => (Agent::connect(server.address()).await, hello),
        "welcomed" => (server.agent().await, open),
        "teleport" => (opened(json!({})).await, step),
        "car" => (opened(json!({ "dynamics": "dynamic" })).await, drive),
        "warm" => (opened(json!({ "warm_up_us": 200_000 })).await, step),
        other => panic!("section {other}"),
    }
}

/// Requests that earlier servers refused or misread, and valid ones.
#[tokio::test]
async fn integers_may_have_a_point_or_an_exponent() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent
        .send_text(
            r#"{"type":"open","seq":1.0,"twin":"test","dt_us":1e5,"seed":7.0,"deadline_ms":2E4,
               "outputs":{"quality":9e1}}"#,
        )
        .await;
    let Reply::Text(opened) = agent.receive().await else { panic!("no text") };
    assert_eq!(opened["type"], "opened", "{opened}");
    let found = [&opened["dt_us"], &opened["seed"], &opened["deadline_ms"]];
    assert_eq!(found, [&json!(100_000), &json!(7), &json!(20_000)]);
    agent.seq = 2;
    assert_eq!(agent.step(1.0).await.meta["seq"], 2);
}

/// 100,000 brackets, opened alone, opened and closed, and within a field.
#[tokio::test]
async fn deep_nesting_is_malformed_json() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let open = "[".repeat(100_000);
    let close = "]".repeat(100_000);
    let object = r#"{"a":"#.repeat(100_000) + "1" + &"}".repeat(100_000);
    for text in [
        open.clone(),
        format!("{open}{close}"),
        object,
        format!(r#"{{"type":"open","seq":2,"twin":{open}{close}}}"#),
        format!(r#"{{"type":"step","seq":2,"pose":{POSE},"more":{open}{close}}}"#),
    ] {
        agent.send_text(&text).await;
        let Reply::Text(answer) = agent.receive().await else { panic!("no text") };
        assert_eq!(answer["code"], "malformed_json", "{answer}");
    }
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
}
