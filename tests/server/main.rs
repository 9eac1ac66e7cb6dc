//! The server from outside: bytes on a socket in, bytes on a socket out.

#[path = "../support/episodes.rs"]
mod episodes;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/server.rs"]
mod support;

mod appearance;
mod bad_requests;
mod branches;
mod bundles;
mod damaged_twin;
mod drives;
mod ego;
mod http;
mod leases;
mod many;
mod mutations;
mod observation;
mod page;
mod plans;
mod profile;
mod record;
mod refused;
mod replay;
mod resume;
mod scenarios;
mod shutdown;
mod socket;
mod starts;
mod tls;
mod viewer;
