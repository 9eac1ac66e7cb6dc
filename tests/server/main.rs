//! The server from outside: bytes on a socket in, bytes on a socket out.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/episodes.rs"]
mod episodes;
#[path = "../support/onnx_doubles.rs"]
mod onnx_doubles;
#[path = "../support/onnx_models.rs"]
mod onnx_models;
#[path = "../support/onnx_protobuf.rs"]
mod onnx_protobuf;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/server.rs"]
mod support;

mod appearance;
mod bad_requests;
mod branches;
mod bundles;
mod costs;
mod damaged_twin;
mod drives;
mod ego;
mod follow;
mod guarded;
mod http;
mod leases;
mod levels;
mod many;
mod mcap;
mod memory;
mod mutations;
mod observation;
mod page;
mod plans;
mod profile;
mod record;
mod references;
mod refused;
mod repair;
mod repair_failures;
mod replay;
mod resume;
mod scenarios;
mod sensors;
mod shutdown;
mod socket;
mod starts;
mod tls;
mod traces;
mod viewer;
