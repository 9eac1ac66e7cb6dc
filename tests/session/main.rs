//! Sessions and episodes: the images, prefetched sections and stored state, the actors and the
//! trust of their images.

#[path = "../support/images.rs"]
mod images;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/source.rs"]
mod source;
#[path = "../support/streaming.rs"]
mod streaming;

mod actor_records;
mod actors;
mod before_actors;
mod driving;
mod fairness;
mod lanes;
mod lidar;
mod long;
mod reuse;
mod solids;
mod trust;
