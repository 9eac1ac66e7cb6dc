//! A closed-loop driving simulator server for city twins made of 3D Gaussians.

pub mod cli;

pub use wildcity_client as client;
pub use wildcity_generate as generate;
pub use wildcity_protocol as protocol;
pub use wildcity_render as render;
pub use wildcity_report as report;
pub use wildcity_scene as scene;
pub use wildcity_scene::geometry;
pub use wildcity_server as server;
pub use wildcity_session as session;
pub use wildcity_sim as sim;
pub use wildcity_stress as stress;
pub use wildcity_twin as twin;
pub use wildcity_twin::{ingest, residency, store};
