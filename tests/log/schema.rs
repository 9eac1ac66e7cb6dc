//! `src/log/schema` is generated from the types. After a change run
//! `WILDCITY_BLESS=1 cargo test -p wildcity-log --test log schema`, and review the difference.

use schemars::{Schema, schema_for};
use wildcity_log::{GpsRow, Header, ImageRow, ImuRow, SweepRow, TrackRow};

use crate::generated;

#[test]
fn schemas_of_files_are_up_to_date() {
    check("log", &schema_for!(Header));
    check("images", &schema_for!(ImageRow));
    check("lidar", &schema_for!(SweepRow));
    check("tracks", &schema_for!(TrackRow));
    check("imu", &schema_for!(ImuRow));
    check("gps", &schema_for!(GpsRow));
}

fn check(name: &str, schema: &Schema) {
    let mut text = serde_json::to_string_pretty(schema).unwrap();
    text.push('\n');
    let file = format!("src/log/schema/{name}.json");
    generated::check(&file, &text, "-p wildcity-log --test log schema");
}
