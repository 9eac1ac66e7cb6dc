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
//! ```
//!
//! Tables are read row by row: a log of a day takes as much memory as one of a minute, except for
//! its poses.

mod error;
mod header;
pub mod limits;
mod log;
mod points;
mod poses;
mod row;
mod table;
mod writer;

pub use error::{FieldError, LogError};
pub use header::{Clock, Header, LidarMount, Source, World};
pub use log::Log;
pub use points::SweepPoints;
pub use poses::Poses;
pub use row::{GpsRow, ImageRow, ImuRow, Row, SweepRow, TrackRow};
pub use table::Rows;
pub use writer::LogWriter;
