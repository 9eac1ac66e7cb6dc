//! Episodes on record, and rendered again.

#[path = "../support/server.rs"]
mod support;

mod ego;
mod integrators;
mod record;
mod replay;
