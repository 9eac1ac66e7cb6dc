//! Sweeps of LiDARs as point clouds: 28 bytes a point, the same for Foxglove and for ROS 2.

use super::messages::PackedElementField;
use crate::sweep_point::SweepPoint;

/// A sweep of an episode.
#[derive(Clone, Copy, Debug)]
pub struct ExportedSweep<'a> {
    /// Index of its LiDAR in the rig.
    pub lidar: usize,
    /// The sweep's time, that of its last column, in microseconds.
    pub time_us: i64,
    pub points: &'a [SweepPoint],
}

/// Kinds of numbers in a point.
#[derive(Clone, Copy)]
pub(super) enum Number {
    U16,
    I32,
    F32,
}

/// Bytes of a point; each number is at a multiple of its size.
pub(super) const POINT_BYTES: u32 = 28;

/// The numbers of a point and where they begin. Names are those that viewers look for.
pub(super) const FIELDS: [(&str, u32, Number); 9] = [
    ("x", 0, Number::F32),
    ("y", 4, Number::F32),
    ("z", 8, Number::F32),
    ("intensity", 12, Number::F32),
    ("offset_us", 16, Number::I32),
    ("row", 20, Number::U16),
    ("column", 22, Number::U16),
    ("instance", 24, Number::U16),
    ("class", 26, Number::U16),
];

/// The points, one after the other, little endian.
pub(super) fn packed(points: &[SweepPoint]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(points.len() * POINT_BYTES as usize);
    for point in points {
        let SweepPoint { xyz_m, intensity, offset_us, row, column, instance, class } = *point;
        for value in xyz_m.into_iter().chain([intensity]) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(offset_us.to_le_bytes());
        for value in [row, column, instance, u16::from(class)] {
            bytes.extend(value.to_le_bytes());
        }
    }
    bytes
}

/// The fields of a Foxglove message.
pub(super) fn foxglove_fields() -> Vec<PackedElementField> {
    let field = |(name, offset, number): (&str, u32, Number)| PackedElementField {
        name: name.to_owned(),
        offset,
        // `foxglove.PackedElementField.NumericType`.
        kind: match number {
            Number::U16 => 3,
            Number::I32 => 6,
            Number::F32 => 7,
        },
    };
    FIELDS.map(field).to_vec()
}
