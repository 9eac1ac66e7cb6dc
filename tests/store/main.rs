//! Twins on disk: what is committed is read back, and a failure leaves the old version or nothing.

#[path = "../support/places.rs"]
mod places;
#[path = "../support/s3.rs"]
mod s3;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/sky_network.rs"]
mod sky_network;
#[path = "../support/versions.rs"]
mod versions;

mod accepted;
mod actors;
mod alignments;
mod classes;
mod commits;
mod damage;
mod everywhere;
mod garbage;
mod remote;
mod round_trip;
mod skies;
mod views;
mod whole_twins;
