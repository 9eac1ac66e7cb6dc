//! Limits of a data set, with the arithmetic behind each.

/// How far a round moves the views away from the drive, in metres: the value of Difix3D+'s trainer.
pub const ROUND_M: f64 = 0.5;

/// Largest round: 20 m at [`ROUND_M`] per round, which is farther than the valid range of any twin.
pub const MOST_ROUNDS: u32 = 40;

/// Largest offset, in metres.
pub const MOST_OFFSET_M: f64 = 20.0;

/// Smallest and largest distance of two stations, in metres.
pub const EVERY_M: [f64; 2] = [0.1, 1e3];

/// Samples of one round. 20 km every 2 m with three offsets on two sides and six cameras have
/// 360,000.
pub const MOST_SAMPLES: usize = 1_000_000;

/// Weight of a sample of trust 1 in the loss, against that of a recorded image: Difix3D+'s trainer
/// takes 0.3.
pub const WEIGHT: f64 = 0.3;

/// Opacity from which on a pixel counts.
pub const LEAST_OPACITY: f32 = 0.5;

/// Depths beyond this are not written, in metres: 16 bits of millimetres end at 65.535 m.
pub const MOST_DEPTH_M: f32 = 65.0;

/// Tangent of the largest angle between the axis of a pinhole that stands for a lens and a side of
/// its image: 50°. A pinhole of 120° has four times as many pixels per radian at its edge as in its
/// middle.
pub const MOST_SLOPE: f64 = 1.191_753_592_594_21;

/// Default number of COLMAP's points: the number with which a trainer starts on a street.
pub const POINTS: u32 = 100_000;

/// Largest number of points: 51 MB of text.
pub const MOST_POINTS: u32 = 1_000_000;

/// Gaussians within this distance of a view may become points, in metres.
pub const POINT_REACH_M: f64 = 100.0;

/// Bytes of augment.json and of the file of samples in progress that are read: a sample has about 1
/// kB.
pub const RECORD_BYTES: u64 = 4 << 30;
