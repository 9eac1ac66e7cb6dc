//! Tests of the gpu backend against the other backends, on any Vulkan device; lavapipe is enough.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/lenses.rs"]
mod lenses;
#[path = "../support/actors.rs"]
mod placed;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/skies.rs"]
mod skies;
#[path = "../support/streets.rs"]
mod streets;
#[path = "../support/truths.rs"]
mod truths;
#[path = "../support/vectors.rs"]
mod vectors;

mod actors;
mod automatic;
mod cameras;
mod definition;
mod determinism;
mod encoding;
mod frames_in_flight;
mod memory_growth;
mod mirror;
mod mutations;
mod parity;
mod regions;
mod sky;
mod stages;
mod twins;

use wildcity_render::compare::gaussians;
