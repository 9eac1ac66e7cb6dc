//! A folder that is a log.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DVec3;
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_sim::map::MapFile;

use crate::error::{FieldError, LogError};
use crate::header::Header;
use crate::limits;
use crate::points::SweepPoints;
use crate::poses::Poses;
use crate::row::{GpsRow, ImageRow, ImuRow, Row, SweepRow, TrackRow};
use crate::table::{Rows, json_reason};

/// A log: its header and its rig in memory, everything else on disk.
#[derive(Clone, Debug)]
pub struct Log {
    folder: PathBuf,
    pub header: Header,
    pub rig: Rig,
}

impl Log {
    /// Opens a folder: reads `log.json` and `rig.json`.
    ///
    /// # Errors
    /// Names the file and the field that cannot be used.
    pub fn open(folder: &Path) -> Result<Self, LogError> {
        let path = folder.join("log.json");
        if !path.is_file() {
            return Err(LogError::NoLog { folder: folder.to_owned() });
        }
        let header: Header = read_json(&path)?;
        header.check().map_err(|FieldError { field, reason }| LogError::Field {
            path,
            field,
            reason,
        })?;
        let rig = read_rig(folder)?;
        Ok(Self { folder: folder.to_owned(), header, rig })
    }

    /// Whether a folder is a log, rather than a capture of another form.
    pub fn is_log(folder: &Path) -> bool {
        folder.is_dir() && folder.join("log.json").is_file()
    }

    /// Where the log is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A file that a row names.
    pub fn path(&self, file: &str) -> PathBuf {
        // `join` returns an absolute path as it is.
        self.folder.join(file)
    }

    /// The poses of the rig, row by row.
    ///
    /// # Errors
    /// There is no `poses.jsonl`.
    pub fn pose_rows(&self) -> Result<Rows<Keyframe>, LogError> {
        let needed_for = "a log is placed in the world by its poses";
        self.table()?.ok_or_else(|| self.missing(Keyframe::FILE, needed_for))
    }

    /// The poses of the rig, all in memory: 64 bytes each.
    ///
    /// # Errors
    /// There are none, or more than [`limits::POSES`], or a row cannot be used.
    pub fn poses(&self) -> Result<Poses, LogError> {
        let path = self.folder.join(Keyframe::FILE);
        let mut keyframes = Vec::new();
        for row in self.pose_rows()? {
            if keyframes.len() == limits::POSES {
                let reason = format!("more than {} poses; split the log", limits::POSES);
                return Err(LogError::malformed(&path, reason));
            }
            keyframes.push(row?);
        }
        if keyframes.is_empty() {
            return Err(LogError::malformed(&path, "it has no pose; one is needed"));
        }
        Ok(Poses::new(keyframes))
    }

