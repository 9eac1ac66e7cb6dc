//! Episodes on record, and rendered again; and what their egos do.

#[path = "../support/server.rs"]
mod support;

mod appearance;
mod driving;
mod ego;
mod integrators;
mod long;
mod record;
mod replay;
mod study;
