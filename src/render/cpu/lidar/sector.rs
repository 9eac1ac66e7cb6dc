//! Sectors: runs of columns of a LiDAR that look the same way.

use std::ops::Range;

use glam::{DMat3, DVec3};

use crate::lidar::{Body, LidarView};
use wildcity_scene::Chunk;
use wildcity_scene::chunk::LANES;
use wildcity_scene::geometry::Pose;

/// Most columns of a sector: 4 tiles. A tenth of a second of 30 m/s is 3 m, of which a sector of a
/// sweep of 2,048 columns has 0.09 m.
pub(super) const MOST_COLUMNS: usize = 64;

/// Largest angle between the azimuths of a sector, in radians. Row offsets alone may span 1 rad.
const MOST_RAD: f64 = 1.05;

/// The tangent of a beam that looks straight up or down, which has none. A point 0.1 mm beside such
/// a beam at 100 m has it.
const STEEPEST: f64 = 1e6;

/// A run of columns.
pub(super) struct Sector {
    pub(super) columns: Range<usize>,
    /// The azimuth around which the sector's axes are turned, in radians.
    middle_rad: f64,
    /// Tangents of the azimuths of each tile's columns in the sector's axes, smallest and largest
    /// over all rows. A tile's last columns may be missing: those see nothing.
    pub(super) tile_tangents: Vec<[[f32; LANES]; 2]>,
    /// The smallest and the largest of each tile.
    pub(super) tile_spans: Vec<[f32; 2]>,
    /// Tangents of the rows' elevations, rising or falling.
    row_tangents: Vec<f32>,
    /// The range of the LiDAR, in metres: nothing nearer or farther returns.
    pub(super) min_range_m: f32,
    pub(super) max_range_m: f32,
    /// Cosine and sine of each row's elevation, and those of its azimuth offset.
    row_angles: Vec<[f64; 4]>,
    /// Cosine and sine of the azimuth of each column of the first row.
    column_angles: Vec<[f64; 2]>,
}

/// A sector as one body sees it.
pub(super) struct BodySector<'a> {
    pub(super) sector: &'a Sector,
    pub(super) body: Body<'a>,
    /// The LiDAR's pose in the body's axes when each column is fired.
    pub(super) poses: Vec<Pose>,
    /// That of the middle column.
    pub(super) middle: Pose,
    /// Takes directions in the body's axes to the sector's: x forward, y left, z up, as the middle
    /// column sees them.
    pub(super) sector_from_body: DMat3,
    /// The most that the LiDAR moves from there, in metres.
    pub(super) moved_m: f64,
    /// The most that it turns from there, in radians.
    pub(super) turned_rad: f64,
}

impl Sector {
    /// The sectors of a LiDAR, in order of columns.
    pub(super) fn split(view: &LidarView) -> Vec<Self> {
        let lidar = &view.lidar;
        // A row's offset is that of its azimuth in any column.
        let offset = |row| lidar.azimuth_rad(row, 0) - lidar.azimuth_rad(0, 0);
        let offsets = (0..lidar.rows()).map(offset);
        let least = offsets.clone().fold(f64::INFINITY, f64::min);
        let most = offsets.fold(f64::NEG_INFINITY, f64::max);
        let azimuths = |column| {
            let first = lidar.azimuth_rad(0, column);
            [first + least, first + most]
        };
        let mut sectors = Vec::new();
        let mut start = 0;
        let mut span = azimuths(0);
        for column in 0..lidar.columns() {
            let [low, high] = azimuths(column);
            let wider = [span[0].min(low), span[1].max(high)];
            let is_full = column - start == MOST_COLUMNS || wider[1] - wider[0] > MOST_RAD;
            if is_full && column > start {
                sectors.push(Self::new(view, start..column, span, &azimuths));
                start = column;
                span = [low, high];
            } else {
                span = wider;
            }
        }
        sectors.push(Self::new(view, start..lidar.columns(), span, &azimuths));
        sectors
    }

