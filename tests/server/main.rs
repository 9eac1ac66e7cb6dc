//! The server from outside: bytes on a socket in, bytes on a socket out.

#[path = "../support/episodes.rs"]
mod episodes;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/server.rs"]
mod support;

mod appearance;
mod branches;
mod bundles;
mod drives;
mod ego;
mod http;
mod leases;
mod observation;
mod page;
mod profile;
mod record;
mod refused;
mod replay;
mod resume;
mod scenarios;
mod shutdown;
