//! `wildcity.v1`: the wire, and only the wire.
//!
//! Text frames are JSON, [`message::Request`] one way and [`message::Answer`] the other, matched by
//! `seq`. Binary frames are [`observation`]s. The prose is `protocol/README.md`; the JSON schemas
//! beside it are generated from these types. What HTTP carries beside sessions is in [`http`].

pub mod camera;
mod deserialize;
pub mod error;
pub mod http;
pub mod limits;
pub mod message;
pub mod observation;

pub use deserialize::unknown_field;

/// The WebSocket subprotocol, and the only protocol version there is so far.
pub const PROTOCOL: &str = "wildcity.v1";
