//! Sectors: runs of columns of a LiDAR that look the same way.

use std::ops::Range;
use std::sync::Arc;

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat3, DVec3};

use super::rows::Rows;
use crate::lidar::{Body, LidarView};
use wildcity_scene::chunk::LANES;
use wildcity_scene::geometry::Pose;

/// Most columns of a sector: 4 tiles. A tenth of a second of 30 m/s is 3 m, of which a sector of a
/// sweep of 2,048 columns has 0.09 m.
pub(crate) const MOST_COLUMNS: usize = 64;

/// Largest angle between the azimuths of a sector, in radians. Row offsets alone may span 1 rad.
const MOST_RAD: f64 = 1.05;

/// A run of columns.
pub(crate) struct Sector {
    pub(crate) columns: Range<usize>,
    /// The azimuth around which the sector's axes are turned, in radians.
    middle_rad: f64,
    /// Its columns, 16 at a time.
    pub(super) tiles: Vec<TileColumns>,
    pub(crate) rows: Arc<Rows>,
    /// The range of the LiDAR, in metres: nothing nearer or farther returns.
    pub(crate) min_range_m: f32,
    pub(crate) max_range_m: f32,
    /// Cosine and sine of the azimuth of each column of the first row.
    column_angles: Vec<[f64; 2]>,
}

/// The azimuths of 16 columns in a sector's axes.
pub(super) struct TileColumns {
    /// Tangents of each column, smallest and largest over all rows. The last columns may be
    /// missing: those see nothing.
    pub(super) tangents: [[f32; LANES]; 2],
    /// The smallest and the largest of all.
    pub(super) span: [f32; 2],
    /// The widest gap between columns: an interval within the span that is wider meets a column.
    pub(super) widest_gap: f32,
}

/// A sector as one body sees it.
pub(crate) struct BodySector<'a> {
    pub(crate) sector: &'a Sector,
    pub(super) body: Body<'a>,
    /// The LiDAR's pose in the body's axes when each column is fired.
    pub(crate) poses: Vec<Pose>,
    /// That of the middle column.
    pub(super) middle: Pose,
    /// Takes directions in the body's axes to the sector's: x forward, y left, z up, as the middle
    /// column sees them.
    pub(super) sector_from_body: DMat3,
    /// The most that the LiDAR moves from there along each of the sector's axes, in metres.
    pub(super) moved_m: DVec3,
    /// The most that it turns from there, in radians.
    pub(super) turned_rad: f64,
}

impl TileColumns {
    /// `tangents` has the smallest and the largest of each column.
    fn new(tangents: &[[f32; 2]]) -> Self {
        // A missing column has an interval that ends before it begins, which meets no other.
        let mut lanes = [[f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]];
        for (lane, [low, high]) in tangents.iter().enumerate() {
            lanes[0][lane] = *low;
            lanes[1][lane] = *high;
        }
        let mut sorted = tangents.to_vec();
        sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut widest_gap: f32 = 0.0;
        // A tile has at least one column.
        let mut reached = sorted[0][1];
        for [low, high] in &sorted {
            widest_gap = widest_gap.max(low - reached);
            reached = reached.max(*high);
        }
        Self { tangents: lanes, span: [sorted[0][0], reached], widest_gap }
    }

    /// Whether its columns look between and beyond azimuths with these tangents.
    pub(super) fn overlap(&self, [low, high]: [f32; 2]) -> bool {
        let [least, most] = self.span;
        least <= high && most >= low
    }

    /// Whether a column sees azimuths with these tangents.
    #[inline(always)]
    pub(super) fn see<S: Simd>(&self, simd: S, azimuths: [f32; 2]) -> bool {
        if !self.overlap(azimuths) {
            return false;
        }
        let [low, high] = azimuths;
        // Many Gaussians far away lie between two columns.
        let [least, most] = &self.tangents;
        let sees = || {
            f32x16::load_array_ref(simd, least).simd_le(f32x16::splat(simd, high))
                & f32x16::load_array_ref(simd, most).simd_ge(f32x16::splat(simd, low))
        };
        high - low > self.widest_gap || !sees().all_false()
    }
}

