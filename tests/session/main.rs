//! Episodes on record, and rendered again.

#[path = "../support/server.rs"]
mod support;

mod record;
mod replay;
