//! Outlines of cars, as tables.

/// Sizes of a kind in metres, and its outline from the tail (x = 0) to the nose (x = 1).
///
/// Every knot is (x, belt, top): the position along the car as a fraction of its length, the height
/// of the body's side, and the height of the middle line, both in metres. Heights are interpolated
/// linearly.
#[derive(Clone, Copy, Debug)]
pub(super) struct Kind {
    pub(super) length_m: f64,
    pub(super) width_m: f64,
    /// Radius of a tyre.
    pub(super) tyre_m: f64,
    /// How far each side of the cabin leans in, as a share of its height above the belt.
    pub(super) lean: f64,
    knots: &'static [(f64, f64, f64)],
    /// Side windows from tail to nose, as fractions of the length; pillars are between them.
    pub(super) side_glass: &'static [[f64; 2]],
    /// Rear window and windscreen, as [low end, high end] along the car.
    pub(super) rear_glass: [f64; 2],
    pub(super) windscreen: [f64; 2],
}

impl Kind {
    /// Height of the body's shoulder at a fraction `x` of the length, in metres.
    pub(super) fn belt_m(&self, x: f64) -> f64 {
        self.knotted(x, |knot| knot.1)
    }

    /// Height of bonnet, glass and roof on the middle line, in metres.
    pub(super) fn middle_line_m(&self, x: f64) -> f64 {
        self.knotted(x, |knot| knot.2)
    }

    /// The fractions of the length at which a knot or a window lies, in increasing order.
    pub(super) fn features(&self) -> Vec<f64> {
        self.sorted(self.side_glass.iter().flatten())
    }

    /// Those of them that matter on the middle line, where no side window is.
    pub(super) fn middle_features(&self) -> Vec<f64> {
        self.sorted([].iter())
    }

    /// The knots and the ends of windscreen and rear window, with others.
    fn sorted<'a>(&'a self, others: impl Iterator<Item = &'a f64>) -> Vec<f64> {
        let mut features: Vec<f64> = self.knots.iter().map(|knot| knot.0).collect();
        features.extend(others);
        features.extend(self.rear_glass);
        features.extend(self.windscreen);
        features.sort_by(f64::total_cmp);
        // Features closer than 1.2 % of the length, 5 cm of a car, are one.
        // `dedup_by` passes the later element first.
        features.dedup_by(|b, a| *b - *a < 0.012);
        features
    }

    /// A column of the knots at `x`, interpolated linearly.
    fn knotted(&self, x: f64, column: fn(&(f64, f64, f64)) -> f64) -> f64 {
        let last = self.knots.len() - 1;
        // Between two knots, at an end the outer ones: `after` is 1 or more.
        let after = self.knots.iter().position(|knot| knot.0 >= x).unwrap_or(last).max(1);
        let low = &self.knots[after - 1];
        let high = &self.knots[after];
        // The knots of a kind lie at different places, so that the length between two is not 0.
        let t = ((x - low.0) / (high.0 - low.0)).clamp(0.0, 1.0);
        column(low) + t * (column(high) - column(low))
    }
}

pub(super) const HATCHBACK: Kind = Kind {
    length_m: 4.1,
    width_m: 1.76,
    tyre_m: 0.325,
    lean: 0.38,
    knots: &[
        (0.00, 0.72, 0.74),
        (0.03, 0.94, 0.98),
        (0.14, 0.96, 1.42),
        (0.45, 0.94, 1.50),
        (0.56, 0.93, 1.44),
        (0.75, 0.90, 0.97),
        (0.94, 0.74, 0.80),
        (1.00, 0.58, 0.60),
    ],
    side_glass: &[[0.12, 0.22], [0.25, 0.44], [0.465, 0.67]],
    rear_glass: [0.04, 0.135],
    windscreen: [0.57, 0.735],
};