impl Sector {
    /// The sectors of a LiDAR, in order of columns.
    pub(crate) fn split(view: &LidarView) -> Vec<Self> {
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
        let rows = Arc::new(Rows::new(view));
        let mut sectors = Vec::new();
        let mut start = 0;
        let mut span = azimuths(0);
        for column in 0..lidar.columns() {
            let [low, high] = azimuths(column);
            let wider = [span[0].min(low), span[1].max(high)];
            let is_full = column - start == MOST_COLUMNS || wider[1] - wider[0] > MOST_RAD;
            // One column is always taken. The offsets of its rows spread it by at most 1 rad.
            if is_full && column > start {
                sectors.push(Self::new(rows.clone(), view, start..column, span, &azimuths));
                start = column;
                span = [low, high];
            } else {
                span = wider;
            }
        }
        sectors.push(Self::new(rows, view, start..lidar.columns(), span, &azimuths));
        sectors
    }

    fn new(
        rows: Arc<Rows>,
        view: &LidarView,
        columns: Range<usize>,
        [low, high]: [f64; 2],
        azimuths: &dyn Fn(usize) -> [f64; 2],
    ) -> Self {
        // Tangents rise only within a quarter turn of the middle; half of MOST_RAD is far less.
        let middle_rad = 0.5 * (low + high);
        let tangents = |column| {
            let [low, high] = azimuths(column).map(|azimuth| (azimuth - middle_rad).tan());
            // Outwards by more than the rounding of f32.
            [low as f32 - 1e-6, high as f32 + 1e-6]
        };
        let tile = |start: usize| {
            let columns = start..(start + LANES).min(columns.end);
            TileColumns::new(&columns.map(tangents).collect::<Vec<_>>())
        };
        Self {
            middle_rad,
            tiles: columns.clone().step_by(LANES).map(tile).collect(),
            min_range_m: view.lidar.min_range_m() as f32,
            max_range_m: view.lidar.max_range_m() as f32,
            rows,
            column_angles: columns.clone().map(|column| column_angles(view, column)).collect(),
            columns,
        }
    }

    /// The direction of a beam in the LiDAR's axes, by the sums of angles: 128 x 2,048 beams have
    /// 2,176 sines and not 500,000.
    pub(super) fn direction(&self, row: usize, column: usize) -> DVec3 {
        let [cos_e, sin_e, cos_o, sin_o] = self.rows.angles[row];
        let [cos_a, sin_a] = self.azimuth(column);
        let cos = cos_a * cos_o - sin_a * sin_o;
        let sin = sin_a * cos_o + cos_a * sin_o;
        DVec3::new(cos_e * cos, cos_e * sin, sin_e)
    }

    /// Cosine and sine of the azimuth of a column of the first row.
    pub(crate) fn azimuth(&self, column: usize) -> [f64; 2] {
        self.column_angles[column - self.columns.start]
    }

    /// This sector as a body sees it.
    pub(super) fn seen_from<'a>(&'a self, body: Body<'a>, view: &LidarView) -> BodySector<'a> {
        let at = |column| body.body_from_lidar(view, column);
        let poses: Vec<Pose> = self.columns.clone().map(at).collect();
        let middle = poses[poses.len() / 2];
        let lidar_from_sector = DMat3::from_rotation_z(self.middle_rad);
        let body_from_sector = middle.rotation_matrix() * lidar_from_sector;
        let sector_from_body = body_from_sector.transpose();
        let mut moved_m = DVec3::ZERO;
        let mut turned_rad: f64 = 0.0;
        for pose in &poses {
            let by_m = sector_from_body * (pose.position_m - middle.position_m);
            moved_m = moved_m.max(by_m.abs());
            turned_rad = turned_rad.max(pose.rotation.angle_between(middle.rotation));
        }
        BodySector { sector: self, body, middle, sector_from_body, moved_m, turned_rad, poses }
    }
}

fn column_angles(view: &LidarView, column: usize) -> [f64; 2] {
    let (sin, cos) = view.lidar.azimuth_rad(0, column).sin_cos();
    [cos, sin]
}

impl BodySector<'_> {
    /// A position in the body's axes relative to the LiDAR's middle position, in metres.
    pub(crate) fn relative_to_middle(&self, position_m: DVec3) -> DVec3 {
        position_m - self.middle.position_m
    }
}
