//! Projection around a point to second order: the result of the six points of the unscented
//! transform for a small Gaussian, without projecting the points.
//!
//! Let a displacement of a point at distance d be `d (a, b, c)`: a away from the lens' axis, b
//! around it, c along the ray. With the point's angle θ off the axis and the lens' radius r(θ), the
//! image moves by
//!
//! ```text
//! away from the axis:  α a - α a c + γ a²/2 + κ b²/2      α = r′, β = r/sin θ, γ = r″
//! around the axis:     β b - β b c + μ a b                κ = (α cos θ - β)/sin θ, μ = (α - β cos θ)/sin θ
//! ```
//!
//! up to terms of third order. A lens of slopes X = x/z, Y = y/z has the same form with α = β = 1
//! and the rest 0, for `a = (δx - X δz)/z`, `b = (δy - Y δz)/z` and `c = δz/z`; the distortion's
//! Jacobian leads from there to pixels. A windshield and a shutter change the map from a
//! displacement to (a, b, c), and nothing else to first order. [`crate::unscented::ExpansionBound`]
//! bounds the terms that are left out.

use fearless_simd::{f32x16, prelude::*};

use super::{ExposedPixels, LensPixels, LensProjection, Model, RoundDerivatives};
use crate::cpu::lanes::{Vec3x16, splats};

/// Places and displacements on the image, in pixels.
#[derive(Clone, Copy)]
pub(in crate::cpu) struct Px<S: Simd> {
    pub(in crate::cpu) x: f32x16<S>,
    pub(in crate::cpu) y: f32x16<S>,
}

/// The projection around 16 points.
pub(in crate::cpu) struct Expansion<S: Simd> {
    /// Rows that take a displacement in the camera's frame at the moment of exposure, in metres, to
    /// (a, b, c).
    rows: [Vec3x16<S>; 3],
    alpha: f32x16<S>,
    beta: f32x16<S>,
    gamma: f32x16<S>,
    kappa: f32x16<S>,
    mu: f32x16<S>,
    /// Rows of the matrix from movements away from the axis and around it to pixels.
    plane: [[f32x16<S>; 2]; 2],
    /// Distance to the end of the lens' field, as a length of (a, b, c).
    room: f32x16<S>,
    shutter: Option<ShutterTerms<S>>,
}

/// The rolling shutter around a point: the exposure time depends on the image position, and the
/// image position depends on the exposure time.
struct ShutterTerms<S: Simd> {
    /// (a, b, c) of a point per unit of the remaining exposure.
    motion: Vec3x16<S>,
    /// The image of that motion.
    motion_px: Px<S>,
    /// Change of the remaining exposure per pixel.
    per_px: Px<S>,
    /// `1/(1 - per_px · motion_px)`.
    gain: f32x16<S>,
    /// 1 where the exposure time changes with the image position; 0 beyond the first and the last
    /// row, where it is clamped.
    rolls: f32x16<S>,
    /// Distance of the remaining exposure from 0 or 1, where its change begins or ends.
    to_limit: f32x16<S>,
    /// Rotation of the camera during the exposure, in radians.
    rotation_rad: f32x16<S>,
}

/// The image of a Gaussian's axes.
pub(in crate::cpu) struct ExpandedAxes<S: Simd> {
    /// Columns of a root of the covariance, in pixels: of the axes, then of the terms of second
    /// order.
    pub(in crate::cpu) columns: [Px<S>; 6],
    /// From the image of the centre to the mean of the six points.
    pub(in crate::cpu) mean_shift: Px<S>,
    /// Bounds of the terms that are left out, in units of the bound's factors.
    pub(in crate::cpu) remainder: Remainder<S>,
}

/// The arguments of [`crate::unscented::ExpansionBound`].
pub(in crate::cpu) struct Remainder<S: Simd> {
    /// Sum of the squares of all (a, b, c).
    pub(in crate::cpu) square: f32x16<S>,
    /// The largest length of an axis' (a, b, c).
    pub(in crate::cpu) longest: f32x16<S>,
    /// Term of the rolling shutter, in pixels.
    pub(in crate::cpu) shutter_px: f32x16<S>,
    /// Distance to the end of the lens' field, as a length of (a, b, c).
    pub(in crate::cpu) room: f32x16<S>,
}

