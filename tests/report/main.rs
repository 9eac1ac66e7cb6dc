//! Settings measured against the f64 reference, and what each feature adds to a scene.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/onnx_doubles.rs"]
mod onnx_doubles;
#[path = "../support/onnx_models.rs"]
mod onnx_models;
#[path = "../support/onnx_protobuf.rs"]
mod onnx_protobuf;
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
mod repair;
mod settings;
