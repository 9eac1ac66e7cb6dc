//! Keyframes, chunks and sub-trajectories of a log.
//!
//! A chunk is a log of its own with the images of keyframes only; its rows name the files where
//! they are. Sub-trajectories are drives of a common length.

use std::fs;
use std::iter::Peekable;
use std::path::{Path, PathBuf};

use serde::Serialize;

use wildcity_scene::route::{self, Route, sub_trajectories};
use wildcity_scene::trajectory::Keyframe;

use crate::error::LogError;
use crate::header::Header;
use crate::limits::LARGEST_GAP_US;
use crate::log::Log;
use crate::poses::{Poses, Stations};
use crate::row::{GpsRow, ImageRow, ImuRow, Row, SweepRow, TrackRow};
use crate::table::Rows;
use crate::writer::LogWriter;

/// How a log is split.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SplitSettings {
    /// Distance between two images of a camera, in metres.
    pub keyframe_m: f64,
    /// Length of a chunk, in metres.
    pub chunk_m: f64,
    /// Every this many keyframes of a camera, one is held out, beginning with the first.
    pub held_out_every: usize,
    /// Lengths of sub-trajectories, in metres.
    pub lengths_m: Vec<f64>,
}

impl Default for SplitSettings {
    fn default() -> Self {
        Self {
            keyframe_m: route::KEYFRAME_SPACING_M,
            chunk_m: route::ROUTE_CHUNK_LENGTH_M,
            held_out_every: 8,
            lengths_m: route::SUB_TRAJECTORY_LENGTHS_M.to_vec(),
        }
    }
}

/// The parts that a log was cut into, as `split.json` lists them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Split {
    /// Name of the log.
    pub log: String,
    pub settings: SplitSettings,
    pub chunks: Vec<ChunkSummary>,
    pub drives: Vec<DriveSummary>,
}

/// A chunk: a log of its own.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChunkSummary {
    /// Its folder within that of the split, and its name.
    pub name: String,
    /// Where it begins and ends along the drive, in metres.
    pub stations_m: [f64; 2],
    /// When it begins, in microseconds, and when the next one does.
    pub times_us: [i64; 2],
    /// Images at keyframes; the others of the log are in no chunk.
    pub images: usize,
    /// Those of them that are held out.
    pub held_out: usize,
}

/// A sub-trajectory, in `drives/NAME.json` with a clock that begins at 0.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DriveSummary {
    pub name: String,
    /// Where it begins and ends along the drive, in metres.
    pub stations_m: [f64; 2],
    /// When it begins, in microseconds.
    pub from_us: i64,
}

/// Splits a log into a folder that does not exist yet, and that appears when it is complete.
///
/// # Errors
/// A row or a setting cannot be used, or a file cannot be written.
pub fn split(log: &Log, out: &Path, settings: &SplitSettings) -> Result<Split, LogError> {
    let mut partial = out.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);
    if let Some(path) = [out, &partial].into_iter().find(|path| path.exists()) {
        return Err(LogError::Exists { path: path.to_owned() });
    }
    fs::create_dir_all(&partial).map_err(|error| LogError::file(&partial, &error))?;
    let written = write(log, &partial, settings).and_then(|split| {
        fs::rename(&partial, out).map_err(|error| LogError::file(out, &error))?;
        Ok(split)
    });
    if written.is_err() {
        // The error that ended the split is the one to report.
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn write(log: &Log, out: &Path, settings: &SplitSettings) -> Result<Split, LogError> {
    let poses = log.poses()?;
    let stations = Stations::new(&poses);
    let mut splitter = Splitter::new(log, &poses, &stations, settings)?;
    let drives = write_drives(log, &poses, out, settings)?;
    // The last chunk has the rest of the drive, and the rows after the last pose. A rest of less
    // than a millimetre is rounding.
    let length_m = (stations.length_m() - 1e-3).max(0.0);
    let count = (length_m / settings.chunk_m).floor() as usize + 1;
    let mut chunks = Vec::new();
    for number in 0..count {
        chunks.push(splitter.write_chunk(number, number + 1 == count, out)?);
    }
    let split = Split { log: log.header.name.clone(), settings: settings.clone(), chunks, drives };
    write_json(&out.join("split.json"), &split)?;
    Ok(split)
}

/// Tables that are read once, chunk after chunk.
struct Splitter<'a> {
    log: &'a Log,
    /// The log's folder, absolute, so that a chunk can be anywhere.
    folder: PathBuf,
    poses: &'a Poses,
    stations: &'a Stations<'a>,
    settings: &'a SplitSettings,
    images: Table<ImageRow>,
    sweeps: Table<SweepRow>,
    tracks: Table<TrackRow>,
    imu: Table<ImuRow>,
    gps: Table<GpsRow>,
    /// Of each camera of the rig: its last keyframe, and how many there were.
    keyframes: Vec<(Option<u64>, usize)>,
}