impl<S: Simd> Px<S> {
    #[inline(always)]
    fn dot(self, other: Self) -> f32x16<S> {
        self.x.mul_add(other.x, self.y * other.y)
    }

    /// `self * by + plus`.
    #[inline(always)]
    fn mul_add(self, by: f32x16<S>, plus: Self) -> Self {
        Self { x: self.x.mul_add(by, plus.x), y: self.y.mul_add(by, plus.y) }
    }
}

impl LensProjection {
    /// The expansion around points of the camera's frame at the moment of their exposure
    /// ([`Self::at_exposure`]); `None` for a lens that no short series describes. Lanes with a
    /// negative margin are meaningless.
    #[inline(always)]
    pub(in crate::cpu) fn expand<S: Simd>(
        &self,
        simd: S,
        then_m: Vec3x16<S>,
        exposed: &ExposedPixels<S>,
    ) -> Option<Expansion<S>> {
        let ExposedPixels { pixels: LensPixels { x_px, y_px, per_sin, .. }, moment } = *exposed;
        let mut expansion = self.expand_static(simd, then_m, per_sin)?;
        let Some(shutter) = &self.shutter else { return Some(expansion) };
        let splat = |value: f32| f32x16::splat(simd, value);

        // The motion of the point in the camera's frame, and on the image.
        let motion_m = shutter.velocity(simd, then_m, moment.remaining);
        let motion = expansion.components(motion_m);
        let motion_px = expansion.first_order(motion);
        // Beyond the first and last row the moment is clamped and does not change with the place.
        let unclamped = shutter.unclamped_remaining_at(simd, x_px, y_px);
        let is_unclamped = unclamped.simd_gt(splat(0.0)) & unclamped.simd_lt(splat(1.0));
        let rolls = is_unclamped.select(splat(1.0), splat(0.0));
        let [x, y] = splats(simd, shutter.remaining_per_px());
        let per_px = Px { x, y };
        // The moment depends on the place, and the place on the moment: a geometric series with the
        // ratio per_px . motion_px.
        let gain = splat(1.0) / (splat(1.0) - per_px.dot(motion_px));
        let to_limit = unclamped.abs().min((splat(1.0) - unclamped).abs());
        let rotation_rad = splat(shutter.rotation_rad());
        let terms = ShutterTerms { motion, motion_px, per_px, gain, rolls, to_limit, rotation_rad };
        expansion.shutter = Some(terms);
        Some(expansion)
    }

    /// The expansion around points of the camera's frame. `per_sin` is [`LensPixels::per_sin`].
    #[inline(always)]
    fn expand_static<S: Simd>(
        &self,
        simd: S,
        point_m: Vec3x16<S>,
        per_sin: f32x16<S>,
    ) -> Option<Expansion<S>> {
        let Some(windshield) = &self.windshield else {
            return self.expand_lens(simd, point_m, per_sin);
        };
        let splat = |value: f32| f32x16::splat(simd, value);
        let distance_m = point_m.dot(point_m).sqrt();
        let unit = point_m.scale(splat(1.0) / distance_m);
        // The glass maps directions: the distance is kept, and the lens sees the refracted one.
        let refraction = windshield.expand(simd, unit);
        let inside = refraction.inside;
        let mut expansion = self.expand_lens(simd, inside.scale(distance_m), per_sin)?;
        expansion.room = expansion.room.min(refraction.margin);
        // A displacement v becomes inside (unit · v) + by_x (x̂ - x unit) · v + by_y (ŷ - y unit) ·
        // v, where x̂ and ŷ are the camera's axes. So each row has a part along the ray, and one
        // along x̂ and ŷ.
        for row in &mut expansion.rows {
            let along_x = row.dot(refraction.by_x);
            let along_y = row.dot(refraction.by_y);
            let along = row.dot(inside) - unit.x * along_x - unit.y * along_y;
            *row = Vec3x16 {
                x: unit.x.mul_add(along, along_x),
                y: unit.y.mul_add(along, along_y),
                z: unit.z * along,
            };
        }
        Some(expansion)
    }

