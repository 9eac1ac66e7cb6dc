//! AlpaSim's gRPC services, so that its programs use wildcity unmodified.
//!
//! ```text
//! wire        the messages of AlpaSim 0.54 as Rust types
//! grpc        one gRPC method over HTTP/2
//! door        the open connections, and the memory of their requests
//! shape       how many messages a request contains
//! scene       scenes: pieces of recorded drives, and their local frames
//! camera      cameras, poses and shutters, to and from the wire
//! object      dynamic objects, as their ids describe them
//! sensorsim   wildcity as AlpaSim's renderer
//! physics     wildcity as AlpaSim's physics: boxes on the ground
//! export      scenes as the files that AlpaSim's runtime reads
//! egodriver   wildcity driven by AlpaSim's drivers
//! ```
//!
//! # Facts of the contract
//! AlpaSim connects without TLS and without tokens, so that the services listen on loopback
//! addresses unless told otherwise. All floats of poses are f32, and AlpaSim keeps its own poses in
//! f32 as well: 8 mm at 100 km. So a scene has a local frame near its start, with the axes of the
//! world. Messages have at most 64 MiB, as the clients' own limit. This package has no .proto file
//! and no code generator: the messages are written by hand from the published field numbers, and a
//! test calls every method with the stubs of another package.

pub mod camera;
#[cfg(test)]
#[path = "../../tests/support/cost_table.rs"]
mod cost_table;
#[cfg(test)]
mod costs;
mod door;
pub mod egodriver;
pub mod export;
#[cfg(test)]
#[path = "../../tests/support/generated.rs"]
mod generated;
mod grpc;
mod lidar;
pub mod limits;
pub mod object;
pub mod physics;
pub mod scene;
pub mod sensorsim;
mod shape;
pub mod wire;
