//! Uploads and pushes over HTTP: what is pushed is what agents see, whole, when they ask for it; and
//! whatever goes wrong on the way changes nothing.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/gltf.rs"]
mod gltf_files;
#[path = "../support/push.rs"]
mod http;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/server.rs"]
mod support;

mod actors;
mod edits;
mod frames;
mod hostile;
mod metrics;
mod pushes;
mod roles;
mod uploads;
mod versions;
