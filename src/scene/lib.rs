//! What a city twin is made of: Gaussians in chunks and levels of detail, a rig, recorded trajectories, a manifest.

pub mod appearance;
pub mod chunk;
pub mod gaussian;
pub mod geometry;
pub mod lod;
pub mod manifest;
pub mod profile;
pub mod record;
pub mod rig;
pub mod route;
pub mod sh;
pub mod sky;
pub mod trajectory;
pub mod validate;

pub use chunk::{Chunk, Scene};
pub use gaussian::Gaussians;
pub use manifest::Manifest;
pub use profile::{ProfileChanges, Rays, RenderProfile};
pub use record::Record;
pub use rig::Rig;
pub use sky::Sky;
pub use trajectory::Trajectory;
