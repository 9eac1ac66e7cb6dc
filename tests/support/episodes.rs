//! A recorded episode, intact or modified.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::Path;

use serde_json::{Value, json};

use crate::support::{Agent, pose};

/// An episode of ten steps, one `observe`, and a rotation that no f64 quaternion represents
/// exactly.
pub(crate) async fn drive(agent: &mut Agent) {
    for step in 0..10 {
        agent.step(f64::from(step) * 0.7).await;
    }
    let turned = json!({ "xyz": [0.1, 0.2, 0.3], "q": [0.9, 0.1, -0.3, 0.3] });
    agent.look(json!({ "type": "observe", "poses": [pose(4.0), turned] })).await;
    agent.ask(json!({ "type": "close" })).await;
}

/// Changes one hex digit of the hash of an image, in a line counted from 0.
pub(crate) fn tamper(path: &Path, line: usize, image: usize) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let mut value: serde_json::Value = serde_json::from_str(&lines[line]).unwrap();
    let mut hash = value["images"][image].as_str().unwrap().to_owned();
    let digit = if hash.starts_with('0') { "1" } else { "0" };
    hash.replace_range(..1, digit);
    value["images"][image] = hash.into();
    lines[line] = value.to_string();
    std::fs::write(path, lines.join("\n") + "\n").unwrap();
}

/// The lines of a recorded episode.
pub(crate) fn lines(path: &std::path::Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.ends_with('\n'), "{text}");
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}
