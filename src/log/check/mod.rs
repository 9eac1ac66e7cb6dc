//! Measures a log: clocks, gaps, LiDAR against images, poses against satellite fixes, coverage.
//!
//! Tables are read row by row, once or twice. Only poses are in memory as a whole, and a few images
//! of each camera are looked at, spread over the log; so the memory does not grow with the number
//! of images.

mod alignment;
mod coverage;
mod edges;
mod findings;
mod path;
mod projection;
mod samples;
mod stream;

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use crate::error::LogError;
use crate::log::Log;
use crate::poses::Poses;
use crate::row::{ImageRow, Row, SweepRow};
use crate::table::Rows;

pub use alignment::Alignment;
pub use coverage::CameraCoverage;
pub use findings::{Finding, Level};
pub use path::{GpsReport, PathReport};
pub use projection::Projection;
pub(crate) use samples::SampleReader;
pub use samples::{Sample, SampledImage};
pub use stream::{Gap, Stream};

use coverage::Coverage;
use samples::Samples;
use stream::StreamCounter;

/// What is measured, and how much of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckSettings {
    /// Images of each camera that are compared with LiDAR.
    pub images_per_camera: usize,
}

impl Default for CheckSettings {
    fn default() -> Self {
        Self { images_per_camera: 24 }
    }
}

/// What was measured of a log.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Name of the log.
    pub name: String,
    /// What a twin needs and the log lacks, and what looks wrong; the worst first.
    pub findings: Vec<Finding>,
    pub path: PathReport,
    /// The rows of each sensor in time: `poses`, `camera front`, `lidar top` and so on.
    pub streams: Vec<Stream>,
    /// Along the drive, camera by camera.
    pub coverage: Vec<CameraCoverage>,
    /// LiDAR against images, camera by camera; empty without LiDAR.
    pub alignment: Vec<Alignment>,
    /// Poses against satellite fixes, if the log has fixes and an anchor.
    pub gps: Option<GpsReport>,
    /// Number of objects with boxes, if the log has boxes.
    pub tracks: Option<usize>,
    /// Number of lanes, if the log has a map.
    pub lanes: Option<usize>,
    /// The middles of the lanes around the path, in metres, for its picture.
    #[serde(skip)]
    pub lane_lines_m: Vec<Vec<[f64; 2]>>,
    /// Sampled images with LiDAR points, for pictures.
    #[serde(skip)]
    pub samples: Vec<SampledImage>,
}

/// Tells how far a check is: done, and all of it.
pub type OnProgress<'a> = &'a mut dyn FnMut(u64, u64);

/// Measures a log, of which only poses and a few images are in memory.
///
/// # Errors
/// A table, an image or a sweep cannot be used: names the file, and the line and field of a row.
pub fn check(
    log: &Log,
    settings: &CheckSettings,
    on_progress: OnProgress<'_>,
) -> Result<Report, LogError> {
    let poses = log.poses()?;
    let path = PathReport::measure(&poses);
    let mut tables = Tables::read(log, &poses)?;
    let samples = Samples::choose(log, &tables.image_counts, settings.images_per_camera)?;
    let compared = alignment::compare(log, &poses, samples, on_progress)?;
    // Poses are the first row of the page, because everything else is placed by them.
    tables.streams.insert(0, stream::measure("poses", log.pose_rows()?)?);
    let gps = log.gps()?.map(|rows| path::compare_fixes(log, &poses, rows)).transpose()?.flatten();
    let map = log.map()?;
    let lane_lines_m = map.as_ref().map_or(Vec::new(), |map| path.lanes_around(map));
    let mut report = Report {
        name: log.header.name.clone(),
        findings: Vec::new(),
        path,
        streams: tables.streams,
        coverage: tables.coverage,
        alignment: compared.alignment,
        gps,
        tracks: tables.tracks,
        lanes: map.map(|map| map.lanes.len()),
        lane_lines_m,
        samples: compared.samples,
    };
    report.findings = findings::find(log, &report, &tables.missing);
    Ok(report)
}

