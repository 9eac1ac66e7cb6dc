//! The most that one message of a client, or one request of a route, may cost.
//!
//! Each number follows from the constants of the code. `docs/reference/costs.md` is generated from
//! this table, and a message or a route without a row fails a test.

use std::time::Duration;

use wildcity_protocol::limits as protocol;
use wildcity_session::limits as session;
use wildcity_sim::limits as sim;

use crate::cost_table::{Cost, Page, cost};
use crate::limits;

/// Bytes of JSON in memory for each byte of its text: `[0],` takes 4 bytes as text, and a list with
/// room for four values as a value, beside the text and its copy.
const PARSED: u64 = 48;

/// Bytes of a step of an actor in a record.
const ACTOR_LINE_BYTES: u64 = 200;

const NONE: Duration = Duration::ZERO;
const MESSAGE: u64 = protocol::INBOUND_MESSAGE_BYTES as u64;
const JSON: u64 = PARSED * MESSAGE;
const ANSWER: u64 = session::OBSERVATION_BYTES as u64;
const STEP: Duration = session::STEP_TIMEOUT;
const PLAN_RECORD: u64 = session::PLAN_STEPS as u64 * sim::ACTORS as u64 * ACTOR_LINE_BYTES
    + session::NOTES_BYTES as u64;
const HEAD_RECORD: u64 = wildcity_episode::limits::HEAD_BYTES as u64
    + wildcity_episode::limits::SCENARIO_LINE_BYTES as u64;
/// A scenario as a value, once more with its values, and each object with its types.
const SCENARIO: u64 = 2 * PARSED * sim::SCENARIO_BYTES as u64 + sim::SCENARIO_OBJECTS as u64 * 1024;
/// 12 bytes a pixel while overlays are decoded.
const OVERLAYS: u64 = 12 * (1 << 24);
/// A scenario and a map at a time as values; maps as outlines, and as an answer.
const PLAN: u64 =
    SCENARIO + PARSED * session::PLANNED_MAP_BYTES as u64 + 4 * session::PLANNED_MAPS_BYTES as u64;
const LIST: u64 = limits::LISTED_EPISODES as u64 * 1024;

/// Messages over the WebSocket.
const MESSAGES: [Cost; 15] = [
    cost("hello", JSON, NONE, 0, "a message"),
    cost("open", JSON + SCENARIO + OVERLAYS, STEP, 0, "scenario, overlays; `ANSWERS_BYTES` in all"),
    cost("branch", JSON, STEP, 0, "two records are read at once"),
    cost("resume", JSON, NONE, 0, "a message"),
    cost("reset", JSON + ANSWER, STEP, HEAD_RECORD, "an answer; the head of a record"),
    cost("step", JSON + ANSWER, STEP, PLAN_RECORD, "an answer; a plan of 1000 steps, 256 actors"),
    cost("step_many", JSON + ANSWER, STEP, 64 * PLAN_RECORD, "an answer; 64 sessions"),
    cost("observe", JSON + ANSWER, STEP, MESSAGE, "an answer"),
    cost("restore", JSON + ANSWER, STEP, HEAD_RECORD, "an answer; the head of a record"),
    cost("snapshot", JSON, NONE, 0, "the state of a session, at most 64 times"),
    cost("switch_version", JSON, STEP, 0, "the worst frame, reserved"),
    cost("prefetch", JSON, NONE, 0, "loads in the background, as room is left"),
    cost("share_memory", JSON + 3 * ANSWER, NONE, 0, "three slots, counted once they are written"),
    cost("close", JSON, STEP, PLAN_RECORD, "the result of the episode"),
    cost("error", 0, NONE, 0, "never sent by a client"),
];

const CHECK: Duration = wildcity_push::limits::CHECK_TIMEOUT;
const MIB: u64 = 1 << 20;

