//! Repair of rendered images by an ONNX model: an image in, an image and two hashes out.
//!
//! A model is an .onnx file with a manifest in the same folder ([`Manifest`],
//! `"format": "wildcity.repair/1"`). The manifest defines the meaning of each input (its role), the
//! sizes that the model takes, and how its output is merged with the image. [`Model::load`] checks
//! all of it: names, types and ranks of the inputs, the hash of each file, and a probe run (shape,
//! NaN, time). [`Model::repair`] is a function: the same image gives the same bytes, with the cpu
//! provider at any number of threads.
//!
//! Only `onnx.rs` names the runtime. The library is opened when the first model is loaded; without
//! a model there is no thread, buffer or library. The package depends neither on the renderer nor
//! on sessions; from `wildcity-scene` it uses cameras and poses.
//!
//! | file | what it does |
//! |---|---|
//! | `manifest`, `validate` | the file format, and its checks |
//! | `files` | reads manifest and model, compares hashes |
//! | `onnx` | the runtime: library, environment, session, worker thread, time-out |
//! | `signature` | compares the manifest with the inputs and outputs of the graph |
//! | `planes`, `resample`, `roles` | images as planes of f32, their sizes, their ranges |
//! | `tiles`, `halo` | windows of an image; how far a pixel of the output depends on the input |
//! | `merge` | output of the model to an image |
//! | `runner`, `probe`, `fitted` | runs of the graph; the probe run at load; the size in which it sees an image |
//! | `model` | all of it in order |
//! | `models` | the models that a program offers by name, each loaded on its first use |
//! | `network` | networks that measure images: a distance of two, or features of one |
//! | `select` | which views of a step are repaired, by trust |
//! | [`mod@reference`] | recorded images warped into a view by its depth |

mod error;
mod files;
mod fitted;
mod halo;
mod image;
pub mod limits;
mod manifest;
mod merge;
mod model;
mod models;
mod network;
mod onnx;
mod planes;
mod probe;
pub mod reference;
mod resample;
mod roles;
mod runner;
mod select;
mod signature;
mod tiles;
mod validate;

pub use error::RepairError;
pub use halo::Halo;
pub use image::{Image, View};
pub use manifest::{
    Dtype, Fit, Input, InputRole, Layout, Manifest, Merge, ModelFile, Output, OutputRole, Provider,
    Size, Unit,
};
pub use model::{LoadOptions, Model, RepairTimes, Repaired};
pub use models::Models;
pub use network::{Network, NetworkInput, NetworkManifest, NetworkRole};
pub use onnx::is_loaded;
pub use select::{Decision, Selection};
