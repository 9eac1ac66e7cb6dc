//! The Rust client of the protocol.
