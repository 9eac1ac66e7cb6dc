//! `protocol/schema` is what the types say.

use schemars::{JsonSchema, schema_for};
use wildcity::protocol::{message, observation};

use super::check_json;

#[test]
fn schemas_are_fresh() {
    check::<message::Request>("request");
    check::<message::Answer>("answer");
    check::<observation::Observation>("observation");
}

fn check<T: JsonSchema>(name: &str) {
    check_json(&format!("schema/{name}.json"), &schema_for!(T));
}
