//! `src/log/schema` is generated from the types. After a change run
//! `WILDCITY_BLESS=1 cargo test -p wildcity-log --test log schema`, and review the difference.

use schemars::{Schema, schema_for};
use wildcity_log::{GpsRow, Header, ImageRow, ImuRow, SweepRow, TrackRow};

use crate::root::root;

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
    let path = root().join("src/log/schema").join(format!("{name}.json"));
    let mut text = serde_json::to_string_pretty(schema).unwrap();
    text.push('\n');
    if std::env::var_os("WILDCITY_BLESS").is_some_and(|value| value == "1") {
        std::fs::write(&path, text).unwrap();
        return;
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == text,
        "{} differs from the types: WILDCITY_BLESS=1 cargo test -p wildcity-log --test log schema",
        path.display()
    );
}