    fn new(
        view: &LidarView,
        columns: Range<usize>,
        [low, high]: [f64; 2],
        azimuths: &dyn Fn(usize) -> [f64; 2],
    ) -> Self {
        let middle_rad = 0.5 * (low + high);
        let tile = |start: usize| {
            let mut tangents = [[f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]];
            for column in start..(start + LANES).min(columns.end) {
                let [low, high] = azimuths(column).map(|azimuth| (azimuth - middle_rad).tan());
                // Outwards by more than the rounding of f32.
                tangents[0][column - start] = low as f32 - 1e-6;
                tangents[1][column - start] = high as f32 + 1e-6;
            }
            tangents
        };
        let tangent = |elevation: &f64| elevation.tan().clamp(-STEEPEST, STEEPEST) as f32;
        let tile_tangents: Vec<_> = columns.clone().step_by(LANES).map(tile).collect();
        let span = |[least, most]: &[[f32; LANES]; 2]| {
            let least = least.iter().copied().fold(f32::INFINITY, f32::min);
            [least, most.iter().copied().fold(f32::NEG_INFINITY, f32::max)]
        };
        Self {
            middle_rad,
            tile_spans: tile_tangents.iter().map(span).collect(),
            tile_tangents,
            row_tangents: view.lidar.row_elevations_rad().iter().map(tangent).collect(),
            min_range_m: view.lidar.min_range_m() as f32,
            max_range_m: view.lidar.max_range_m() as f32,
            row_angles: (0..view.lidar.rows()).map(|row| row_angles(view, row)).collect(),
            column_angles: columns.clone().map(|column| column_angles(view, column)).collect(),
            columns,
        }
    }

    /// The direction of a beam in the LiDAR's axes, by the sums of angles: 128 x 2,048 beams have
    /// 2,176 sines and not 500,000.
    pub(super) fn direction(&self, row: usize, column: usize) -> DVec3 {
        let [cos_e, sin_e, cos_o, sin_o] = self.row_angles[row];
        let [cos_a, sin_a] = self.column_angles[column - self.columns.start];
        let cos = cos_a * cos_o - sin_a * sin_o;
        let sin = sin_a * cos_o + cos_a * sin_o;
        DVec3::new(cos_e * cos, cos_e * sin, sin_e)
    }

    /// The smallest and the largest tangent of the rows' elevations.
    pub(super) fn elevation_tangents(&self) -> [f32; 2] {
        // A LiDAR has rows.
        let first = self.row_tangents[0];
        let last = self.row_tangents[self.row_tangents.len() - 1];
        [first.min(last), first.max(last)]
    }

    /// The rows whose elevations have tangents from `low` to `high`.
    pub(super) fn rows_between(&self, low: f32, high: f32) -> Range<usize> {
        let tangents = &self.row_tangents;
        let rises = tangents[0] < tangents[tangents.len() - 1];
        // Tangents at the clamp are equal to each other, so that a test with equality keeps them.
        let first = if rises {
            tangents.partition_point(|tangent| *tangent < low)
        } else {
            tangents.partition_point(|tangent| *tangent > high)
        };
        let end = if rises {
            tangents.partition_point(|tangent| *tangent <= high)
        } else {
            tangents.partition_point(|tangent| *tangent >= low)
        };
        first..end.max(first)
    }

    /// This sector as a body sees it.
    pub(super) fn seen_from<'a>(&'a self, body: Body<'a>, view: &LidarView) -> BodySector<'a> {
        let at = |column| body.body_from_lidar(view, column);
        let poses: Vec<Pose> = self.columns.clone().map(at).collect();
        let middle = poses[poses.len() / 2];
        let mut moved_m: f64 = 0.0;
        let mut turned_rad: f64 = 0.0;
        for pose in &poses {
            moved_m = moved_m.max(pose.position_m.distance(middle.position_m));
            turned_rad = turned_rad.max(pose.rotation.angle_between(middle.rotation));
        }
        let lidar_from_sector = DMat3::from_rotation_z(self.middle_rad);
        let body_from_sector = middle.rotation_matrix() * lidar_from_sector;
        BodySector {
            sector: self,
            body,
            middle,
            sector_from_body: body_from_sector.transpose(),
            moved_m,
            turned_rad,
            poses,
        }
    }
}

fn row_angles(view: &LidarView, row: usize) -> [f64; 4] {
    let lidar = &view.lidar;
    let (sin_e, cos_e) = lidar.row_elevations_rad()[row].sin_cos();
    let (sin_o, cos_o) = (lidar.azimuth_rad(row, 0) - lidar.azimuth_rad(0, 0)).sin_cos();
    [cos_e, sin_e, cos_o, sin_o]
}

fn column_angles(view: &LidarView, column: usize) -> [f64; 2] {
    let (sin, cos) = view.lidar.azimuth_rad(0, column).sin_cos();
    [cos, sin]
}

impl BodySector<'_> {
    /// A position in the body's axes relative to the LiDAR's middle position, in metres.
    pub(super) fn relative_to_middle(&self, position_m: DVec3) -> DVec3 {
        position_m - self.middle.position_m
    }

    /// How far a chunk's first Gaussians are from the LiDAR, in metres.
    pub(super) fn distance_m(&self, chunk: &Chunk) -> f64 {
        let middle_m = -self.relative_to_middle(chunk.origin_m());
        let first = chunk.clusters().first().map(|first| 0.5 * (first.min_m + first.max_m));
        first.map_or(f64::INFINITY, |first| first.as_dvec3().distance(middle_m))
    }
}
