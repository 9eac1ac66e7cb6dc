//! The WebSocket and HTTP server.
//!
//! ```text
//! config         the configuration of a server, and its limits
//! start          starts a server
//! shutdown       a running server, and stopping it without losing running steps
//! state          what all connections share
//! listen         accepts connections, a bounded number
//! idle_deadline  closes HTTP connections that make no progress
//! routes         HTTP routes, and the upgrade to WebSocket
//! auth           tokens, their roles and twins
//! spool          uploads on disk
//! metrics        counters for Prometheus
//! socket         WebSocket messages, with a time-out on every wait
//! inbox          what a client sends while its last request is carried out
//! connection     one agent, in lock step: read a request, answer it
//! sessions       the sessions of the server: connected, or waiting to be resumed
//! fault          why a request is refused
//! convert        conversion between wire and session types; wire code and HTTP status of each fault
//! ```
//!
//! The pipeline of pushes is the package `wildcity-push`; the routes only carry requests to it.

mod auth;
mod blocking;
mod config;
mod connection;
mod convert;
mod fault;
mod idle_deadline;
mod inbox;
pub mod limits;
mod listen;
mod metrics;
mod routes;
mod sessions;
mod shutdown;
mod socket;
mod spool;
mod start;
mod state;

pub use auth::{Role, Tokens, TokensError};
pub use config::{Config, Limits, SpoolLimits};
pub use shutdown::{Running, stop_signal};
pub use start::{ServerError, start};
