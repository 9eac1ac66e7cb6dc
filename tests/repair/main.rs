//! Repair by ONNX models: two trained ones, and small graphs that the tests write themselves.
//!
//! The tests need a runtime library: ORT_DYLIB_PATH, or onnxruntime in target/python as `.ci/test`
//! installs it. Without one they fail and say so.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/onnx_doubles.rs"]
mod onnx_doubles;
#[path = "../support/onnx_models.rs"]
mod onnx_models;
#[path = "../support/onnx_protobuf.rs"]
mod onnx_protobuf;
#[path = "../support/root.rs"]
mod root;

mod errors;
mod library;
mod select;
mod shipped;
mod support;
mod trained;
mod views;
mod warp;
mod warp_pixels;
