//! Uploads and pushes over HTTP: agents see all of a pushed scene once they request the version,
//! and a failed push changes nothing.

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
mod files;
mod frames;
mod hostile;
mod metrics;
mod pushes;
mod roles;
mod uploads;
mod versions;
