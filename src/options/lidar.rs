//! LiDARs of a rig.

use serde::{Deserialize, Serialize};

use crate::Pose;

/// A LiDAR on the rig. Its axes are x forward, y left, z up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct RigLidar {
    /// Name within the rig, also among the names of its cameras.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::NAME_PATTERN)))]
    pub name: String,
    /// The directions of its beams, and when they are fired.
    pub beams: LidarBeams,
    /// Pose of the LiDAR on the rig.
    pub lidar_to_rig: Pose,
}

/// The beams of a LiDAR, `[rows, columns]`. A beam has the elevation of its row and the azimuth of
/// its column plus the offset of its row. The tables of NVIDIA's ncore have the same names.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(transform = one_form_of_columns))]
pub struct LidarBeams {
    /// Elevation of each row, in radians, rising or falling.
    #[cfg_attr(
        feature = "schema",
        schemars(length(min = 1, max = 256), inner(range(min = -1.571, max = 1.571)))
    )]
    pub row_elevations_rad: Vec<f64>,
    /// Added to the azimuths of each row, in radians. 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(
        feature = "schema",
        schemars(length(min = 1, max = 256), inner(range(min = -0.5, max = 0.5)))
    )]
    pub row_azimuth_offsets_rad: Option<Vec<f64>>,
    /// Azimuth of each column, in radians from x to y, in the order in which they are fired.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(
        feature = "schema",
        schemars(length(min = 1, max = 4096), inner(range(min = -7.0, max = 7.0)))
    )]
    pub column_azimuths_rad: Option<Vec<f64>>,
    /// Columns at equal distances, instead of a table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub columns: Option<LidarColumns>,
    /// Time of a revolution, or of a frame of a LiDAR that does not spin, in microseconds. The
    /// columns are fired at equal distances, the last one at the time of the observation.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 1_000_000)))]
    pub duration_us: i64,
    /// Nothing nearer is returned, in metres. 0.5 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1_000.0)))]
    pub min_range_m: Option<f64>,
    /// Nothing farther is returned, in metres. 200 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1_000.0)))]
    pub max_range_m: Option<f64>,
}

/// Columns of a LiDAR at equal distances.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct LidarColumns {
    /// Number of columns in a sweep.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 4096)))]
    pub count: u64,
    /// Azimuth of the column that is fired first, in radians from x to y.
    #[cfg_attr(feature = "schema", schemars(range(min = -7.0, max = 7.0)))]
    pub first_rad: f64,
    /// Azimuth of the column that is fired last.
    #[cfg_attr(feature = "schema", schemars(range(min = -7.0, max = 7.0)))]
    pub last_rad: f64,
}

/// Says in the schema that the columns are given in exactly one of both forms.
#[cfg(feature = "schema")]
fn one_form_of_columns(schema: &mut schemars::Schema) {
    crate::require_exactly_one(schema, &["column_azimuths_rad", "columns"]);
}
