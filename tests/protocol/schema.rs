//! `protocol/schema` is what the types say.

use schemars::transform::{RecursiveTransform, Transform};
use schemars::{JsonSchema, Schema, schema_for};
use wildcity::protocol::{message, observation};

use super::check_json;

#[test]
fn schemas_are_fresh() {
    // The server refuses unknown fields, at any depth; clients ignore them.
    let mut request = schema_for!(message::Request);
    RecursiveTransform(closed).transform(&mut request);
    check_json("schema/request.json", &request);
    check::<message::Answer>("answer");
    check::<observation::Observation>("observation");
}

fn check<T: JsonSchema>(name: &str) {
    check_json(&format!("schema/{name}.json"), &schema_for!(T));
}

fn closed(schema: &mut Schema) {
    if schema.get("properties").is_some() && schema.get("$ref").is_none() {
        schema.insert("additionalProperties".to_owned(), false.into());
    }
}
