//! `protocol/schema` is generated from the types.

use schemars::transform::{RecursiveTransform, Transform};
use schemars::{JsonSchema, Schema, schema_for};
use wildcity_protocol::{http, message, observation};

use super::check_json;

#[test]
fn schemas_are_up_to_date() {
    // The server refuses unknown fields at any depth; clients ignore them.
    check_closed::<message::Request>("request");
    check_closed::<http::NewUpload>("new_upload");
    check_closed::<http::NewPush>("new_push");
    check_closed::<http::Rollback>("rollback");
    check::<message::Answer>("answer");
    check::<message::Drive>("drive");
    check::<observation::ObservationMetadata>("observation");
    check::<http::Upload>("upload");
    check::<http::Push>("push");
    check::<http::VersionInfo>("version");
    check::<http::SessionInfo>("session");
    check::<http::EpisodeInfo>("episode");
    check::<http::Refusal>("refusal");
}

fn check_closed<T: JsonSchema>(name: &str) {
    let mut schema = schema_for!(T);
    RecursiveTransform(closed).transform(&mut schema);
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
