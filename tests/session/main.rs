//! Episodes: what sessions draw, foresee and keep.

#[path = "../support/images.rs"]
mod images;
#[path = "../support/source.rs"]
mod source;
#[path = "../support/streaming.rs"]
mod streaming;

mod driving;
mod long;
mod trust;
