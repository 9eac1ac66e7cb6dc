//! Wire to session and back: the one place of the server that names the protocol.

mod answer;
mod camera;
mod fault;
mod http;
mod request;

pub(super) use answer::{
    WireCode, closed, code, observation, ok, opened, refusal_body, refused, resumed, switched,
    twin, twins, welcome,
};
pub(super) use http::{new_push, new_upload, push, rollback, sessions, upload, version, versions};
pub(super) use request::{Command, Parsed, parse};

/// The WebSocket subprotocol.
pub(super) const SUBPROTOCOL: &str = wildcity_protocol::PROTOCOL;
