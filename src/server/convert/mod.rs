//! Conversion between the wire and the session: no other module of the server but `fault` names
//! the protocol's types.
//!
//! ```text
//! mistake      mistakes in messages, as faults
//! request      parses text frames as commands
//! answer       answers other than observations
//! observation  observations
//! many         observations of several sessions
//! drive        recorded drives
//! http         bodies of HTTP requests and answers
//! actor        those about assets of actors
//! ```

mod actor;
mod answer;
mod drive;
mod field;
mod http;
mod many;
mod mistake;
mod observation;
mod request;
mod sensors;

pub(crate) use actor::{actor, actors, new_actor};
pub(crate) use answer::{
    AlsoResumed, closed, in_memory, ok, opened, resumed, shared_memory, switched, twin, twins,
    welcome,
};
pub(crate) use drive::{DriveRequest, drive_body, drive_query};
pub(crate) use http::{
    ListedEpisode, edited, episodes, new_edit, new_push, new_upload, push, rollback, sessions,
    survey, ticket, upload, version, versions,
};
pub(crate) use many::{Stepped, many};
pub(crate) use observation::observation;
pub(crate) use request::{BranchPoint, Command, Parsed, SessionStep, parse};

pub(crate) const SUBPROTOCOL: &str = wildcity_protocol::PROTOCOL;

/// The WebSocket subprotocol of a watcher.
pub(crate) const WATCH_SUBPROTOCOL: &str = wildcity_protocol::WATCH_PROTOCOL;
