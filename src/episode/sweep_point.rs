//! A point of a LiDAR's sweep.

/// A return of a LiDAR, which a replay computes and an export writes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepPoint {
    /// Position in the rig's axes at the time of the sweep, in metres: the motion of the ego during
    /// the sweep is taken out.
    pub xyz_m: [f32; 3],
    /// Mean luminance of what was hit.
    pub intensity: f32,
    /// When it was measured, in microseconds after the sweep's time: 0 or less.
    pub offset_us: i32,
    pub row: u16,
    pub column: u16,
    /// The owner of what was hit, as in the map of an image.
    pub instance: u16,
    /// The class of what was hit; 0 if the session asked for none.
    pub class: u8,
}
