//! Monotone polynomials: from the angle off the axis to the distance on the image, or the inverse.

/// Number of coefficients of a polynomial: powers 0 to 9.
pub const TERMS: usize = 10;

/// A polynomial with value 0 at 0, restricted to the range `0..=end` on which it rises.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MonotonePolynomial {
    coefficients: [f64; TERMS],
    /// End of the range; 0 if the polynomial does not rise at 0.
    end: f64,
}

impl MonotonePolynomial {
    /// The range ends where the slope falls below this share of the slope at 0. A pixel there
    /// covers fifty times the angle of one in the centre; farther out the image would fold back.
    const LEAST_SLOPE: f64 = 0.02;

    /// Number of steps in which the end of the range is searched before it is bisected to the last
    /// bit. It is large because the slope of a polynomial of degree 9 may have eight zeros.
    const STEPS: u32 = 2048;

    /// The polynomial on the largest range `0..=end` within `0..=most` on which it rises.
    pub(super) fn new(coefficients: [f64; TERMS], most: f64) -> Self {
        let mut rising = Self { coefficients, end: 0.0 };
        let central = rising.slope(0.0);
        // All three parts are false for NaN. The slope is also compared with 0, because a falling
        // polynomial has a negative bound.
        let rises = |x: f64| {
            let slope = rising.slope(x);
            slope.is_finite() && slope > 0.0 && slope >= Self::LEAST_SLOPE * central
        };
        let usable = rises(0.0) && coefficients[0] == 0.0 && most.is_finite() && most > 0.0;
        if usable {
            rising.end = largest_valid(rises, most, Self::STEPS);
        }
        rising
    }

    /// The value at `x` (Horner's scheme); beyond the end the tangent at the end.
    #[inline(always)]
    pub fn at(&self, x: f64) -> f64 {
        // Beyond the end, the value at the end and its tangent: continuous with its slope.
        let within = x.min(self.end);
        let value = self.coefficients.iter().rev().fold(0.0, |sum, c| sum * within + c);
        if x > self.end { value + self.slope(self.end) * (x - self.end) } else { value }
    }

    /// The derivative at `x`, for `x` within the range.
    #[inline(always)]
    pub fn slope(&self, x: f64) -> f64 {
        // Horner's scheme of Σ k c_k x^(k-1).
        (1..TERMS).rev().fold(0.0, |sum, k| sum * x + k as f64 * self.coefficients[k])
    }

    /// The inverse: the `x` with value `y`, for `y` of at least 0; beyond the end that of the
    /// tangent.
    pub fn invert(&self, y: f64) -> f64 {
        let top = self.at(self.end);
        let beyond = y >= top;
        if beyond {
            return self.end + (y - top) / self.slope(self.end);
        }
        // A linear start. The safeguard of `invert_monotone` corrects it where it is far off.
        let first = (y / self.slope(0.0)).clamp(0.0, self.end);
        invert_monotone(y, first, self.end, 1e-15, |x| [self.at(x), self.slope(x)])
    }

    /// Coefficients of powers 0 to 9.
    pub fn coefficients(&self) -> &[f64; TERMS] {
        &self.coefficients
    }

    /// End of the range; 0 if the polynomial does not rise at 0.
    pub fn end(&self) -> f64 {
        self.end
    }
}

/// The `x` in `0..=end` at which a rising function has a value; `end` if it does not reach it. `at`
/// gives the function's value and slope.
///
/// Newton's method from `first`, safeguarded by bisection: a step that would leave the bracket is
/// replaced by the bracket's midpoint. It ends when a step is below `tolerance * end`.
pub(super) fn invert_monotone(
    value: f64,
    first: f64,
    end: f64,
    tolerance: f64,
    at: impl Fn(f64) -> [f64; 2],
) -> f64 {
    // The root is in low..=high in every round.
    let mut low = 0.0;
    let mut high = end;
    let mut x = first;
    for _ in 0..64 {
        let [here, slope] = at(x);
        let off = here - value;
        if off > 0.0 {
            high = x;
        } else {
            low = x;
        }
        // A slope of 0 or NaN makes `newton` infinite or NaN, which fails the comparison: the
        // midpoint takes over.
        let newton = x - off / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        let done = (next - x).abs() <= tolerance * end;
        x = next;
        if done {
            break;
        }
    }
    x
}

/// The largest `x` in `0..=most` such that a condition, which holds at 0, holds on `0..=x`: the
/// first of `steps` steps that violates it, refined by bisection.
pub(super) fn largest_valid(holds: impl Fn(f64) -> bool, most: f64, steps: u32) -> f64 {
    let at = |step: u32| most * f64::from(step) / f64::from(steps);
    // Coarse steps first: bisection alone would find any violation and not the first one.
    let Some(first_not) = (1..=steps).find(|&step| !holds(at(step))) else { return most };
    let mut low = at(first_not - 1);
    let mut high = at(first_not);
    // 60 halvings of a step exhaust the 53 bits of an f64.
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if holds(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_range_ends_where_the_polynomial_stops_rising_and_is_inverted_up_to_there() {
        // θ - θ³/3 has its maximum at 1, and 2 % of its initial slope at √0.98.
        let mut coefficients = [0.0; TERMS];
        coefficients[1] = 1.0;
        coefficients[3] = -1.0 / 3.0;
        let rising = MonotonePolynomial::new(coefficients, 3.0);
        assert!((rising.end() - 0.98_f64.sqrt()).abs() < 1e-12, "{}", rising.end());
        for i in 0..=1000 {
            let x = rising.end() * f64::from(i) / 1000.0;
            assert!((rising.invert(rising.at(x)) - x).abs() < 1e-11, "{x}");
        }
        let beyond = rising.end() + 0.5;
        assert!((rising.invert(rising.at(beyond)) - beyond).abs() < 1e-9);
        for unusable in [f64::NAN, -1.0, 0.0, f64::INFINITY] {
            coefficients[1] = unusable;
            assert_eq!(MonotonePolynomial::new(coefficients, 3.0).end(), 0.0, "{unusable}");
        }
    }
}
