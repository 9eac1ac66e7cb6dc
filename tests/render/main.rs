//! The backends against each other, against images made by others, and at the extremes.

#[path = "../support/captures.rs"]
mod captures;
#[path = "../support/data.rs"]
mod data;
#[path = "../support/gradient_cases.rs"]
mod gradient_cases;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/lenses.rs"]
mod lenses;
#[path = "../support/lidars.rs"]
mod lidars;
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
mod appearance;
mod cameras;
mod determinism;
mod expansion;
mod gradients;
mod image_metrics;
mod lidar;
mod models;
mod normals;
mod others;
mod parity;
mod sky;
mod slabs;
mod small_images;
