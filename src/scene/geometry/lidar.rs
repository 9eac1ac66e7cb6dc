//! LiDARs: tables of beams, fired column by column.
//!
//! A LiDAR's axes are x forward, y left, z up. The beam of row `r` and column `c` has the elevation
//! of its row and the azimuth of its column plus the azimuth offset of its row, counterclockwise
//! from x: `(cos e cos a, cos e sin a, sin e)`. This is the row-offset model of NVIDIA's ncore,
//! whose tables have the same names. A spinning LiDAR turns once in [`Lidar::duration_us`]; a
//! solid-state one scans its columns in that time.

use glam::DVec3;

use wildcity_options as options;

/// The beams of a LiDAR and its range.
#[derive(Clone, Debug, PartialEq)]
pub struct Lidar {
    /// Elevation of each row, in radians, rising or falling.
    row_elevations_rad: Vec<f64>,
    /// Added to the azimuths of a row's beams, in radians.
    row_azimuth_offsets_rad: Vec<f64>,
    /// Azimuth of each column, in radians, in the order in which columns are fired.
    column_azimuths_rad: Vec<f64>,
    /// How the columns are written in files.
    columns: Columns,
    duration_us: i64,
    min_range_m: f64,
    max_range_m: f64,
}

/// How the columns of a LiDAR were given.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Columns {
    Table,
    Even { first_rad: f64, last_rad: f64 },
}

/// Why a LiDAR was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LidarError {
    /// Too few or too many rows or columns.
    #[error("{field} has {count} entries; 1 to {limit} are accepted")]
    Count { field: &'static str, count: u64, limit: usize },
    /// Another number of offsets than of rows.
    #[error("row_azimuth_offsets_rad has {offsets} entries for {rows} rows: give one for each row")]
    Offsets { offsets: usize, rows: usize },
    /// A value is out of its range.
    #[error("{field} is {value}; {must}")]
    Value { field: String, value: f64, must: &'static str },
    /// Rows that do not follow each other.
    #[error("row_elevations_rad[{row}] is {value}: elevations must rise or fall from row to row")]
    Order { row: usize, value: f64 },
    /// Columns that are in no order of a scan.
    #[error(
        "column_azimuths_rad jumps by more than 0.2 rad {jumps} times; at most {limit} are accepted: \
         list the columns in the order in which they are scanned"
    )]
    Jumps { jumps: usize, limit: usize },
    /// Azimuths that are given twice, or not at all.
    #[error("columns: give either columns or column_azimuths_rad, and not both")]
    Columns,
}

impl LidarError {
    /// The field at fault.
    pub fn field(&self) -> &str {
        match self {
            Self::Count { field, .. } => field,
            Self::Offsets { .. } => "row_azimuth_offsets_rad",
            Self::Value { field, .. } => field,
            Self::Order { .. } => "row_elevations_rad",
            Self::Jumps { .. } => "column_azimuths_rad",
            Self::Columns => "columns",
        }
    }
}

impl Lidar {
    /// Most rows of a LiDAR, twice those of common ones.
    pub const MAX_ROWS: usize = 256;
    /// Most columns of a sweep: 0.09 degrees apart in a turn.
    pub const MAX_COLUMNS: usize = 4096;
    /// An angle between two columns that counts as a jump, in radians. Even columns this far apart
    /// are 31 in a turn.
    const JUMP_RAD: f64 = 0.2;
    /// Most jumps between two columns.
    const MAX_JUMPS: usize = 64;
    /// Longest time of a sweep, in microseconds: 1 s.
    pub const MAX_DURATION_US: i64 = 1_000_000;
    /// Farthest accepted range, in metres.
    pub const MAX_RANGE_M: f64 = 1_000.0;

    /// Returns nearer than this are the vehicle's own body or dust on the window, in metres.
    const MIN_RANGE_M: f64 = 0.5;
    /// What a LiDAR that names no range sees, in metres.
    const DEFAULT_RANGE_M: f64 = 200.0;

