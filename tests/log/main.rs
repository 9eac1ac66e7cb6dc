//! Logs on disk: what is written is read, and what is not understood is named.

#[path = "../support/root.rs"]
mod root;

mod projection;
mod reading;
mod schema;
