//! The WebSocket and HTTP server.
//!
//! ```text
//! config         the configuration of a server, and its limits
//! start          starts a server
//! shutdown       a running server, and stopping it without losing running steps
//! stream         a connection, with or without TLS
//! tls            certificate and key
//! certificate    when a certificate expires
//! reload         reading the certificate and the tokens again at SIGHUP
//! readiness      whether sessions can be opened
//! state          state that all connections share
//! listen         accepts connections, a bounded number
//! admission      the slots of connections, before and after authentication
//! idle_deadline  closes HTTP connections that make no progress
//! routes         HTTP routes, and the upgrade to WebSocket
//! auth           tokens, their roles, twins and limits
//! audit          the log of which token changed which twin
//! token_counts   how many pushes and connections each token has
//! tickets        one-time tickets, which stand for a token in the address of a WebSocket
//! origins        which web pages and which host names are served
//! spool          uploads on disk
//! metrics        counters for Prometheus
//! socket         WebSocket messages, with a time-out on every wait
//! inbox          messages that a client sends while its last request is carried out
//! connection     one agent, in lock step: read a request, answer it
//! memory         observations in memory that a client on the same machine maps
//! watchers       clients that look at a session without taking part in it
//! sessions       the sessions of the server: connected, or waiting to be resumed
//! fault          why a request is refused, with the wire code, the HTTP status and the text
//! convert        conversion between wire and session types
//! ```
//!
//! The pipeline of pushes is the package `wildcity-push`; the routes only carry requests to it.

mod admission;
mod audit;
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
mod memory;
mod metrics;
mod origins;
mod process;
mod readiness;
mod reload;
mod routes;
mod sessions;
mod shutdown;
mod socket;
mod spool;
mod start;
mod state;
mod stream;
mod tickets;
mod tls;
mod token_counts;
mod unfinished;
mod watchers;

// The support of the tests names this package.
#[cfg(test)]
extern crate self as wildcity_server;

#[cfg(test)]
#[path = "../../tests/support/cost_table.rs"]
mod cost_table;
#[cfg(test)]
#[path = "../../tests/support/generated.rs"]
mod generated;
/// Simulated faults of uploads and connections.
#[cfg(test)]
#[path = "../../tests/faults/server/mod.rs"]
mod simulation;

pub use auth::{Role, Tokens, TokensError};
pub use config::{Config, Directories, Limits, SpoolLimits};
pub use origins::{OriginError, Origins};
pub use shutdown::{Running, stop_signal};
pub use start::{ServerError, start};
pub use tls::{TlsError, TlsFiles};