    /// The LiDAR of a rig file or a request.
    ///
    /// # Errors
    /// Names the first field that is invalid.
    pub fn from_options(fields: &options::LidarBeams) -> Result<Self, LidarError> {
        let rows = fields.row_elevations_rad.len();
        count("row_elevations_rad", rows as u64, Self::MAX_ROWS)?;
        let offsets = match &fields.row_azimuth_offsets_rad {
            None => vec![0.0; rows],
            Some(offsets) if offsets.len() == rows => offsets.clone(),
            Some(offsets) => return Err(LidarError::Offsets { offsets: offsets.len(), rows }),
        };
        let (azimuths, columns) = match (&fields.column_azimuths_rad, fields.columns) {
            (Some(azimuths), None) => {
                count("column_azimuths_rad", azimuths.len() as u64, Self::MAX_COLUMNS)?;
                (azimuths.clone(), Columns::Table)
            }
            (None, Some(options::LidarColumns { count: columns, first_rad, last_rad })) => {
                count("columns.count", columns, Self::MAX_COLUMNS)?;
                // A single column has no step, and is at the first azimuth.
                let step = (last_rad - first_rad) / (columns.max(2) - 1) as f64;
                let azimuths = (0..columns).map(|column| first_rad + step * column as f64);
                (azimuths.collect(), Columns::Even { first_rad, last_rad })
            }
            _ => return Err(LidarError::Columns),
        };
        let lidar = Self {
            row_elevations_rad: fields.row_elevations_rad.clone(),
            row_azimuth_offsets_rad: offsets,
            column_azimuths_rad: azimuths,
            columns,
            duration_us: fields.duration_us,
            min_range_m: fields.min_range_m.unwrap_or(Self::MIN_RANGE_M),
            max_range_m: fields.max_range_m.unwrap_or(Self::DEFAULT_RANGE_M),
        };
        lidar.check()?;
        Ok(lidar)
    }

    fn check(&self) -> Result<(), LidarError> {
        use std::f64::consts::FRAC_PI_2;
        let angles = [
            ("row_elevations_rad", &self.row_elevations_rad, FRAC_PI_2, "give -pi/2 to pi/2"),
            ("row_azimuth_offsets_rad", &self.row_azimuth_offsets_rad, 0.5, "give -0.5 to 0.5"),
            ("column_azimuths_rad", &self.column_azimuths_rad, 7.0, "give -7 to 7"),
        ];
        for (name, values, most, must) in angles {
            for (index, &value) in values.iter().enumerate() {
                // NaN is in no range.
                if !(-most..=most).contains(&value) {
                    return Err(LidarError::Value {
                        field: format!("{name}[{index}]"),
                        value,
                        must,
                    });
                }
            }
        }
        let rises = self.row_elevations_rad.last() > self.row_elevations_rad.first();
        for (row, pair) in self.row_elevations_rad.windows(2).enumerate() {
            if (pair[1] > pair[0]) != rises || pair[1] == pair[0] {
                return Err(LidarError::Order { row: row + 1, value: pair[1] });
            }
        }
        // A sweep is cast in sectors of columns that look the same way, so that each jump costs as
        // much as a sector.
        let is_jump = |pair: &&[f64]| (pair[1] - pair[0]).abs() > Self::JUMP_RAD;
        let jumps = self.column_azimuths_rad.windows(2).filter(is_jump).count();
        if jumps > Self::MAX_JUMPS {
            return Err(LidarError::Jumps { jumps, limit: Self::MAX_JUMPS });
        }
        let duration = self.duration_us as f64;
        if !(1..=Self::MAX_DURATION_US).contains(&self.duration_us) {
            let must = "a sweep takes 1 to 1,000,000 us";
            return Err(LidarError::Value { field: "duration_us".into(), value: duration, must });
        }
        let Self { min_range_m, max_range_m, .. } = *self;
        if !(0.0..=Self::MAX_RANGE_M).contains(&min_range_m) {
            let must = "give 0 to 1,000 m";
            return Err(LidarError::Value {
                field: "min_range_m".into(),
                value: min_range_m,
                must,
            });
        }
        if !(max_range_m > min_range_m && max_range_m <= Self::MAX_RANGE_M) {
            let must = "give more than min_range_m, and at most 1,000 m";
            return Err(LidarError::Value {
                field: "max_range_m".into(),
                value: max_range_m,
                must,
            });
        }
        Ok(())
    }