/// What is counted while tables are read for the first time.
struct Tables {
    streams: Vec<Stream>,
    coverage: Vec<CameraCoverage>,
    /// Number of images of each camera.
    image_counts: BTreeMap<String, usize>,
    tracks: Option<usize>,
    missing: Missing,
}

/// Files that rows name and that do not exist.
#[derive(Debug, Default)]
struct Missing {
    count: usize,
    first: Option<String>,
}

impl Missing {
    fn look(&mut self, path: &Path, file: &str) {
        if !path.is_file() {
            self.count += 1;
            self.first.get_or_insert_with(|| file.to_owned());
        }
    }
}

impl Tables {
    fn read(log: &Log, poses: &Poses) -> Result<Self, LogError> {
        let mut tables = Self {
            streams: Vec::new(),
            coverage: Vec::new(),
            image_counts: BTreeMap::new(),
            tracks: None,
            missing: Missing::default(),
        };
        if let Some(rows) = log.images()? {
            tables.read_images(log, poses, rows)?;
        }
        if let Some(rows) = log.sweeps()? {
            tables.read_sweeps(log, rows)?;
        }
        if let Some(rows) = log.tracks()? {
            // Objects come and go, so that gaps in their tracks mean nothing: only their number is
            // kept.
            let counters = stream::measure_keys(rows, |_| Ok(()))?;
            tables.tracks = Some(counters.len());
        }
        if let Some(rows) = log.imu()? {
            tables.streams.push(stream::measure("imu", rows)?);
        }
        if let Some(rows) = log.gps()? {
            tables.streams.push(stream::measure("gps", rows)?);
        }
        Ok(tables)
    }

    fn read_images(
        &mut self,
        log: &Log,
        poses: &Poses,
        rows: Rows<ImageRow>,
    ) -> Result<(), LogError> {
        let mut coverage = Coverage::new(poses);
        let counters = stream::measure_keys(rows, |row: &ImageRow| {
            // A camera that the rig lacks makes the log unusable: it is an error and not a finding.
            log.camera_index(&row.camera)?;
            let masks = [&row.mask, &row.ground_mask, &row.sky_mask];
            for file in masks.into_iter().flatten().chain([&row.file]) {
                self.missing.look(&log.path(file), file);
            }
            coverage.add(row);
            Ok(())
        })?;
        self.image_counts = counters.iter().map(|(name, one)| (name.clone(), one.rows())).collect();
        self.add_streams("camera", counters);
        self.coverage = coverage.finish();
        Ok(())
    }

    fn read_sweeps(&mut self, log: &Log, rows: Rows<SweepRow>) -> Result<(), LogError> {
        let counters = stream::measure_keys(rows, |row: &SweepRow| {
            // As a camera that the rig lacks: without a mount no point can be placed.
            log.rig_from_lidar(&row.lidar)?;
            self.missing.look(&log.path(&row.file), &row.file);
            Ok(())
        })?;
        self.add_streams("lidar", counters);
        Ok(())
    }

    fn add_streams(&mut self, kind: &str, counters: BTreeMap<String, StreamCounter>) {
        let named = counters.into_iter();
        self.streams.extend(named.map(|(name, one)| one.finish(format!("{kind} {name}"))));
    }
}

impl Report {
    /// Whether something looks so wrong that a twin of the log would be wrong.
    pub fn has_errors(&self) -> bool {
        self.findings.iter().any(|finding| finding.level == Level::Error)
    }
}

/// Calls `look` for each row of a table.
fn for_each<R: Row>(
    rows: Rows<R>,
    mut look: impl FnMut(R) -> Result<(), LogError>,
) -> Result<(), LogError> {
    for row in rows {
        look(row?)?;
    }
    Ok(())
}
