//! A box seen from above.

use glam::DVec2;

/// Two boxes whose gap is at most this are in contact, in metres.
///
/// Sets are closed, so a gap of exactly 0 is a contact. A gap is a sum of a few products of some
/// metres, with an error of 1e-15 m; poses at a UTM northing of 5e6 m have steps of 9e-10 m. The
/// limit lies between the two, so that rounding decides nothing and one step of the pose decides
/// everything.
pub const TOUCH_M: f64 = 1e-10;

/// An oriented rectangle on the ground: a box seen from above.
///
/// ```
/// use glam::DVec2;
/// use wildcity_sim::contact::Footprint;
///
/// let car = Footprint::new(DVec2::ZERO, 0.0, 4.0, 2.0);
/// let other = Footprint::new(DVec2::new(4.5, 0.0), 0.0, 4.0, 2.0);
/// assert_eq!(car.gap_m(&other), 0.5);
/// assert!(!car.touches(&other));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// The centre, in metres.
    pub center_m: DVec2,
    /// Unit vector along the box: where its front is.
    pub forward: DVec2,
    /// Length along `forward`, in metres.
    pub length_m: f64,
    /// Width across it, in metres.
    pub width_m: f64,
}

impl Footprint {
    /// A box of `length_m` x `width_m` with its heading in radians, counter-clockwise from x.
    pub fn new(center_m: DVec2, yaw_rad: f64, length_m: f64, width_m: f64) -> Self {
        Self { center_m, forward: DVec2::from_angle(yaw_rad), length_m, width_m }
    }

    /// The unit vector to the left.
    pub fn left(&self) -> DVec2 {
        self.forward.perp()
    }

    /// Front left, rear left, rear right, front right.
    pub fn corners_m(&self) -> [DVec2; 4] {
        let ahead = 0.5 * self.length_m * self.forward;
        let aside = 0.5 * self.width_m * self.left();
        let center = self.center_m;
        [
            center + ahead + aside,
            center - ahead + aside,
            center - ahead - aside,
            center + ahead - aside,
        ]
    }

    /// The front line as a box without length.
    pub fn front_line(&self) -> Self {
        let center_m = self.center_m + 0.5 * self.length_m * self.forward;
        Self { center_m, length_m: 0.0, ..*self }
    }

    /// The rear line as a box without length.
    pub fn rear_line(&self) -> Self {
        let center_m = self.center_m - 0.5 * self.length_m * self.forward;
        Self { center_m, length_m: 0.0, ..*self }
    }

    /// The box moved by a vector, in metres.
    pub fn shifted(&self, by_m: DVec2) -> Self {
        Self { center_m: self.center_m + by_m, ..*self }
    }

    /// Half the extent of the box along a unit vector, in metres.
    pub fn radius_m(&self, along: DVec2) -> f64 {
        // A rectangle reaches `(l/2) |f·a| + (w/2) |l·a|` from its centre along an axis a.
        let ahead_m = 0.5 * self.length_m * self.forward.dot(along).abs();
        let aside_m = 0.5 * self.width_m * self.left().dot(along).abs();
        ahead_m + aside_m
    }

    /// The four axes on which two boxes can be separate: the normals of the sides of both.
    pub(super) fn axes_with(&self, other: &Self) -> [DVec2; 4] {
        [self.forward, self.left(), other.forward, other.left()]
    }

    /// The largest separation along the normal of a side, in metres: above 0 apart, 0 touching,
    /// below 0 the depth to which they overlap. It is at most the distance.
    ///
    /// Separating axis theorem: two convex shapes are apart if and only if a normal of one of their
    /// sides separates them. The centres are subtracted first: far from the origin nothing else is
    /// exact.
    pub fn gap_m(&self, other: &Self) -> f64 {
        self.widest_axis(other).0
    }

    /// [`Footprint::gap_m`], and the unit vector of its axis, from this box to the other.
    pub fn widest_axis(&self, other: &Self) -> (f64, DVec2) {
        let apart_m = other.center_m - self.center_m;
        let mut widest = (f64::NEG_INFINITY, self.forward);
        for axis in self.axes_with(other) {
            let along_m = apart_m.dot(axis);
            let gap_m = along_m.abs() - self.radius_m(axis) - other.radius_m(axis);
            // Strict, so that of equal axes the first wins.
            if gap_m > widest.0 {
                widest = (gap_m, if along_m < 0.0 { -axis } else { axis });
            }
        }
        widest
    }

    /// Whether the boxes have a point in common, up to [`TOUCH_M`].
    pub fn touches(&self, other: &Self) -> bool {
        self.gap_m(other) <= TOUCH_M
    }

    /// Euclidean distance, in metres; 0 for boxes that touch.
    pub fn distance_m(&self, other: &Self) -> f64 {
        if self.touches(other) {
            return 0.0;
        }
        // Relative to this box. Between two convex shapes that are apart, the nearest pair has a
        // corner.
        let own = Self { center_m: DVec2::ZERO, ..*self };
        let other = other.shifted(-self.center_m);
        let from_own = own.corners_m().into_iter().map(|corner| other.distance_to_m(corner));
        let from_other = other.corners_m().into_iter().map(|corner| own.distance_to_m(corner));
        from_own.chain(from_other).fold(f64::INFINITY, f64::min)
    }

    /// Distance of a point to the box, in metres; 0 within it.
    pub fn distance_to_m(&self, point_m: DVec2) -> f64 {
        let from_center = point_m - self.center_m;
        // In the axes of the box the nearest point is the clamped one, so each excess is an
        // independent leg of a right triangle.
        let ahead_m = (from_center.dot(self.forward).abs() - 0.5 * self.length_m).max(0.0);
        let aside_m = (from_center.dot(self.left()).abs() - 0.5 * self.width_m).max(0.0);
        ahead_m.hypot(aside_m)
    }
}