    /// Number of rows of beams, from 1.
    pub fn rows(&self) -> usize {
        self.row_elevations_rad.len()
    }

    /// Number of columns of a sweep, from 1.
    pub fn columns(&self) -> usize {
        self.column_azimuths_rad.len()
    }

    /// Number of beams of a sweep.
    pub fn beams(&self) -> usize {
        self.rows() * self.columns()
    }

    /// Elevation of each row, in radians, rising or falling.
    pub fn row_elevations_rad(&self) -> &[f64] {
        &self.row_elevations_rad
    }

    /// The time of a sweep, in microseconds. Column `c` of `n` is fired `(n - 1 - c) / n` of it
    /// before the sweep's time, which is that of the last column.
    pub fn duration_us(&self) -> i64 {
        self.duration_us
    }

    /// Nothing nearer is returned, in metres.
    pub fn min_range_m(&self) -> f64 {
        self.min_range_m
    }

    /// Nothing farther is returned, in metres.
    pub fn max_range_m(&self) -> f64 {
        self.max_range_m
    }

    /// The azimuth of a beam, in radians from x to y.
    pub fn azimuth_rad(&self, row: usize, column: usize) -> f64 {
        self.column_azimuths_rad[column] + self.row_azimuth_offsets_rad[row]
    }

    /// The unit direction of a beam, in the LiDAR's axes.
    pub fn direction(&self, row: usize, column: usize) -> DVec3 {
        let (sin_e, cos_e) = self.row_elevations_rad[row].sin_cos();
        let (sin_a, cos_a) = self.azimuth_rad(row, column).sin_cos();
        DVec3::new(cos_e * cos_a, cos_e * sin_a, sin_e)
    }

    /// When a column is fired, as a fraction of the sweep: `1/n` for the first, 1 for the last. The
    /// first column of the next sweep follows after the same time as any other.
    pub fn fraction(&self, column: usize) -> f64 {
        (column + 1) as f64 / self.columns() as f64
    }

    /// How long before the sweep's time a column is fired, in microseconds.
    pub fn age_us(&self, column: usize) -> f64 {
        (1.0 - self.fraction(column)) * self.duration_us as f64
    }

    /// The mean angle between neighbouring beams along the finer of rows and columns, in radians.
    /// Its inverse corresponds to a focal length in pixels.
    pub fn resolution_rad(&self) -> f64 {
        let mean = |angles: &[f64]| match angles {
            [first, .., last] => (last - first).abs() / (angles.len() - 1) as f64,
            _ => f64::INFINITY,
        };
        let finer = mean(&self.row_elevations_rad).min(mean(&self.column_azimuths_rad));
        // A single beam still has a width: that of common LiDARs, 0.2 degrees.
        if finer.is_finite() && finer > 0.0 { finer } else { 0.2_f64.to_radians() }
    }

    /// The fields of a rig file.
    pub fn to_options(&self) -> options::LidarBeams {
        let (table, columns) = match self.columns {
            Columns::Table => (Some(self.column_azimuths_rad.clone()), None),
            Columns::Even { first_rad, last_rad } => {
                let count = self.columns() as u64;
                (None, Some(options::LidarColumns { count, first_rad, last_rad }))
            }
        };
        let has_offsets = self.row_azimuth_offsets_rad.iter().any(|offset| *offset != 0.0);
        options::LidarBeams {
            row_elevations_rad: self.row_elevations_rad.clone(),
            row_azimuth_offsets_rad: has_offsets.then(|| self.row_azimuth_offsets_rad.clone()),
            column_azimuths_rad: table,
            columns,
            duration_us: self.duration_us,
            min_range_m: Some(self.min_range_m),
            max_range_m: Some(self.max_range_m),
        }
    }
}

fn count(field: &'static str, count: u64, limit: usize) -> Result<(), LidarError> {
    if (1..=limit as u64).contains(&count) {
        Ok(())
    } else {
        Err(LidarError::Count { field, count, limit })
    }
}
