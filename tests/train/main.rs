//! The losses of training: each against vectors that others computed, or against differences in
//! f64.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;

mod cameras;
mod check;
mod loss_vectors;
mod losses;
mod stress;
mod training;
mod vectors;
