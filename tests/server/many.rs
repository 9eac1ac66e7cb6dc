//! Several sessions of one connection, and steps of several at once.

use std::sync::atomic::Ordering;

use serde_json::{Value, json};

use crate::episodes::lines;
use crate::replay::replay;
use crate::support::{Agent, Painter, Reply, Seen, TestServer, pose, refused};

/// An answer to `step_many`: its bytes, its metadata, and the observations by session.
pub(crate) struct Many {
    bytes: Vec<u8>,
    answers: Vec<Value>,
    pub(crate) seen: Vec<(String, Seen)>,
}

impl Many {
    fn decode(bytes: &[u8]) -> Self {
        let (header_bytes, header) = safetensors::SafeTensors::read_metadata(bytes).unwrap();
        let text = header.metadata().as_ref().unwrap()["many"].clone();
        let mut many: Value = serde_json::from_str(&text).unwrap();
        let answers = many["answers"].as_array_mut().unwrap().split_off(0);
        let observation = |answer: &Value| {
            let info = header.info(answer["tensor"].as_str()?).unwrap();
            let (start, end) = info.data_offsets;
            assert_eq!(info.shape, [end - start]);
            let frame = bytes[8 + header_bytes..][start..end].to_vec();
            Some((answer["session"].as_str()?.to_owned(), Seen::decode(frame.into())))
        };
        let seen = answers.iter().filter_map(observation).collect();
        Self { bytes: bytes.to_vec(), answers, seen }
    }

    /// Code and field of a refused step.
    fn error(&self, index: usize) -> (&str, &str) {
        let error = &self.answers[index]["error"];
        assert!(error["message"].as_str().is_some_and(|text| !text.is_empty()), "{error}");
        (error["code"].as_str().unwrap(), error["field"].as_str().unwrap())
    }
}

impl Agent {
    pub(crate) async fn step_many(&mut self, steps: Value) -> Many {
        self.send(json!({ "type": "step_many", "steps": steps })).await;
        match self.receive().await {
            Reply::Binary(bytes) => Many::decode(&bytes),
            other => panic!("{other:?}"),
        }
    }
}

fn to(session: &str, x_m: f64) -> Value {
    json!({ "session": session, "pose": pose(x_m) })
}

/// Opens a teleporting session, one with a bundle of frames, and a car.
async fn open_three(agent: &mut Agent, names: [&str; 3]) {
    let raw = json!({ "encoding": "raw", "depth": true });
    agent.open(json!({ "session": names[0], "outputs": raw })).await;
    let bundle = json!({ "encoding": "png", "frames": 2 });
    agent.open(json!({ "session": names[1], "outputs": bundle })).await;
    let car = json!({ "model": "dynamic", "speed": 3.0 });
    agent.open(json!({ "session": names[2], "dynamics": car, "outputs": raw })).await;
}

fn three(names: [&str; 3], k: u32) -> [Value; 3] {
    let action = json!({ "acceleration": 0.5, "curvature": 0.05 });
    [
        to(names[0], f64::from(k)),
        to(names[1], 0.5 * f64::from(k)),
        json!({ "session": names[2], "action": action, "until_us": 200_000, "notes": {"k": k} }),
    ]
}

/// Values that must not depend on the kind of request.
fn facts(seen: &Seen) -> Value {
    let mut meta = seen.meta.clone();
    for name in ["seq", "session", "timings", "residency"] {
        meta.as_object_mut().unwrap().remove(name);
    }
    meta
}

#[tokio::test]
async fn steps_of_several_sessions_are_those_of_single_steps() {
    let server = TestServer::start().await;
    let names = ["a", "b", "c"];
    let singles = ["x", "y", "z"];
    let mut agent = server.agent().await;
    open_three(&mut agent, names).await;
    let mut single = server.agent().await;
    open_three(&mut single, singles).await;
    for k in 1..=4 {
        let many = agent.step_many(json!(three(names, k))).await;
        let order: Vec<_> = many.seen.iter().map(|(name, _)| &**name).collect();
        assert_eq!(order, names);
        for (request, (_, seen)) in three(singles, k).into_iter().zip(&many.seen) {
            let mut request = request;
            request["type"] = "step".into();
            let alone = single.look(request).await;
            assert_eq!(facts(&alone), facts(seen));
            assert_eq!(seen.meta["seq"], agent.seq - 1);
            let one = alone.tensors();
            let other = seen.tensors();
            assert_eq!(one.len(), other.len());
            for (name, tensor) in one.tensors() {
                assert_eq!(other.tensor(&name).unwrap(), tensor, "{name}");
            }
        }
    }
    // The records are the same, and are rendered again.
    for (name, alone) in names.into_iter().zip(singles) {
        let path = |name: &str| server.episodes.path().join(format!("{name}-1.jsonl"));
        let many = lines(&path(name));
        let single = lines(&path(alone));
        assert_eq!(many[1..], single[1..], "{name}");
        let steps = many.iter().filter(|line| line["kind"] == "frame").count();
        assert_eq!(steps, 4);
        let report = replay(&server, &path(name), &Painter::default()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None), "{name}");
        assert!(report.images >= 8);
    }
}

