//! `protocol/schema` is generated from the types.

use schemars::transform::{RecursiveTransform, Transform};
use schemars::{JsonSchema, Schema, schema_for};
use serde_json::Value;
use wildcity_protocol::{http, message, observation};

use super::check_json;

#[test]
fn schemas_are_up_to_date() {
    // The server refuses unknown fields and `null` at any depth; clients ignore unknown fields.
    check_closed::<message::Request>("request");
    check_closed::<http::NewUpload>("new_upload");
    check_closed::<http::NewPush>("new_push");
    check_closed::<http::Rollback>("rollback");
    check_closed::<http::NewEdit>("new_edit");
    check_closed::<http::NewActor>("new_actor");
    check::<message::Answer>("answer");
    check::<message::Drive>("drive");
    check::<observation::ObservationMetadata>("observation");
    check::<observation::ManyMetadata>("many");
    check::<http::Upload>("upload");
    check::<http::Push>("push");
    check::<http::VersionInfo>("version");
    check::<http::MadeVersion>("made_version");
    check::<http::Ground>("ground");
    check::<http::SessionInfo>("session");
    check::<http::Ticket>("ticket");
    check::<http::EpisodeInfo>("episode");
    check::<http::ActorAsset>("actor");
    check::<http::ActorList>("actors");
    check::<http::TwinList>("twins");
    check::<http::Refusal>("refusal");
}

fn check_closed<T: JsonSchema>(name: &str) {
    let mut schema = schema_for!(T);
    RecursiveTransform(closed).transform(&mut schema);
    RecursiveTransform(without_null).transform(&mut schema);
    check_json(&format!("schema/{name}.json"), &schema);
}

fn check<T: JsonSchema>(name: &str) {
    check_json(&format!("schema/{name}.json"), &schema_for!(T));
}

fn closed(schema: &mut Schema) {
    if schema.get("properties").is_some() && schema.get("$ref").is_none() {
        schema.insert("additionalProperties".to_owned(), false.into());
    }
}

/// An option that is not set is left out. schemars says that it may be `null` as well.
fn without_null(schema: &mut Schema) {
    if let Some(Value::Array(types)) = schema.get_mut("type") {
        types.retain(|name| name != "null");
        if let [one] = &types[..] {
            let one = one.clone();
            schema.insert("type".to_owned(), one);
        }
    }
    if let Some(Value::Array(choices)) = schema.get_mut("anyOf") {
        choices.retain(|choice| choice["type"] != "null");
        if let [Value::Object(one)] = &choices[..] {
            let one = one.clone();
            schema.remove("anyOf");
            for (keyword, value) in one {
                schema.insert(keyword, value);
            }
        }
    }
}
