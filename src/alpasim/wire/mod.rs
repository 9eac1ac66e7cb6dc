//! The messages of AlpaSim's gRPC API 0.54, by the published field numbers.

pub mod common;
pub mod egodriver;
pub mod physics;
pub mod sensorsim;

/// Version of the API.
pub const API_VERSION: common::ApiVersion = common::ApiVersion { major: 0, minor: 54, patch: 0 };
