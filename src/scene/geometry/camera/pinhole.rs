//! The pinhole model: `u = fx x/z + cx`, `v = fy y/z + cy` (OpenCV, `projectPoints`).

use glam::{DVec2, DVec3};

use super::CameraError;
use super::fisheye::azimuth;

/// Pinhole intrinsics, in pixels from the image's top-left corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Where the optical axis meets the image, from its left edge.
    pub cx: f64,
    /// Where the optical axis meets the image, from its upper edge.
    pub cy: f64,
}

impl Pinhole {
    /// Larger focal lengths and principal points are refused as mistakes. They would also lose
    /// precision in f32.
    const MAX_PX: f64 = 1e6;

    /// Checks the intrinsics.
    ///
    /// # Errors
    /// Names the first intrinsic that is not finite or out of range.
    pub fn check(&self) -> Result<(), CameraError> {
        for (field, value) in [("fx", self.fx), ("fy", self.fy)] {
            let usable = value.is_finite() && (1e-3..=Self::MAX_PX).contains(&value);
            if !usable {
                let must = "a focal length is from 0.001 to 1e6 px";
                return Err(CameraError::Intrinsic { field, value, must });
            }
        }
        for (field, value) in [("cx", self.cx), ("cy", self.cy)] {
            let usable = value.is_finite() && value.abs() <= Self::MAX_PX;
            if !usable {
                let must = "a principal point is within 1e6 px of the image's corner";
                return Err(CameraError::Intrinsic { field, value, must });
            }
        }
        Ok(())
    }

    /// The slopes x/z and y/z of a direction. Where the slope exceeds `straight`, it is continued
    /// linearly in the angle off the axis, also behind the camera, so that every direction has a
    /// finite slope. The rate is that of the tangent: `d tan θ / dθ = 1 + tan² θ`.
    #[inline(always)]
    pub(super) fn extrapolated_slope(direction: DVec3, straight: f64) -> DVec2 {
        let off_axis = direction.truncate().length();
        // False behind the camera, where z is negative.
        let within = off_axis < straight * direction.z;
        if within {
            return direction.truncate() / direction.z;
        }
        let beyond_rad = off_axis.atan2(direction.z) - straight.atan();
        let per_rad = 1.0 + straight * straight;
        azimuth(direction) * (straight + per_rad * beyond_rad)
    }

    /// Projects a camera-space point to pixels; meaningless unless `z > 0`.
    pub fn project(&self, point_m: DVec3) -> DVec2 {
        DVec2::new(
            self.fx * point_m.x / point_m.z + self.cx,
            self.fy * point_m.y / point_m.z + self.cy,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_the_intrinsic_out_of_range() {
        let good = Pinhole { fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 };
        assert_eq!(good.check(), Ok(()));
        for (bad, field) in [
            (Pinhole { fx: 0.0, ..good }, "fx"),
            (Pinhole { fy: f64::NAN, ..good }, "fy"),
            (Pinhole { cx: f64::INFINITY, ..good }, "cx"),
            (Pinhole { cy: -1e7, ..good }, "cy"),
        ] {
            assert_eq!(bad.check().unwrap_err().field(), field);
        }
    }
}
