//! Recorded drives on disk, `wildcity.log/1`: what a fleet's log becomes before it becomes a twin.
//!
//! A log is a folder of tables of JSON lines, one row a line in order of time, with images and
//! LiDAR sweeps beside them. Nothing is resampled: every row has the time at which it was recorded.
//! `docs/logs.md` has the tables.
//!
//! ```text
//! header   log.json: source, clock, world, LiDAR mounts
//! row      the rows of the tables
//! table    rows of a file, one at a time
//! points   the points of a sweep, as safetensors
//! poses    the poses of the rig, and those between two of them
//! log      a folder: its header, rig, tables and files
//! writer   a new folder, which appears when it is complete
//! check    measures: clocks, gaps, LiDAR against images, drift, coverage
//! page     what was measured, as HTML
//! placed   images with their cameras in the world
//! tracks   boxes as actors of a scenario, and the points that they hide
//! colored  LiDAR points with the colours of images
//! split    keyframes, chunks and sub-trajectories of a log
//! ```
//!
//! Tables are read row by row: a log of a day takes as much memory as one of a minute, except for
//! its poses.

pub mod check;
mod colored;
mod error;
mod header;
pub mod limits;
mod log;
mod page;
mod placed;
mod points;
mod poses;
mod row;
pub mod split;
mod table;
mod tracks;
mod writer;

pub use colored::{ColoredPoint, colored_points};
pub use error::{FieldError, LogError};
pub use header::{Clock, Header, LidarMount, Source, World};
pub use log::Log;
pub use page::page;
pub use placed::PlacedImage;
pub use points::SweepPoints;
pub use poses::{Poses, Stations};
pub use row::{GpsRow, ImageRow, ImuRow, Row, SweepRow, TrackRow};
pub use table::{Rows, open_lines};
pub use tracks::{NearTracks, Tracks};
pub use writer::LogWriter;
