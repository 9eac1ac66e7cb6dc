//! The messages of the protocol `wildcity.v1`. This package has the types that are sent; the
//! options of a session are those of `wildcity-options`.
//!
//! Text frames are JSON: [`message::Request`] from the client, [`message::Answer`] from the server,
//! matched by `seq`. Binary frames are [observations](observation). [`http`] has the bodies of HTTP
//! requests and answers for uploads, pushes and versions. `protocol/README.md` describes the
//! protocol; the JSON schemas in `protocol/schema` are generated from these types, and [`decode`]
//! compares messages of clients with them.
//!
//! ```
//! use wildcity_protocol::message::{Pose, Request};
//!
//! let pose = Pose { xyz: [13.0, -3.25, 0.0], q: [1.0, 0.0, 0.0, 0.0] };
//! let step = Request::Step {
//!     seq: 3,
//!     session: None,
//!     pose: Some(pose),
//!     trajectory: None,
//!     action: None,
//!     until_us: None,
//!     notes: None,
//!     terminate: false,
//! };
//! let json = serde_json::to_string(&step)?;
//! assert!(json.starts_with(r#"{"type":"step","seq":3,"pose":{"xyz":[13.0,"#));
//! assert_eq!(serde_json::from_str::<Request>(&json)?, step);
//! # Ok::<(), serde_json::Error>(())
//! ```

#![warn(missing_docs)]

pub mod decode;
pub mod error;
pub mod http;
pub mod limits;
pub mod message;
pub mod observation;

pub use wildcity_options::camera;

/// Name of the WebSocket subprotocol. It is also the only protocol version so far.
pub const PROTOCOL: &str = "wildcity.v1";

/// The WebSocket subprotocol of clients that watch a session: they receive its observations, and
/// send nothing.
pub const WATCH_PROTOCOL: &str = "wildcity.watch.v1";
