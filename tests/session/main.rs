//! Episodes on record, and rendered again; and what their egos do.

#[path = "../support/server.rs"]
mod support;

mod ego;
mod long;
mod record;
mod replay;