/// Routes, by method and path.
const ROUTES: [Cost; 35] = [
    cost("GET /", MIB, NONE, 0, "the page of the viewer"),
    cost("GET /viewer.js", MIB, NONE, 0, "a file of the viewer"),
    cost("GET /style.css", MIB, NONE, 0, "a file of the viewer"),
    cost("GET /icon.svg", MIB, NONE, 0, "a file of the viewer"),
    cost("GET /healthz", 0, NONE, 0, "a constant"),
    cost("GET /readyz", MIB, NONE, 0, "the list of twins, once a second"),
    cost("GET /metrics", MIB, NONE, 0, "names of metrics are fixed"),
    cost("GET /v1/openapi.json", MIB, NONE, 0, "a constant"),
    cost("GET /v1/session", MESSAGE, NONE, 0, "a connection"),
    cost("GET /v1/sessions", MIB, NONE, 0, "256 sessions"),
    cost("GET /v1/sessions/{session}/watch", ANSWER, NONE, 0, "the newest observation, shared"),
    cost("POST /v1/tickets", 1024, NONE, 0, "32 tickets of a token"),
    cost("GET /v1/episodes", LIST + 4 * MIB, NONE, 0, "one tail of a record at a time"),
    cost("GET /v1/episodes/{episode}", limits::EPISODE_BYTES, NONE, 0, "counts as an answer"),
    cost("GET /v1/episodes/{episode}/mcap", limits::EPISODE_BYTES, NONE, 0, "counts as an answer"),
    cost("GET /v1/twins", 2 * MIB, NONE, 0, "summaries, kept"),
    cost("GET /v1/twins/{twin}", 2 * MIB, NONE, 0, "a summary, kept"),
    cost("GET /v1/twins/{twin}/versions", MIB, NONE, 0, "the log of a twin"),
    cost("GET /v1/twins/{twin}/trajectories/{name}", 32 * MIB, NONE, 0, "a part of a drive"),
    cost("GET /v1/twins/{twin}/ground", 2 * MIB, CHECK, 0, "reads a twin; counts as a push"),
    cost("POST /v1/twins/{twin}/edits", JSON, CHECK, MIB, "counts as a push"),
    cost("POST /v1/twins/{twin}/rollback", JSON, NONE, MIB, "a record of the log"),
    cost("POST /v1/twins/{twin}/pushes", JSON, CHECK, limits::UPLOAD_BYTES, "`--push-memory-gib`"),
    cost("GET /v1/twins/{twin}/pushes/{id}", MIB, NONE, 0, "a push"),
    cost("DELETE /v1/twins/{twin}/pushes/{id}", 0, NONE, 0, "a mark"),
    cost("GET /v1/scenarios", MIB, NONE, 0, "4 KiB of a file at a time"),
    cost(
        "GET /v1/twins/{twin}/scenarios",
        PLAN,
        NONE,
        0,
        "one at a time; 256 scenarios, maps of 16 MiB",
    ),
    cost("GET /v1/actors", MIB, NONE, 0, "assets"),
    cost("GET /v1/actors/{actor}", MIB, NONE, 0, "an asset"),
    cost("POST /v1/actors", JSON, CHECK, limits::UPLOAD_BYTES, "counts as a push"),
    cost(
        "POST /v1/uploads",
        JSON,
        NONE,
        limits::ANNOUNCEMENT_BYTES,
        "reserves 16 MiB of the spool",
    ),
    cost("HEAD /v1/uploads/{id}", 0, NONE, 0, "an upload"),
    cost("GET /v1/uploads/{id}", 0, NONE, 0, "an upload"),
    cost(
        "PATCH /v1/uploads/{id}",
        6 * MIB,
        NONE,
        limits::UPLOAD_BYTES,
        "parts of 1 MiB, and what is received meanwhile",
    ),
    cost("DELETE /v1/uploads/{id}", 0, NONE, 0, "an upload"),
];

fn page() -> Page {
    Page {
        from: "src/server/routes/costs.rs",
        test: "-p wildcity-server --lib costs",
        title: "Costs",
        introduction: "The most that one message or one request may cost, from the constants of the code. Memory is in \
            addition to what the session or the server has reserved before; a time is that of a processor, off the threads \
            that answer.",
        tables: vec![("Messages", &MESSAGES), ("Routes", &ROUTES)],
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::generated;
    use crate::routes::table;

    #[test]
    fn the_page_is_that_of_the_code() {
        let page = page();
        generated::check("docs/reference/costs.md", &page.text(), page.test);
    }

    #[test]
    fn every_message_and_every_route_has_its_cost() {
        let schema = include_str!("../../../protocol/schema/request.json");
        let schema: serde_json::Value = serde_json::from_str(schema).unwrap();
        let mut types = BTreeSet::new();
        collect_types(&schema, &mut types);
        let known: BTreeSet<&str> = MESSAGES.iter().map(|cost| cost.of).collect();
        let missing: Vec<_> = types.iter().filter(|name| !known.contains(name.as_str())).collect();
        assert!(types.len() > 10 && missing.is_empty(), "no row of {missing:?}");
        let routes: BTreeSet<String> = table::rows()
            .iter()
            .map(|row| {
                let method = format!("{:?}", row.operation.method).to_uppercase();
                format!("{method} {}", row.operation.path)
            })
            .collect();
        let known: BTreeSet<String> = ROUTES.iter().map(|cost| cost.of.to_owned()).collect();
        assert_eq!(routes, known);
    }

    /// The values of `type` that a request may have.
    fn collect_types(value: &serde_json::Value, types: &mut BTreeSet<String>) {
        if let Some(name) = value.pointer("/properties/type/const").and_then(|name| name.as_str()) {
            types.insert(name.to_owned());
        }
        match value {
            serde_json::Value::Object(fields) => {
                fields.values().for_each(|field| collect_types(field, types));
            }
            serde_json::Value::Array(items) => {
                items.iter().for_each(|item| collect_types(item, types));
            }
            _ => {}
        }
    }
}
