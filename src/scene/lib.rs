//! The data of a city twin: Gaussians in chunks and levels of detail, cameras and rigs, recorded
//! trajectories, skies, render profiles, and the manifest that ties them to one version.
//!
//! The whole package is pure: no files, no clock, no network. The same input gives the same bytes
//! at any thread count.
//!
//! # Coordinates
//! A mean lies in a grid cell of 64 m ([`chunk::CELL_M`]). Cells are centred on multiples of 64 m,
//! so that the mean of a capture near the world's origin minus the origin of its chunk is exact in
//! f32, and the `f32` record format loses nothing. Means are f64 until they are relative to their
//! chunk; the renderer subtracts the camera in f64 once per chunk and frame.

pub mod actor;
pub mod align;
pub mod appearance;
pub mod boxes;
pub mod chunk;
pub mod gaussian;
pub mod geo;
pub mod geometry;
pub mod lod;
pub mod manifest;
pub mod pages;
pub mod profile;
pub mod random;
pub mod record;
pub mod rig;
pub mod route;
pub mod semantics;
pub mod sh;
pub mod sky;
pub mod srgb;
pub mod trajectory;
pub mod validate;
mod view_set;
pub mod views;

pub use actor::{ActorBox, ActorClass};
pub use chunk::{Chunk, Scene};
pub use gaussian::Gaussians;
pub use manifest::Manifest;
pub use pages::{LanePages, PagePool};
pub use profile::{ProfileOverrides, Rays, RenderProfile, Shrink};
pub use record::RecordFormat;
pub use rig::Rig;
pub use semantics::SemanticClass;
pub use sky::Sky;
pub use trajectory::Trajectory;
pub use view_set::{Selection, ViewSet};