    /// The images, row by row, if the log has any. Each is of a camera of the rig.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn images(&self) -> Result<Option<Rows<ImageRow>>, LogError> {
        self.table()
    }

    /// The sweeps, row by row, if the log has any.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn sweeps(&self) -> Result<Option<Rows<SweepRow>>, LogError> {
        self.table()
    }

    /// The boxes around objects, row by row, if the log has any.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn tracks(&self) -> Result<Option<Rows<TrackRow>>, LogError> {
        self.table()
    }

    /// The measurements of the inertial unit, row by row, if the log has any.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn imu(&self) -> Result<Option<Rows<ImuRow>>, LogError> {
        self.table()
    }

    /// The satellite fixes, row by row, if the log has any.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn gps(&self) -> Result<Option<Rows<GpsRow>>, LogError> {
        self.table()
    }

    /// The map, if the log has one.
    ///
    /// # Errors
    /// It cannot be read, or names the place of its first mistake.
    pub fn map(&self) -> Result<Option<MapFile>, LogError> {
        let path = self.folder.join("map.json");
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = read_whole(&path, limits::MAP_BYTES)?;
        MapFile::parse(&bytes).map(Some).map_err(|cause| LogError::Map { path, cause })
    }

    /// The points of a sweep.
    ///
    /// # Errors
    /// The file cannot be read, or a tensor of it cannot be used.
    pub fn points(&self, row: &SweepRow) -> Result<SweepPoints, LogError> {
        let path = self.path(&row.file);
        SweepPoints::parse(&read_whole(&path, limits::SWEEP_BYTES)?, &path)
    }

    /// The points of a sweep as [`SweepPoints::on_rig`] has them.
    ///
    /// # Errors
    /// As [`Log::points`] and [`Log::rig_from_lidar`].
    pub fn points_on_rig(&self, row: &SweepRow) -> Result<Vec<(i64, DVec3)>, LogError> {
        let rig_from_lidar = self.rig_from_lidar(&row.lidar)?;
        Ok(self.points(row)?.on_rig(row, rig_from_lidar).collect())
    }

    /// Where a LiDAR is on the rig.
    ///
    /// # Errors
    /// `log.json` does not name it.
    pub fn rig_from_lidar(&self, name: &str) -> Result<Pose, LogError> {
        let mount = self.header.lidars.iter().find(|lidar| lidar.name == name);
        mount.map(|lidar| lidar.rig_from_lidar).ok_or_else(|| LogError::Field {
            path: self.folder.join("log.json"),
            field: "lidars".to_owned(),
            reason: format!("there is no {name:?}, of which lidar.jsonl has a sweep; add its pose"),
        })
    }

    /// Index of a camera in the rig.
    ///
    /// # Errors
    /// `rig.json` does not name it.
    pub fn camera_index(&self, name: &str) -> Result<usize, LogError> {
        let index = self.rig.cameras.iter().position(|camera| camera.name == name);
        index.ok_or_else(|| LogError::Field {
            path: self.folder.join("rig.json"),
            field: "cameras".to_owned(),
            reason: format!("there is no {name:?}, of which images.jsonl has an image; add it"),
        })
    }

    /// A table, if its file is there.
    fn table<R: Row>(&self) -> Result<Option<Rows<R>>, LogError> {
        let path = self.folder.join(R::FILE);
        path.exists().then(|| Rows::open(&path)).transpose()
    }

    fn missing(&self, table: &'static str, needed_for: &'static str) -> LogError {
        LogError::NoTable { folder: self.folder.clone(), table, needed_for }
    }
}

fn read_rig(folder: &Path) -> Result<Rig, LogError> {
    let path = folder.join("rig.json");
    if !path.is_file() {
        let needed_for = "images need the lenses and the places of their cameras";
        return Err(LogError::NoTable { folder: folder.to_owned(), table: "rig.json", needed_for });
    }
    let rig: Rig = read_json(&path)?;
    rig.check().map_err(|cause| LogError::Rig { path, cause })?;
    Ok(rig)
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, LogError> {
    let bytes = read_whole(path, limits::SETTINGS_BYTES)?;
    let mut deserializer = serde_json::Deserializer::from_slice(&bytes);
    let read = serde_path_to_error::deserialize(&mut deserializer);
    let value = read.map_err(|error| LogError::Field {
        path: path.to_owned(),
        field: error.path().to_string(),
        reason: json_reason(error.inner()),
    })?;
    // Another object after the first one is no part of the file's form.
    deserializer.end().map_err(|error| LogError::malformed(path, error))?;
    Ok(value)
}

/// Reads a file of at most `limit` bytes.
pub(crate) fn read_whole(path: &Path, limit: u64) -> Result<Vec<u8>, LogError> {
    // Before it is opened: to open a FIFO waits for another process that writes.
    let metadata = fs::metadata(path).map_err(|error| LogError::file(path, &error))?;
    if !metadata.is_file() {
        return Err(LogError::malformed(path, "it is not a file"));
    }
    let file = File::open(path).map_err(|error| LogError::file(path, &error))?;
    let mut bytes = Vec::new();
    // Not the length that the system states: the file may grow while it is read.
    let read = file.take(limit + 1).read_to_end(&mut bytes);
    read.map_err(|error| LogError::file(path, &error))?;
    if bytes.len() as u64 > limit {
        return Err(LogError::malformed(path, format!("it has more than {limit} bytes")));
    }
    Ok(bytes)
}