type Table<R> = Option<Peekable<Rows<R>>>;

/// Takes the next row if it is before a time.
fn next_before<R: Row>(table: &mut Table<R>, until_us: i64) -> Result<Option<R>, LogError> {
    let Some(rows) = table else { return Ok(None) };
    let is_next = |row: &Result<R, LogError>| match row {
        // Rows are in order of time, so the first that is too late ends the chunk and begins the
        // next.
        Ok(row) => row.time_us() < until_us,
        // An error is taken out, so that it is reported instead of ending the table quietly.
        Err(_) => true,
    };
    rows.next_if(is_next).transpose()
}

impl<'a> Splitter<'a> {
    fn new(
        log: &'a Log,
        poses: &'a Poses,
        stations: &'a Stations<'a>,
        settings: &'a SplitSettings,
    ) -> Result<Self, LogError> {
        let folder = fs::canonicalize(log.folder());
        Ok(Self {
            log,
            folder: folder.map_err(|error| LogError::file(log.folder(), &error))?,
            poses,
            stations,
            settings,
            images: log.images()?.map(Iterator::peekable),
            sweeps: log.sweeps()?.map(Iterator::peekable),
            tracks: log.tracks()?.map(Iterator::peekable),
            imu: log.imu()?.map(Iterator::peekable),
            gps: log.gps()?.map(Iterator::peekable),
            keyframes: vec![(None, 0); log.rig.cameras.len()],
        })
    }

    fn write_chunk(
        &mut self,
        number: usize,
        is_last: bool,
        out: &Path,
    ) -> Result<ChunkSummary, LogError> {
        let [first_us, last_us] = self.poses.span_us();
        let begin_m = number as f64 * self.settings.chunk_m;
        let end_m = self.stations.length_m().min(begin_m + self.settings.chunk_m);
        let end = self.stations.time_us(end_m).unwrap_or(last_us);
        // Rows after the last pose belong to the last chunk, and those before the first to the
        // first.
        let until_us = if is_last { i64::MAX } else { end };
        let begin_us = self.stations.time_us(begin_m).unwrap_or(first_us);
        let name = format!("{}-{number:04}", self.log.header.name);
        let header = Header { name: name.clone(), ..self.log.header.clone() };
        let mut writer = LogWriter::create(&out.join(&name), &header, &self.log.rig)?;
        self.write_poses([begin_us, until_us], &mut writer)?;
        let [images, held_out] = self.write_images(until_us, &mut writer)?;
        self.write_others(until_us, &mut writer)?;
        if let Some(map) = self.log.map()? {
            writer.put_map(&map)?;
        }
        writer.finish()?;
        let stations_m = [begin_m, end_m];
        Ok(ChunkSummary { name, stations_m, times_us: [begin_us, end], images, held_out })
    }

