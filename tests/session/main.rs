//! Episodes on record, and rendered again.

#[path = "../support/server.rs"]
#[allow(dead_code, reason = "tests/server uses the rest of it")]
mod support;

mod record;
mod replay;
