//! The `wildcity` command, as users run it: files in, files, text and exit codes out.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/drives.rs"]
mod drives;
#[path = "../support/episodes.rs"]
mod episodes;
#[path = "../support/formats.rs"]
mod format_files;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/push.rs"]
mod http;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/onnx_doubles.rs"]
mod onnx_doubles;
#[path = "../support/onnx_models.rs"]
mod onnx_models;
#[path = "../support/onnx_protobuf.rs"]
mod onnx_protobuf;
#[path = "../support/places.rs"]
mod places;
#[path = "../support/reported.rs"]
mod reported;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/s3.rs"]
mod s3;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/sky_network.rs"]
mod sky_network;
#[path = "../support/streets.rs"]
mod streets;
#[path = "../support/server.rs"]
mod support;
#[path = "../support/versions.rs"]
mod versions;

mod actor;
mod augment;
mod bisect;
mod bombs;
mod capture;
mod costs;
mod crash;
mod demo;
mod devices;
mod episode;
mod eval;
mod eval_networks;
mod garbage;
mod generate;
mod hang_up;
mod import;
mod in_folder;
mod kills;
mod load;
mod log;
mod log_twin;
mod operations;
mod push;
mod remote;
mod repair;
mod report;
mod report_repair;
mod rig;
mod route;
mod scenario;
mod served;
mod sky;
mod suites;
mod traces;
mod train;
mod twin;
mod verify;
mod views;

use std::process::Command;

/// The command that users run.
fn wildcity() -> Command {
    Command::new(env!("CARGO_BIN_EXE_wildcity"))
}
