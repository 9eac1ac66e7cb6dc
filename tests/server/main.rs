//! The server from outside: bytes on a socket in, bytes on a socket out.

#[path = "../support/server.rs"]
mod support;

mod bundles;
mod http;
mod leases;
mod load;
mod observation;
mod profile;
mod refused;
mod resume;
mod shutdown;
