//! Boxes, LiDAR and KID against programs of other authors, or written again in numpy.

mod boxes;
mod kid;
mod lidar;