/// A session that is refused does not stop the others, and is as it was before.
#[tokio::test]
async fn one_refusal_does_not_stop_the_others() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    open_three(&mut agent, ["a", "b", "c"]).await;
    agent.open(json!({ "session": "d" })).await;
    agent
        .look(json!({ "type": "step", "session": "d", "pose": pose(1.0), "terminate": true }))
        .await;
    let tilted = json!({ "xyz": [0, 0, 0], "q": [1, 1, 0, 0] });
    let action = |curvature| json!({ "acceleration": 0, "curvature": curvature });
    let bad = [
        (json!({ "session": "a", "pose": tilted }), "pose_invalid", "pose.q"),
        (json!({ "session": "a", "action": action(0.0) }), "session_state", "action"),
        (json!({ "session": "c", "action": action(9.0) }), "out_of_range", "action.curvature"),
        (json!({ "session": "c", "pose": pose(1.0) }), "session_state", "pose"),
        (
            json!({ "session": "c", "action": action(0.0), "until_us": 1 }),
            "out_of_range",
            "until_us",
        ),
        (json!({ "session": "d", "pose": pose(2.0) }), "session_state", "session"),
        (json!({ "session": "e", "pose": pose(2.0) }), "unknown_session", "session"),
    ];
    for (k, (step, code, field)) in bad.into_iter().enumerate() {
        let many = agent.step_many(json!([to("b", k as f64), step])).await;
        assert_eq!(many.seen.len(), 1);
        assert_eq!(many.seen[0].1.meta["step"], k + 1);
        assert_eq!(many.error(1), (code, &*format!("steps[1].{field}")));
        assert!(many.answers[1].get("tensor").is_none());
    }
    // All refused: the answer is still one of `step_many`.
    let many = agent.step_many(json!([to("d", 1.0), to("e", 1.0)])).await;
    assert_eq!((many.seen.len(), many.answers.len()), (0, 2));
    // A frame that fails is its own session's.
    server.painter.too_many.store(true, Ordering::SeqCst);
    let many = agent.step_many(json!([to("a", 1.0), to("b", 9.0)])).await;
    assert_eq!(many.seen.len(), 1);
    let refused = many.answers.iter().find_map(|answer| answer.get("error")).unwrap();
    assert_eq!(refused["code"], "answer_too_large");
    // The refused steps have changed nothing.
    let all = agent.step_many(json!(three(["a", "b", "c"], 1))).await;
    assert_eq!(all.seen[2].1.meta["step"], 2, "the first steps of the car");
    let drawn: u64 =
        all.seen[..2].iter().map(|(_, seen)| seen.meta["step"].as_u64().unwrap()).sum();
    assert_eq!(drawn, 1 + 7 + 2, "{drawn}");
}

/// A list that is not one is refused whole: no session is stepped.
#[tokio::test]
async fn a_wrong_list_steps_nothing() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    refused(
        &agent.ask(json!({ "type": "step_many", "steps": [to("a", 1.0)] })).await,
        "session_state",
    );
    agent.open(json!({ "session": "a" })).await;
    agent.open(json!({ "session": "b" })).await;
    let none = json!({ "session": "b" });
    let both = json!({ "session": "b", "pose": pose(1.0), "action": { "acceleration": 0, "curvature": 0 } });
    let unknown = json!({ "session": "b", "pose": pose(1.0), "speed": 3 });
    let holed = json!({ "session": "b", "pose": { "xyz": [0, null, 0], "q": [1, 0, 0, 0] } });
    let many: Vec<Value> = (0..65).map(|k| to(&format!("s{k}"), 1.0)).collect();
    let first = to("a", 1.0);
    for (steps, code, field) in [
        (json!([]), "out_of_range", "steps"),
        (json!(many), "out_of_range", "steps"),
        (json!([first, to("a", 2.0)]), "invalid_name", "steps[1].session"),
        (json!([first, to("../b", 2.0)]), "invalid_name", "steps[1].session"),
        (json!([first, { "pose": pose(1.0) }]), "invalid_request", "steps[1].session"),
        (json!([first, none]), "invalid_request", "steps[1].pose"),
        (json!([first, both]), "invalid_request", "steps[1].action"),
        (json!([first, unknown]), "invalid_request", "steps[1].speed"),
        (json!([first, holed]), "pose_not_finite", "steps[1].pose.xyz[1]"),
        (json!({ "a": first }), "invalid_request", "steps"),
    ] {
        let answer = agent.ask(json!({ "type": "step_many", "steps": steps })).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
    }
    let many = agent.step_many(json!([to("a", 1.0), to("b", 1.0)])).await;
    assert!(many.seen.iter().all(|(_, seen)| seen.meta["step"] == 1));
}

