//! The points of a sweep, as safetensors: `points_m` F32 `[n, 3]` and `time_us` I64 `[n]`, and
//! perhaps `intensity` F32 `[n]` and `ring` U16 `[n]`.

use std::path::Path;

use glam::DVec3;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use wildcity_scene::geometry::Pose;

use crate::error::LogError;
use crate::row::SweepRow;

/// The points of a sweep, in the LiDAR's axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SweepPoints {
    /// Positions in metres. Points without a return may be NaN.
    pub points_m: Vec<[f32; 3]>,
    /// Times in microseconds on the log's clock, not decreasing.
    pub time_us: Vec<i64>,
    /// What came back, in the unit of the LiDAR.
    pub intensity: Option<Vec<f32>>,
    /// Number of the laser of each point.
    pub ring: Option<Vec<u16>>,
}

/// The tensors of a file, with the type that each has.
const TENSORS: [(&str, Dtype); 4] = [
    ("points_m", Dtype::F32),
    ("time_us", Dtype::I64),
    ("intensity", Dtype::F32),
    ("ring", Dtype::U16),
];

impl SweepPoints {
    /// Reads the bytes of a file; `path` is for errors.
    ///
    /// # Errors
    /// Names the tensor that is missing, unknown, or of another type or shape.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, LogError> {
        let file = SafeTensors::deserialize(bytes)
            .map_err(|error| LogError::malformed(path, format!("no safetensors file: {error}")))?;
        if let Some(name) = file.names().into_iter().find(|name| !is_known(name)) {
            let known = TENSORS.map(|(name, _)| name).join(", ");
            let reason = format!("tensor {name:?} is unknown; a sweep has {known}");
            return Err(LogError::malformed(path, reason));
        }
        let tensors = Tensors { file, path };
        let points = tensors.needed(0, None)?;
        // A point is three F32. The shape `[n, 3]` was checked, so that the division has no
        // remainder.
        let count = points.len() / 12;
        let sweep = Self {
            points_m: points.chunks_exact(12).map(point).collect(),
            time_us: values(tensors.needed(1, Some(count))?, i64::from_le_bytes),
            intensity: tensors.found(2, Some(count))?.map(|b| values(b, f32::from_le_bytes)),
            ring: tensors.found(3, Some(count))?.map(|b| values(b, u16::from_le_bytes)),
        };
        if !sweep.time_us.is_sorted() {
            // Neighbours in time are neighbours in angle: edges are looked for between them.
            return Err(tensors.refused(1, "decreases; sort the points by time".to_owned()));
        }
        Ok(sweep)
    }

    /// The bytes of a file.
    ///
    /// # Errors
    /// The lengths of the tensors differ; `path` is for errors.
    pub fn bytes(&self, path: &Path) -> Result<Vec<u8>, LogError> {
        let count = self.points_m.len();
        let points = bytes(self.points_m.iter().flatten(), |value: &f32| value.to_le_bytes());
        let times = bytes(&self.time_us, |value: &i64| value.to_le_bytes());
        let intensity =
            self.intensity.as_ref().map(|all| bytes(all, |value: &f32| value.to_le_bytes()));
        let ring = self.ring.as_ref().map(|all| bytes(all, |value: &u16| value.to_le_bytes()));
        // In the order of `TENSORS`, with which they are paired below.
        let all = [Some(points), Some(times), intensity, ring];
        let mut views = Vec::new();
        for ((name, dtype), data) in TENSORS.into_iter().zip(&all) {
            let shape = if name == "points_m" { vec![count, 3] } else { vec![count] };
            let Some(data) = data else { continue };
            let view = TensorView::new(dtype, shape, data)
                .map_err(|error| LogError::malformed(path, format!("{name}: {error}")))?;
            views.push((name, view));
        }
        safetensors::serialize(views, None).map_err(|error| LogError::malformed(path, error))
    }

    /// The points in the rig's axes, each with its time; those that the source has moved to a time
    /// have that one.
    pub fn on_rig(
        &self,
        row: &SweepRow,
        rig_from_lidar: Pose,
    ) -> impl Iterator<Item = (i64, DVec3)> {
        let moved_us = row.compensated_to_us;
        self.time_us.iter().zip(&self.points_m).map(move |(time_us, point_m)| {
            let point_m = DVec3::from_array(point_m.map(f64::from));
            (moved_us.unwrap_or(*time_us), rig_from_lidar.transform_point(point_m))
        })
    }

    /// How many points the sweep has.
    pub fn len(&self) -> usize {
        self.points_m.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points_m.is_empty()
    }
}

/// The tensors of a file that is read.
struct Tensors<'a> {
    file: SafeTensors<'a>,
    path: &'a Path,
}

impl Tensors<'_> {
    /// The bytes of a tensor, by its place in [`TENSORS`], if the file has it.
    fn found(&self, index: usize, count: Option<usize>) -> Result<Option<&[u8]>, LogError> {
        let (name, dtype) = TENSORS[index];
        // The only error is that no tensor has this name: the file as a whole has been checked.
        let Ok(tensor) = self.file.tensor(name) else { return Ok(None) };
        // Without a count it is the positions that are read: their number sets that of all others.
        let is_shape = match (tensor.shape(), count) {
            ([_, 3], None) => true,
            ([found], Some(count)) => *found == count,
            _ => false,
        };
        if tensor.dtype() == dtype && is_shape {
            return Ok(Some(tensor.data()));
        }
        let needed = count.map_or("n, 3".to_owned(), |count| count.to_string());
        let found = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
        Err(self.refused(index, format!("is {found}; {dtype:?} [{needed}] is needed")))
    }

    fn needed(&self, index: usize, count: Option<usize>) -> Result<&[u8], LogError> {
        self.found(index, count)?.ok_or_else(|| {
            self.refused(index, "is missing; points_m and time_us are needed".to_owned())
        })
    }

    fn refused(&self, index: usize, reason: String) -> LogError {
        let (tensor, _) = TENSORS[index];
        LogError::Sweep { path: self.path.to_owned(), tensor, reason }
    }
}

fn is_known(name: &str) -> bool {
    TENSORS.iter().any(|(known, _)| *known == name)
}

fn point(bytes: &[u8]) -> [f32; 3] {
    let all = values(bytes, f32::from_le_bytes);
    [all[0], all[1], all[2]]
}

/// The values of a tensor, which is little endian.
fn values<const N: usize, T>(bytes: &[u8], value: impl Fn([u8; N]) -> T) -> Vec<T> {
    let (values, _) = bytes.as_chunks::<N>();
    values.iter().map(|bytes| value(*bytes)).collect()
}

fn bytes<'a, const N: usize, T: 'a>(
    values: impl IntoIterator<Item = &'a T>,
    bytes: impl Fn(&T) -> [u8; N],
) -> Vec<u8> {
    values.into_iter().flat_map(bytes).collect()
}
