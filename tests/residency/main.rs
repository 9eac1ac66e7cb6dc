//! Streaming: a frame is the same whatever is in memory, and no failure, wait, or race of one
//! session stops the others.

#[path = "../support/city.rs"]
mod city_twin;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/source.rs"]
mod source;
#[path = "../support/streaming.rs"]
mod streaming;

mod admission;
mod city;
mod exact;
mod faults;
mod sharing;