pub(super) const SEDAN: Kind = Kind {
    length_m: 4.7,
    width_m: 1.82,
    tyre_m: 0.325,
    lean: 0.38,
    knots: &[
        (0.00, 0.70, 0.72),
        (0.02, 0.90, 0.98),
        (0.15, 0.94, 1.03),
        (0.30, 0.94, 1.37),
        (0.48, 0.93, 1.45),
        (0.57, 0.92, 1.40),
        (0.74, 0.89, 0.96),
        (0.95, 0.74, 0.78),
        (1.00, 0.56, 0.58),
    ],
    side_glass: &[[0.21, 0.31], [0.325, 0.465], [0.485, 0.66]],
    rear_glass: [0.165, 0.29],
    windscreen: [0.58, 0.725],
};

pub(super) const WAGON: Kind = Kind {
    length_m: 4.5,
    width_m: 1.86,
    tyre_m: 0.325,
    lean: 0.38,
    knots: &[
        (0.00, 0.80, 0.82),
        (0.02, 1.04, 1.10),
        (0.09, 1.06, 1.56),
        (0.30, 1.05, 1.66),
        (0.54, 1.03, 1.60),
        (0.72, 1.00, 1.10),
        (0.95, 0.86, 0.93),
        (1.00, 0.66, 0.68),
    ],
    side_glass: &[[0.09, 0.24], [0.265, 0.43], [0.45, 0.64]],
    rear_glass: [0.025, 0.085],
    windscreen: [0.55, 0.705],
};

pub(super) const VAN: Kind = Kind {
    length_m: 5.1,
    width_m: 1.94,
    tyre_m: 0.325,
    lean: 0.38,
    knots: &[
        (0.00, 1.02, 1.04),
        (0.01, 1.18, 1.80),
        (0.04, 1.20, 1.96),
        (0.60, 1.18, 1.98),
        (0.68, 1.16, 1.90),
        (0.85, 1.10, 1.20),
        (0.97, 0.92, 0.98),
        (1.00, 0.70, 0.72),
    ],
    side_glass: &[[0.58, 0.78]],
    rear_glass: [0.012, 0.035],
    windscreen: [0.69, 0.84],
};

/// The van that moves: its rear window is in the steep tail.
pub(super) const MOVING_VAN: Kind = Kind {
    knots: &[
        (0.000, 1.02, 1.04),
        (0.012, 1.18, 1.74),
        (0.020, 1.19, 1.88),
        (0.045, 1.20, 1.96),
        (0.600, 1.18, 1.98),
        (0.680, 1.16, 1.90),
        (0.850, 1.10, 1.20),
        (0.970, 0.92, 0.98),
        (1.000, 0.70, 0.72),
    ],
    rear_glass: [0.004, 0.0125],
    ..VAN
};

/// A delivery truck with a box body.
pub(super) const TRUCK: Kind = Kind {
    length_m: 8.4,
    width_m: 2.5,
    tyre_m: 0.48,
    lean: 0.03,
    knots: &[
        (0.000, 1.10, 1.12),
        (0.015, 1.20, 3.36),
        (0.030, 1.22, 3.50),
        (0.690, 1.22, 3.50),
        (0.705, 1.22, 3.36),
        (0.725, 1.22, 2.72),
        (0.930, 1.22, 2.66),
        (0.975, 1.20, 1.34),
        (1.000, 1.00, 1.04),
    ],
    side_glass: &[[0.77, 0.91]],
    // A box body has no rear window: the range is empty.
    rear_glass: [0.0, 0.0],
    windscreen: [0.934, 0.972],
};

/// A city bus with windows along its whole side.
pub(super) const BUS: Kind = Kind {
    length_m: 12.0,
    width_m: 2.55,
    tyre_m: 0.48,
    lean: 0.03,
    knots: &[
        (0.000, 1.10, 1.14),
        (0.013, 1.14, 2.90),
        (0.030, 1.15, 3.05),
        (0.950, 1.15, 3.05),
        (0.970, 1.14, 2.90),
        (0.986, 1.10, 1.24),
        (1.000, 1.00, 1.04),
    ],
    side_glass: &[
        [0.04, 0.17],
        [0.18, 0.33],
        [0.34, 0.49],
        [0.50, 0.65],
        [0.66, 0.81],
        [0.82, 0.94],
    ],
    rear_glass: [0.006, 0.012],
    windscreen: [0.971, 0.985],
};