    /// The expansion around points, or directions behind the windshield, by the lens only.
    #[inline(always)]
    fn expand_lens<S: Simd>(
        &self,
        simd: S,
        point_m: Vec3x16<S>,
        per_sin: f32x16<S>,
    ) -> Option<Expansion<S>> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let zero = splat(0.0);
        let one = splat(1.0);
        let Vec3x16 { x, y, z } = point_m;
        match &self.model {
            Model::Round { px_from_round, derivatives, max_t, beyond, .. } => {
                let RoundDerivatives { slope, curvature } = derivatives.as_ref()?;
                let rho2 = x.mul_add(x, y * y);
                let rho = rho2.sqrt();
                let distance = z.mul_add(z, rho2).sqrt();
                let inverse = one / (distance + z);
                let per_distance = one / distance;
                let t = rho * inverse;
                // On the axis any azimuth may be used.
                // The square of 1e-18 is still a normal number of f32.
                let on_axis = rho.simd_lt(splat(1e-18));
                let per_rho = one / on_axis.select(one, rho);
                let cos_azimuth = on_axis.select(one, x * per_rho);
                let sin_azimuth = y * per_rho;
                let cos = z * per_distance;
                let sin = rho * per_distance;

                let end = splat(*max_t);
                let within = t.simd_le(end);
                let mut alpha = slope.at(simd, t.min(end));
                let beta = per_sin;
                let mut gamma = curvature.at(simd, t.min(end));
                // dt/dθ = (1 + t²)/2
                let mut room = (end - t) * splat(2.0) / t.mul_add(t, one);
                if let Some(tangent) = beyond
                    && !within.all_true()
                {
                    alpha = within.select(alpha, splat(tangent.per_rad()));
                    gamma = within.select(gamma, zero);
                    room = within.select(room, tangent.past_begin_rad(simd, t));
                }
                // Below 1e-3 rad off the axis the numerators are of second order and consist of
                // rounding errors only, so the divisor is clamped.
                let per_sin = one / sin.max(splat(1e-3));
                let kappa = (alpha * cos - beta) * per_sin;
                let mu = (alpha - beta * cos) * per_sin;

                let [[c, d], [e, f]] = *px_from_round;
                let c = splat(c);
                let d = splat(d);
                let e = splat(e);
                let f = splat(f);
                // px_from_round times the rotation by the azimuth.
                let plane = [
                    [
                        c.mul_add(cos_azimuth, d * sin_azimuth),
                        d.mul_add(cos_azimuth, -(c * sin_azimuth)),
                    ],
                    [
                        e.mul_add(cos_azimuth, f * sin_azimuth),
                        f.mul_add(cos_azimuth, -(e * sin_azimuth)),
                    ],
                ];
                // Unit vectors of rising angle off the axis and of rising azimuth, and the ray
                // itself. Over the distance they give the ratios (a, b, c).
                let away = Vec3x16 { x: cos * cos_azimuth, y: cos * sin_azimuth, z: -sin };
                let around = Vec3x16 { x: -sin_azimuth, y: cos_azimuth, z: zero };
                let along = point_m.scale(per_distance).scale(per_distance);
                Some(Expansion {
                    rows: [away.scale(per_distance), around.scale(per_distance), along],
                    alpha,
                    beta,
                    gamma,
                    kappa,
                    mu,
                    plane,
                    room,
                    shutter: None,
                })
            }
            Model::Pinhole { focal_px, max_slope2, .. } => {
                let inverse = one / z;
                let x = x * inverse;
                let y = y * inverse;
                let [fx, fy] = splats(simd, *focal_px);
                let in_front = z.simd_gt(zero);
                // In slopes, as a and b of this lens are.
                let to_limit = splat(max_slope2.sqrt()) - x.mul_add(x, y * y).sqrt();
                // Behind the camera there is no expansion: a negative room fails every bound.
                let room = in_front.select(to_limit, splat(-1.0));
                let plane = [[fx, zero], [zero, fy]];
                Some(Expansion::from_slopes(simd, [x, y], inverse, plane, room))
            }
            Model::Slopes { focal_px, k, p, s, max_slope2 } => {
                let inverse = one / z;
                let x = x * inverse;
                let y = y * inverse;
                let xx = x * x;
                let yy = y * y;
                let xy = x * y;
                let r2 = xx + yy;
                let [k1, k2, k3, k4, k5, k6] = splats(simd, *k);
                let [p1, p2] = splats(simd, *p);
                let [s1, s2, s3, s4] = splats(simd, *s);
                let twice = |v: f32x16<S>| v + v;
                let numerator = k3.mul_add(r2, k2).mul_add(r2, k1).mul_add(r2, one);
                let denominator = k6.mul_add(r2, k5).mul_add(r2, k4).mul_add(r2, one);
                // Derivatives by r^2 of the numerator 1 + k1 r^2 + k2 r^4 + k3 r^6, and of the
                // denominator.
                let numerator_rise = splat(3.0 * k[2]).mul_add(r2, twice(k2)).mul_add(r2, k1);
                let denominator_rise = splat(3.0 * k[5]).mul_add(r2, twice(k5)).mul_add(r2, k4);
                let radial = numerator / denominator;
                // Derivative of the radial factor by r².
                let rise = (numerator_rise - radial * denominator_rise) / denominator;
                // The columns of the distortion's Jacobian.
                let prism_x = s2.mul_add(twice(r2), s1);
                let prism_y = s4.mul_add(twice(r2), s3);
                let across = twice(xy * rise + p1 * x + p2 * y);
                let along_x = radial + twice(xx * rise + p1 * y) + splat(6.0) * p2 * x;
                let along_y = radial + twice(yy * rise + p2 * x) + splat(6.0) * p1 * y;
                let [fx, fy] = splats(simd, *focal_px);
                let plane = [
                    [fx * (along_x + twice(prism_x * x)), fx * (across + twice(prism_x * y))],
                    [fy * (across + twice(prism_y * x)), fy * (along_y + twice(prism_y * y))],
                ];
                let room = splat(max_slope2.sqrt()) - r2.sqrt();
                Some(Expansion::from_slopes(simd, [x, y], inverse, plane, room))
            }
        }
    }
}