#[tokio::test]
async fn the_answer_is_repeated_and_survives_the_connection() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "session": "a" })).await;
    agent.open(json!({ "session": "b" })).await;
    let steps = json!([to("a", 1.0), to("b", 2.0), to("c", 2.0)]);
    let first = agent.step_many(steps.clone()).await;
    let begun = server.painter.begun.load(Ordering::SeqCst);
    agent.seq -= 1;
    assert_eq!(agent.step_many(steps.clone()).await.bytes, first.bytes);

    // The answer was lost: both sessions are resumed, and the request repeated.
    let seq = agent.seq - 1;
    drop(agent);
    let mut agent = server.agent().await;
    let resume = json!({ "type": "resume", "session": "b", "last_seq": seq - 1, "also": ["a"] });
    let resumed = agent.ask(resume).await;
    assert_eq!(
        (&resumed["type"], &resumed["last_seq"]),
        (&"resumed".into(), &seq.into()),
        "{resumed}"
    );
    let also = &resumed["also"][0];
    assert_eq!((&also["session"], &also["step"]), (&json!("a"), &json!(1)));
    assert_eq!(also["opened"]["session"], "a");
    agent.seq = seq;
    assert_eq!(agent.step_many(steps).await.bytes, first.bytes);
    assert_eq!(server.painter.begun.load(Ordering::SeqCst), begun, "nothing was drawn again");
    let next = agent.step_many(json!([to("b", 3.0), to("a", 3.0)])).await;
    assert!(next.seen.iter().all(|(_, seen)| seen.meta["step"] == 2));

    // The answer to `close` of one of them was lost.
    let closed = agent.ask(json!({ "type": "close", "session": "a" })).await;
    let seq = agent.seq - 1;
    drop(agent);
    let mut agent = server.agent().await;
    let resume = json!({ "type": "resume", "session": "b", "last_seq": seq - 1 });
    assert_eq!(agent.ask(resume).await["last_seq"], seq);
    agent.seq = seq;
    assert_eq!(agent.ask(json!({ "type": "close", "session": "a" })).await, closed);
    assert_eq!(agent.step(4.0).await.meta["step"], 3);
}

/// Sessions of other connections, or that are over, are not resumed with the first, which then
/// still can be.
#[tokio::test]
async fn what_cannot_be_resumed_together() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.open(json!({ "session": "b" })).await;
    drop(agent);
    let mut other = server.driver("c").await;
    for x_m in 0..5 {
        other.step(f64::from(x_m)).await;
    }
    drop(other);
    for (also, code, field) in [
        (json!(["c"]), "seq_out_of_order", "also[0]"),
        (json!(["b", "d"]), "unknown_session", "also[1]"),
        (json!(["b", "b"]), "invalid_name", "also[1]"),
        (json!(["a"]), "invalid_name", "also[0]"),
        (json!(["B"]), "invalid_name", "also[0]"),
    ] {
        let mut agent = server.agent().await;
        let resume = json!({ "type": "resume", "session": "a", "last_seq": 1, "also": also });
        let answer = agent.ask(resume).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
    }
    let mut agent = server.agent().await;
    let resume = json!({ "type": "resume", "session": "a", "last_seq": 2, "also": ["b"] });
    assert_eq!(agent.ask(resume).await["type"], "resumed");
    agent.seq = 3;
    assert_eq!(agent.step_many(json!([to("a", 1.0), to("b", 1.0)])).await.seen.len(), 2);
    // Another client resumes one of them: the connection loses both.
    let mut thief = server.agent().await;
    let resume = json!({ "type": "resume", "session": "b", "last_seq": 3 });
    assert_eq!(thief.ask(resume).await["type"], "resumed");
    let Reply::Text(told) = agent.receive().await else { panic!("no notification") };
    refused(&told, "session_state");
    agent.closed().await;
    let mut agent = server.agent().await;
    let resume = json!({ "type": "resume", "session": "a", "last_seq": 3 });
    assert_eq!(agent.ask(resume).await["type"], "resumed");
}

