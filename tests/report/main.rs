//! Settings measured against the f64 reference, and what each feature adds to a scene.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/reported.rs"]
mod reported;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/skies.rs"]
mod skies;
#[path = "../support/streets.rs"]
mod streets;

mod needed;
mod settings;
