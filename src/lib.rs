//! A closed-loop driving simulator server for city twins made of 3D Gaussians.
//!
//! # Layout
//!
//! | room | what it is | may name |
//! |---|---|---|
//! | [`config`] | every default and every limit | nothing |
//! | [`geometry`] | poses, cameras, boxes | nothing |
//! | [`scene`] | what a city twin is, its records and levels of detail | geometry |
//! | [`generate`] | the procedural demo twin | geometry, scene |
//! | [`ingest`] | one file per outside format | config, geometry, scene |
//! | [`store`] | twins on disk or in an object store, versioned, content-addressed | config, geometry, scene, ingest |
//! | [`residency`] | what is in memory now, what a frame draws | config, geometry, scene, store |
//! | [`render`] | six images per step: `gpu`, `cpu`, `reference` | config, geometry, scene |
//! | [`sim`] | what moves: the ego | config, geometry, scene |
//! | [`session`] | episodes: reset, step, observe, record, replay | config, geometry, scene, store, residency, render, sim |
//! | [`report`] | error against run time, and what happens at the extremes | geometry, scene, generate, residency, render, session, config |
//! | [`protocol`] | the wire, and only the wire | nothing |
//! | [`server`] | WebSocket and HTTP | config, geometry, scene, ingest, store, residency, render, sim, session, protocol |
//! | [`client`] | the Rust client of the protocol | config, protocol |
//! | [`cli`] | one file per subcommand | config, geometry, scene, generate, ingest, store, residency, render, sim, session, report, server, client |
//!
//! Data goes one way: file, ingest, store, residency, render, session, server, agent; an agent's
//! pose or action goes server, session, sim, session. Nothing downstream calls upstream.
//!
//! # Invariants
//!
//! 1. `protocol` is a leaf; only `server` and `client` name it, `server` in `convert.rs`.
//! 2. Only `store/local` opens files of a twin, only `store/remote` talks to object stores; only `server`
//!    names axum; only `render/gpu` wgpu.
//! 3. `render`, `scene` and `sim` are pure: the same input, the same bytes, whatever the thread count.
//! 4. Scene data is checked once, at import. Poses and cameras are checked once, at the wire.
//! 5. An image is a function of (scene version, render profile, poses, cameras).
//! 6. Every observation names the scene version and the render profile it was made with.
//! 7. Time is integer microseconds; poses are f64 until the renderer makes them camera-relative.
//! 8. Every queue, message, buffer and count has a maximum, all in [`config`].
//! 9. A scene pays only for what it has: no SH, no depth wanted, no work for it.
//!
//! `tests/tidy` reads this table and holds the source to it, and to invariants 1 and 2.

pub mod cli;
pub mod client;
pub mod config;
pub mod generate;
pub mod geometry;
pub mod ingest;
pub mod protocol;
pub mod render;
pub mod report;
pub mod residency;
pub mod scene;
pub mod server;
pub mod session;
pub mod sim;
pub mod store;