impl<S: Simd> Expansion<S> {
    /// The expansion of a lens of slopes x and y, around points at a depth of 1/`inverse`. `plane`
    /// leads from slopes to pixels.
    #[inline(always)]
    fn from_slopes(
        simd: S,
        [x, y]: [f32x16<S>; 2],
        inverse: f32x16<S>,
        plane: [[f32x16<S>; 2]; 2],
        room: f32x16<S>,
    ) -> Self {
        let zero = f32x16::splat(simd, 0.0);
        let one = f32x16::splat(simd, 1.0);
        let rows = [
            Vec3x16 { x: inverse, y: zero, z: -(x * inverse) },
            Vec3x16 { x: zero, y: inverse, z: -(y * inverse) },
            Vec3x16 { x: zero, y: zero, z: inverse },
        ];
        Self {
            rows,
            alpha: one,
            beta: one,
            gamma: zero,
            kappa: zero,
            mu: zero,
            plane,
            room,
            shutter: None,
        }
    }

    /// The image of a Gaussian's axes, times their standard deviations, in metres, in the camera's
    /// frame at the moment of exposure.
    #[inline(always)]
    pub(in crate::cpu) fn axes(&self, simd: S, axes_m: [Vec3x16<S>; 3]) -> ExpandedAxes<S> {
        let zero = f32x16::splat(simd, 0.0);
        let none = Px { x: zero, y: zero };
        let mut columns = [none; 6];
        let mut shift = none;
        let mut square = zero;
        let mut longest2 = zero;
        let mut most_moment = zero;
        // One displacement of each pair suffices: the terms of first order change sign with it, and
        // those of second order do not.
        for (axis, axis_m) in axes_m.into_iter().enumerate() {
            let mut abc = self.components(axis_m);
            if let Some(ShutterTerms { motion, per_px, gain, rolls, .. }) = &self.shutter {
                // A point that is exposed at another moment has moved.
                let moment = per_px.dot(self.first_order(abc)) * *gain;
                abc = motion.mul_add(moment * *rolls, abc);
                most_moment = most_moment.max(moment.abs());
            }
            columns[axis] = self.first_order(abc);
            let mut bend = self.second_order(simd, abc);
            if let Some(ShutterTerms { motion_px, per_px, gain, rolls, .. }) = &self.shutter {
                // The bend is on the image already, and shifts the row and so the moment.
                bend = motion_px.mul_add(per_px.dot(bend) * *gain * *rolls, bend);
            }
            columns[3 + axis] = bend;
            shift = Px { x: shift.x + bend.x, y: shift.y + bend.y };
            let length2 = abc.dot(abc);
            square += length2;
            longest2 = longest2.max(length2);
        }
        // The middle of a pair of points is offset from the centre's image by 3 times its axis'
        // terms. Its distance from the mean, over √3, is a column of the root.
        let root_3 = f32x16::splat(simd, 3.0_f32.sqrt());
        let per_root_3 = f32x16::splat(simd, 3.0_f32.sqrt().recip());
        for bend in &mut columns[3..] {
            bend.x = root_3.mul_add(bend.x, -(shift.x * per_root_3));
            bend.y = root_3.mul_add(bend.y, -(shift.y * per_root_3));
        }
        let longest = longest2.sqrt();
        let mut shutter_px = zero;
        if let Some(terms) = &self.shutter {
            let ShutterTerms { motion_px, to_limit, rotation_rad, .. } = terms;
            // The camera's rotation between two moments, and the ends of the exposure, where the
            // change of the moment stops: a point beyond them is off by the motion since then.
            let px_per_rad = self.alpha.abs().max(self.beta.abs()) * self.plane_scale();
            shutter_px = px_per_rad * longest * *rotation_rad * most_moment;
            let points = f32x16::splat(simd, 3.0_f32.sqrt()) * most_moment;
            // `moment` is that of one standard deviation, and the points lie at root 3 of them.
            let beyond = (points - *to_limit).max(zero);
            shutter_px += beyond * motion_px.dot(*motion_px).sqrt();
        }
        let remainder = Remainder { square, longest, shutter_px, room: self.room };
        ExpandedAxes { columns, mean_shift: shift, remainder }
    }

