//! Polynomials that rise: from the angle off the axis to a distance on the image, or the other way.

/// Coefficients of a polynomial, the constant first.
pub const TERMS: usize = 10;

/// A polynomial that is 0 at 0, on the range from 0 on over which it rises.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MonotonePolynomial {
    coefficients: [f64; TERMS],
    /// Where the range ends; 0 if it does not even begin.
    end: f64,
}

impl MonotonePolynomial {
    /// How much of its slope at 0 a polynomial must keep: a pixel at the end of the range sees fifty
    /// times the angle of one in the middle, and beyond, the image would fold back.
    const LEAST_SLOPE: f64 = 0.02;

    /// Steps in which the end is looked for, before it is halved to the last bit: the slope of a
    /// polynomial of degree 9 has at most eight zeros.
    const STEPS: u32 = 2048;

    /// The polynomial on as much of `0..=most` as it rises over.
    pub(super) fn new(coefficients: [f64; TERMS], most: f64) -> Self {
        let mut rising = Self { coefficients, end: 0.0 };
        let central = rising.slope(0.0);
        let rises = |x: f64| {
            let slope = rising.slope(x);
            slope.is_finite() && slope > 0.0 && slope >= Self::LEAST_SLOPE * central
        };
        let usable = rises(0.0) && coefficients[0] == 0.0 && most.is_finite() && most > 0.0;
        if usable {
            rising.end = last(rises, most, Self::STEPS);
        }
        rising
    }

    /// Its value; beyond the end it goes on straight.
    #[inline(always)]
    pub fn at(&self, x: f64) -> f64 {
        let within = x.min(self.end);
        let value = self.coefficients.iter().rev().fold(0.0, |sum, c| sum * within + c);
        if x > self.end { value + self.slope(self.end) * (x - self.end) } else { value }
    }

    /// Its slope within the range.
    #[inline(always)]
    pub fn slope(&self, x: f64) -> f64 {
        (1..TERMS).rev().fold(0.0, |sum, k| sum * x + k as f64 * self.coefficients[k])
    }

    /// Where it reaches a value of at least 0; beyond the end, where its straight continuation does.
    pub fn invert(&self, y: f64) -> f64 {
        let top = self.at(self.end);
        let beyond = y >= top;
        if beyond {
            return self.end + (y - top) / self.slope(self.end);
        }
        let first = (y / self.slope(0.0)).clamp(0.0, self.end);
        reaches(y, first, self.end, 1e-15, |x| [self.at(x), self.slope(x)])
    }

    /// Of powers 0 to 9.
    pub fn coefficients(&self) -> &[f64; TERMS] {
        &self.coefficients
    }

    /// Where the range ends.
    pub fn end(&self) -> f64 {
        self.end
    }
}

/// Where something that rises from 0 to an end, given with its slope, reaches a value; the end if that is
/// beyond. Newton's steps from a first guess, and halves of what is left where one would leave it, until one is
/// below a share of the end.
pub(super) fn reaches(
    value: f64,
    first: f64,
    end: f64,
    still: f64,
    at: impl Fn(f64) -> [f64; 2],
) -> f64 {
    let (mut low, mut high) = (0.0, end);
    let mut x = first;
    for _ in 0..64 {
        let [here, slope] = at(x);
        let off = here - value;
        if off > 0.0 {
            high = x;
        } else {
            low = x;
        }
        let next = x - off / slope;
        let next = if next > low && next < high { next } else { 0.5 * (low + high) };
        let done = (next - x).abs() <= still * end;
        x = next;
        if done {
            break;
        }
    }
    x
}

/// The largest of `0..=most` up to which something holds, which does at 0.
pub(super) fn last(holds: impl Fn(f64) -> bool, most: f64, steps: u32) -> f64 {
    let at = |step: u32| most * f64::from(step) / f64::from(steps);
    let Some(first_not) = (1..=steps).find(|&step| !holds(at(step))) else { return most };
    let (mut low, mut high) = (at(first_not - 1), at(first_not));
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
    fn it_ends_where_it_stops_rising_and_is_inverted_up_to_there() {
        // θ - θ³/3 turns at 1, and has 2 % of its slope left at √0.98.
        let mut coefficients = [0.0; TERMS];
        (coefficients[1], coefficients[3]) = (1.0, -1.0 / 3.0);
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