    /// Poses of a time, and those just outside of it, of which its first and last rows need one.
    fn write_poses(&self, [from, until]: [i64; 2], out: &mut LogWriter) -> Result<(), LogError> {
        let from_us = from.saturating_sub(LARGEST_GAP_US);
        let until_us = until.saturating_add(LARGEST_GAP_US);
        // The poses are in memory, so that chunks may overlap here: other tables are read only
        // once.
        let keys = self.poses.keyframes();
        let begin = keys.partition_point(|key| key.time_us < from_us);
        let end = keys.partition_point(|key| key.time_us < until_us);
        keys[begin..end].iter().try_for_each(|key: &Keyframe| out.add(key))
    }

    fn write_images(&mut self, until_us: i64, out: &mut LogWriter) -> Result<[usize; 2], LogError> {
        let mut counts = [0, 0];
        while let Some(row) = next_before(&mut self.images, until_us)? {
            let Some(kept) = self.keyframe(row)? else { continue };
            counts[0] += 1;
            counts[1] += usize::from(kept.held_out);
            out.add(&kept)?;
        }
        Ok(counts)
    }

    /// The row of an image with its mark, if it is the first of its camera at a keyframe.
    fn keyframe(&mut self, row: ImageRow) -> Result<Option<ImageRow>, LogError> {
        let Some(station_m) = self.stations.at(row.time_us) else { return Ok(None) };
        let camera = self.log.camera_index(&row.camera)?;
        // In spite of rounding, an image at exactly this distance is of the next keyframe.
        let number = (station_m / self.settings.keyframe_m + 1e-3).floor() as u64;
        let (last, count) = &mut self.keyframes[camera];
        // `None` is less than every number: the first image of a camera is always kept.
        if *last >= Some(number) {
            return Ok(None);
        }
        *last = Some(number);
        let held_out = count.is_multiple_of(self.settings.held_out_every);
        *count += 1;
        let absolute = |file: String| self.folder.join(file).to_string_lossy().into_owned();
        Ok(Some(ImageRow {
            file: absolute(row.file),
            mask: row.mask.map(absolute),
            ground_mask: row.ground_mask.map(absolute),
            sky_mask: row.sky_mask.map(absolute),
            held_out,
            ..row
        }))
    }

    fn write_others(&mut self, until_us: i64, out: &mut LogWriter) -> Result<(), LogError> {
        while let Some(row) = next_before(&mut self.sweeps, until_us)? {
            let file = self.folder.join(row.file).to_string_lossy().into_owned();
            out.add(&SweepRow { file, ..row })?;
        }
        while let Some(row) = next_before(&mut self.tracks, until_us)? {
            out.add(&row)?;
        }
        while let Some(row) = next_before(&mut self.imu, until_us)? {
            out.add(&row)?;
        }
        while let Some(row) = next_before(&mut self.gps, until_us)? {
            out.add(&row)?;
        }
        Ok(())
    }
}

/// Writes the sub-trajectories, each in a file of its own.
fn write_drives(
    log: &Log,
    poses: &Poses,
    out: &Path,
    settings: &SplitSettings,
) -> Result<Vec<DriveSummary>, LogError> {
    let folder = out.join("drives");
    fs::create_dir_all(&folder).map_err(|error| LogError::file(&folder, &error))?;
    let refused = |error: route::RouteError| LogError::malformed(log.folder(), error);
    let drive = poses.drive(log.header.name.clone());
    let route = Route::new(&drive).map_err(refused)?;
    let mut drives = Vec::new();
    for length_m in &settings.lengths_m {
        for cut in sub_trajectories(&route, *length_m, *length_m).map_err(refused)? {
            let cut = cut.map_err(refused)?;
            let name = cut.trajectory.name.clone();
            write_json(&folder.join(format!("{name}.json")), &cut.trajectory)?;
            drives.push(DriveSummary { name, stations_m: cut.stations_m, from_us: cut.from_us });
        }
    }
    Ok(drives)
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<(), LogError> {
    let text = serde_json::to_string(value).map_err(|error| LogError::malformed(path, error))?;
    fs::write(path, text + "\n").map_err(|error| LogError::file(path, &error))
}
