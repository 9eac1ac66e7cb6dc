//! Boxes, LiDAR and KID against programs of other authors, or written again in numpy; and means of
//! images.
//!
//! `plant.py` plants faults into the package, and says which test notices each.

mod boxes;
mod kid;
mod lidar;
mod means;
mod sweep;
