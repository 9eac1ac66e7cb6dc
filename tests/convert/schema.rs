//! `src/sim/schema` is generated from the types. After a change run
//! `WILDCITY_BLESS=1 cargo test -p wildcity-convert --test convert schema`, and review the
//! difference.

use schemars::transform::{RecursiveTransform, Transform};
use schemars::{Schema, schema_for};
use serde_json::json;
use wildcity_sim::map::MapFile;
use wildcity_sim::scenario::{ScenarioFile, TracksFile};

use crate::generated;

#[test]
fn schemas_of_files_are_up_to_date() {
    let mut scenario = schema_for!(ScenarioFile);
    RecursiveTransform(swept).transform(&mut scenario);
    check("scenario", scenario);
    check("tracks", schema_for!(TracksFile));
    check("map", schema_for!(MapFile));
}

/// Every object may have a note, and every number may be a value of the sweep. The types of
/// `wildcity-options` do not say that files have no other fields.
fn swept(schema: &mut Schema) {
    if schema.get("properties").is_some() && schema.get("additionalProperties").is_none() {
        schema.insert("additionalProperties".to_owned(), false.into());
    }
    if let Some(properties) = schema.get_mut("properties").and_then(|value| value.as_object_mut()) {
        properties
            .insert("note".to_owned(), json!({"type": "string", "description": "A comment."}));
    }
    let is_number = |name: &str| matches!(name, "number" | "integer");
    let kind = schema.get("type").cloned();
    let numeric = match &kind {
        Some(serde_json::Value::String(name)) => is_number(name),
        Some(serde_json::Value::Array(names)) => {
            names.iter().any(|name| name.as_str().is_some_and(is_number))
        }
        _ => false,
    };
    if numeric && let Some(kind) = kind {
        let mut kinds = match kind {
            serde_json::Value::Array(kinds) => kinds,
            one => vec![one],
        };
        kinds.push(json!("string"));
        schema.insert("type".to_owned(), kinds.into());
        // Of a text; numbers have no pattern.
        schema.insert("pattern".to_owned(), json!("^\\$."));
    }
}

fn check(name: &str, schema: Schema) {
    let mut text = serde_json::to_string_pretty(&schema).unwrap();
    text.push('\n');
    let file = format!("src/sim/schema/{name}.json");
    generated::check(&file, &text, "-p wildcity-convert --test convert schema");
}
