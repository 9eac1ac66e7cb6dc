//! Wire to session and back: the one place of the server that names the protocol.

mod answer;
mod fault;
mod request;

pub(super) use answer::{
    closed, observation, ok, opened, refusal_body, refused, resumed, twins, welcome,
};
pub(super) use request::{Command, Parsed, parse};

/// The WebSocket subprotocol.
pub(super) const SUBPROTOCOL: &str = crate::protocol::PROTOCOL;