    /// (a, b, c) of a displacement in metres.
    #[inline(always)]
    fn components(&self, by_m: Vec3x16<S>) -> Vec3x16<S> {
        let [a, b, c] = self.rows;
        Vec3x16 { x: a.dot(by_m), y: b.dot(by_m), z: c.dot(by_m) }
    }

    /// The terms of first order of (a, b, c), in pixels.
    #[inline(always)]
    fn first_order(&self, abc: Vec3x16<S>) -> Px<S> {
        self.to_px(self.alpha * abc.x, self.beta * abc.y)
    }

    /// The terms of second order of (a, b, c), in pixels.
    #[inline(always)]
    fn second_order(&self, simd: S, abc: Vec3x16<S>) -> Px<S> {
        let Vec3x16 { x: a, y: b, z: c } = abc;
        let bend = self.gamma.mul_add(a * a, self.kappa * (b * b));
        let half = bend * f32x16::splat(simd, 0.5);
        let away = half - self.alpha * (a * c);
        let around = self.mu.mul_add(a * b, -(self.beta * (b * c)));
        self.to_px(away, around)
    }

    #[inline(always)]
    fn to_px(&self, away: f32x16<S>, around: f32x16<S>) -> Px<S> {
        let [x, y] = self.plane;
        Px { x: x[0].mul_add(away, x[1] * around), y: y[0].mul_add(away, y[1] * around) }
    }

    /// The largest entry of the matrix to pixels.
    #[inline(always)]
    fn plane_scale(&self) -> f32x16<S> {
        let [[a, b], [c, d]] = self.plane;
        a.abs().max(b.abs()).max(c.abs()).max(d.abs())
    }
}
