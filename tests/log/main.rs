//! Logs on disk: what is written is read, and what is not understood is named.

#[path = "../support/generated.rs"]
mod generated;

mod projection;
mod reading;
mod schema;