/// With one session requests need no name. With several they do.
#[tokio::test]
async fn requests_name_their_session() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let named = |session: &str| json!({ "type": "step", "session": session, "pose": pose(1.0) });
    refused(&agent.ask(named("a")).await, "session_state");
    agent.open(json!({ "session": "a" })).await;
    refused(&agent.try_open(json!({})).await, "session_state");
    assert_eq!(agent.step(1.0).await.meta["session"], "a");
    assert_eq!(agent.look(named("a")).await.meta["session"], "a");
    agent.open(json!({ "session": "b" })).await;
    for request in [
        json!({ "type": "step", "pose": pose(1.0) }),
        json!({ "type": "observe", "poses": [pose(1.0)] }),
        json!({ "type": "prefetch", "poses": [pose(1.0)] }),
        json!({ "type": "reset" }),
        json!({ "type": "switch_version" }),
        json!({ "type": "snapshot", "name": "here" }),
        json!({ "type": "restore", "name": "here" }),
        json!({ "type": "close" }),
    ] {
        let answer = agent.ask(request.clone()).await;
        refused(&answer, "invalid_request");
        assert_eq!(answer["field"], "session", "{answer}");
        for (session, code) in [("c", "unknown_session"), ("C", "invalid_name")] {
            let mut request = request.clone();
            request["session"] = session.into();
            let answer = agent.ask(request).await;
            refused(&answer, code);
            assert_eq!(answer["field"], "session", "{answer}");
        }
    }
    assert_eq!(agent.look(json!({ "type": "reset", "session": "b" })).await.meta["session"], "b");
    let snapshot = json!({ "type": "snapshot", "session": "a", "name": "here" });
    assert_eq!(agent.ask(snapshot).await["type"], "ok");
    agent.look(named("a")).await;
    let back = json!({ "type": "restore", "session": "a", "name": "here" });
    assert_eq!(agent.look(back).await.meta["step"], 2);
    let branch = json!({
        "type": "branch", "from": { "session": "a", "snapshot": "here" }, "session": "d",
    });
    assert_eq!(agent.ask(branch).await["type"], "opened");
    assert_eq!(agent.look(named("d")).await.meta["step"], 3);
    for session in ["a", "d"] {
        let closed = agent.ask(json!({ "type": "close", "session": session })).await;
        assert_eq!(closed["type"], "closed", "{closed}");
    }
    assert_eq!(agent.step(1.0).await.meta["session"], "b");
    assert_eq!(server.running.sessions(), 1);
    drop(agent);
    server.still_serves().await;
}

#[tokio::test]
async fn a_connection_has_at_most_64_sessions() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    for k in 0..64 {
        agent.open(json!({ "session": format!("s{k}") })).await;
    }
    // No overload, which another attempt could find gone.
    let answer = agent.try_open(json!({ "session": "s64" })).await;
    refused(&answer, "out_of_range");
    let said = answer["message"].as_str().unwrap();
    assert!(said.contains("after 64 on this connection"), "{said}");
    let steps: Vec<Value> = (0..64).map(|k| to(&format!("s{k}"), f64::from(k))).collect();
    let many = agent.step_many(json!(steps)).await;
    assert_eq!(many.seen.len(), 64);
    for (k, (name, seen)) in many.seen.iter().enumerate() {
        assert_eq!((&**name, &seen.meta["step"]), (&*format!("s{k}"), &json!(1)));
        assert_eq!(seen.meta["ego"]["pose"]["xyz"][0], k as f64);
    }
    drop(agent);
    server.still_serves().await;
}

/// Images that do not fit one message are refused before a session is stepped.
#[tokio::test]
async fn the_answers_together_have_a_size() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let camera = json!({
        "name": "c", "width": 8192, "height": 8192, "fx": 8, "fy": 8, "cx": 4, "cy": 4,
        "camera_to_rig": pose(0.0),
    });
    let rig = json!({ "name": "r", "cameras": [camera] });
    let names = ["a", "b", "c"];
    for name in names {
        agent.open(json!({ "session": name, "rig": rig })).await;
    }
    let steps: Vec<Value> = names.iter().map(|name| to(name, 1.0)).collect();
    let answer = agent.ask(json!({ "type": "step_many", "steps": steps })).await;
    refused(&answer, "answer_too_large");
    assert_eq!(answer["field"], "steps");
    assert_eq!(server.painter.begun.load(Ordering::SeqCst), 0);
}
