//! Episodes' files: reading them whole and cut, comparing and scoring them.

#[path = "../support/root.rs"]
mod root;
#[path = "../support/thread_time.rs"]
mod thread_time;

mod calibration;
mod diff;
mod export;
mod files;
mod nuscenes;
mod prune;
mod ros2;
mod scores;
mod written;
