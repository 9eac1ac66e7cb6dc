//! The painter: surfaces become flat Gaussians.

use glam::{DMat3, DQuat, DVec3};

use wildcity_scene::{Gaussians, SemanticClass, sh};

use super::light::Light;

/// Standard deviation of a surfel as a fraction of its cell's edge: with a smaller one the pattern
/// of cells is visible, with a larger one the image is blurred. At 0.66, the common corner of four
/// neighbours of opacity 0.97 is 0.5 / 0.66 = 0.76 sigma from each along both axes. They cover it
/// to `1 - (1 - 0.97 exp(-0.76²))⁴` = 96 %, and with the next ring of eight to 97.5 %.
const OVERLAP: f64 = 0.66;

/// Standard deviation of a stroke as a fraction of its length, if it is a line by itself: hardly
/// longer than the line.
const SINGLE: f64 = 0.36;
/// The same of strokes that follow each other: they overlap as surfels do.
const JOINED: f64 = 0.45;
/// Standard deviation of a stroke as a fraction of its width: opacity falls to a half at its
/// border.
const ACROSS: f64 = 0.43;

/// Half thickness of a surfel, in metres.
const THICKNESS_M: f64 = 0.004;

/// Factor by which cells grow from an edge inwards: they are fine where colours meet and coarse in
/// between.
const GROWTH: f64 = 1.9;

/// The appearance of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Paint {
    /// Display colour of the material in white light, 0 to 1.
    pub(super) rgb: DVec3,
    /// Share of the sky that it reflects: 0 matt, 0.08 asphalt, 0.3 glass.
    pub(super) gloss: f64,
    /// Share of the light that its surroundings do not block: 1 in the open, 0.5 in a deep corner.
    pub(super) open: f64,
    /// Whether it is a light source; then its colour does not depend on the light.
    pub(super) glows: bool,
}

impl Paint {
    /// A matt surface in the open.
    pub(super) const fn matt(r: f64, g: f64, b: f64) -> Self {
        Self { rgb: DVec3::new(r, g, b), gloss: 0.0, open: 1.0, glows: false }
    }

    /// This paint with a reflection of the sky.
    pub(super) const fn gloss(self, gloss: f64) -> Self {
        Self { gloss, ..self }
    }

    /// This paint, brighter or darker.
    pub(super) fn times(self, factor: f64) -> Self {
        Self { rgb: self.rgb * factor, ..self }
    }

    /// This paint where the surroundings block some of the light.
    pub(super) fn open(self, open: f64) -> Self {
        Self { open: self.open * open, ..self }
    }

    /// A light source: its colour is the same in sun and shade.
    pub(super) const fn glowing(r: f64, g: f64, b: f64) -> Self {
        Self { glows: true, ..Self::matt(r, g, b) }
    }
}

/// A flat patch: a parallelogram with its outward normal `edge_u x edge_v`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patch {
    pub(super) center_m: DVec3,
    /// The whole edge along u, in metres.
    pub(super) edge_u_m: DVec3,
    /// The whole edge along v, in metres.
    pub(super) edge_v_m: DVec3,
}

/// Collects the street's Gaussians.
#[derive(Debug)]
pub(super) struct Painter<'a> {
    /// The Gaussians that have been painted; SH degree 1.
    pub(super) gaussians: Gaussians,
    light: &'a Light,
    /// The class of what is painted next; `None` on a canvas without classes.
    class: Option<SemanticClass>,
    /// Spacing of everything, as a factor: above 1 is coarser.
    spacing: f64,
    /// Factor on the numbers of cells that do not follow the spacing, such as those around a wheel.
    detail: usize,
}

impl<'a> Painter<'a> {
    /// An empty canvas. `density` is [`super::StreetSettings::density`].
    pub(super) fn new(light: &'a Light, density: f64) -> Self {
        Self {
            gaussians: Gaussians { sh_degree: 1, ..Gaussians::default() },
            light,
            class: None,
            spacing: 1.0 / density.sqrt(),
            detail: 1,
        }
    }

    /// This canvas with classes, for a street. Objects that move have the classes of actors.
    pub(super) fn with_classes(mut self) -> Self {
        self.gaussians.classes = Some(Vec::new());
        self.class = Some(SemanticClass::Unlabelled);
        self
    }

    /// A canvas for an object that is seen from near by, with `detail` times as many cells along
    /// every edge.
    pub(super) fn detailed(light: &'a Light, detail: usize) -> Self {
        Self { spacing: 1.0 / detail as f64, detail, ..Self::new(light, 1.0) }
    }

    /// Break points with as many cells between two of them as the detail asks for.
    pub(super) fn refined(&self, points: &[f64]) -> Vec<f64> {
        let between = |pair: &[f64]| {
            let from = pair[0];
            let to = pair[1];
            // The first point of each pair and those between; the last of all is added below.
            (0..self.detail).map(move |k| from + (to - from) * k as f64 / self.detail as f64)
        };
        let last = points.last().copied();
        points.windows(2).flat_map(between).chain(last).collect()
    }

    /// A spacing that stays below `most_m` on distant objects, too.
    pub(super) fn at_most(&self, step_m: f64, most_m: f64) -> f64 {
        step_m.min(most_m / self.spacing)
    }

    /// A length in proportion to the cells of an object that is seen from near by.
    pub(super) fn fine(&self, length_m: f64) -> f64 {
        length_m / self.detail as f64
    }

    /// Paints what `draw` paints with all spacings `factor` times as wide: for distant objects.
    pub(super) fn coarser(&mut self, factor: f64, draw: impl FnOnce(&mut Self)) {
        let spacing = self.spacing;
        self.spacing *= factor;
        draw(self);
        self.spacing = spacing;
    }

    /// Paints what `draw` paints as Gaussians of a class, if the canvas has classes.
    pub(super) fn labelled(&mut self, class: SemanticClass, draw: impl FnOnce(&mut Self)) {
        let around = self.class;
        // `None` stays `None`: a canvas without classes gets none here.
        self.class = around.map(|_| class);
        draw(self);
        self.class = around;
    }

    /// `from` to `to` in steps of about `step_m`, as break points.
    pub(super) fn even(&self, from_m: f64, to_m: f64, step_m: f64) -> Vec<f64> {
        // One cell at least, and steps that divide the length.
        let count = ((to_m - from_m) / (step_m * self.spacing)).round().max(1.0);
        (0..=count as usize).map(|i| from_m + (to_m - from_m) * i as f64 / count).collect()
    }

    /// `from` to `to`, in steps of `edge_m` at both ends that grow to `most_m` between.
    pub(super) fn graded(&self, from_m: f64, to_m: f64, edge_m: f64, most_m: f64) -> Vec<f64> {
        let edge_m = edge_m * self.spacing;
        let most_m = most_m * self.spacing;
        let half_m = 0.5 * (to_m - from_m);
        // Too short for two graded ends.
        if half_m < 0.8 * edge_m {
            return vec![from_m, to_m];
        }
        let mut reached_m = 0.0;
        let mut step_m = edge_m;
        let mut ends_m = vec![0.0];
        // From one end to the middle; less than 0.3 of a step is left to the stretch below.
        while reached_m < half_m - 0.3 * step_m {
            reached_m += step_m;
            ends_m.push(reached_m);
            step_m = (GROWTH * step_m).min(most_m);
        }
        // Both halves are stretched to meet in the middle, which is one of the break points.
        let fit = half_m / reached_m;
        let first = ends_m.iter().map(|end_m| from_m + fit * end_m);
        let second = ends_m.iter().rev().skip(1).map(|end_m| to_m - fit * end_m);
        first.chain(second).collect()
    }

    /// Covers a curved sheet: one surfel per cell between the break points `us` and `vs`.
    ///
    /// `place` maps (u, v) to the world, with the outward normal along `∂u x ∂v`; `paint` returns
    /// the paint at the middle of a cell, or `None` for a hole.
    pub(super) fn sheet(
        &mut self,
        us: &[f64],
        vs: &[f64],
        place: impl Fn(f64, f64) -> DVec3,
        mut paint: impl FnMut(f64, f64) -> Option<Paint>,
    ) {
        for v in vs.windows(2) {
            let middle_v = 0.5 * (v[0] + v[1]);
            for u in us.windows(2) {
                let middle_u = 0.5 * (u[0] + u[1]);
                // The colour is that of the cell's middle: edges of colours lie on break points.
                if let Some(paint) = paint(middle_u, middle_v) {
                    let patch = Patch {
                        center_m: place(middle_u, middle_v),
                        edge_u_m: place(u[1], middle_v) - place(u[0], middle_v),
                        edge_v_m: place(middle_u, v[1]) - place(middle_u, v[0]),
                    };
                    self.patch(&patch, paint);
                }
            }
        }
    }

    /// One lit surfel. A patch without area paints nothing.
    ///
    /// A parallelogram with edges u, v has the covariance `(u uᵀ + v vᵀ) / 12`; the surfel has its
    /// principal axes and ratio.
    pub(super) fn patch(&mut self, patch: &Patch, paint: Paint) {
        let Patch { center_m, edge_u_m, edge_v_m } = *patch;
        let normal = edge_u_m.cross(edge_v_m).normalize_or_zero();
        let along = edge_u_m.normalize_or_zero();
        let across = normal.cross(along);
        // In the basis (along, across): u = (a, 0), v = (shear, b).
        let a = edge_u_m.length();
        let b = edge_v_m.dot(across);
        let shear = edge_v_m.dot(along);
        let has_area = a > 2e-3 && b > 2e-3;
        if !has_area {
            return;
        }
        let xx = a * a + shear * shear;
        let xy = shear * b;
        let yy = b * b;
        // Eigenvalues of [xx xy; xy yy]: half the trace plus and minus this.
        let apart = (0.5 * (xx - yy)).hypot(xy);
        let major = 0.5 * (xx + yy) + apart;
        // The difference may round to 0 or below, which has no root and no logarithm.
        let minor = (0.5 * (xx + yy) - apart).max(1e-6);
        // The angle of the major axis: tan 2a = 2 xy/(xx - yy).
        let (sin, cos) = (0.5 * (2.0 * xy).atan2(xx - yy)).sin_cos();
        let axes = DMat3::from_cols(cos * along + sin * across, cos * across - sin * along, normal);
        let rotation = DQuat::from_mat3(&axes);
        let sigmas_m = DVec3::new(OVERLAP * major.sqrt(), OVERLAP * minor.sqrt(), THICKNESS_M);
        // Seen at 60° from the normal, d·n = -0.5, the mirror adds nothing.
        let rgb = self.lit(center_m, normal, &paint) + 0.3 * paint.gloss * MIRRORED_SKY;
        self.gaussian(center_m, rotation, sigmas_m, 0.97, rgb, mirror(normal, paint.gloss));
    }

    /// A straight line from end to end, `width_m` wide, on a surface with this normal: one thin
    /// Gaussian, as sharp as it is narrow. It must lie farther off the surface than half of its
    /// length reaches along the view, or the surfels beside it hide it.
    pub(super) fn stroke(&mut self, ends_m: [DVec3; 2], normal: DVec3, width_m: f64, paint: Paint) {
        self.thin(ends_m, normal, [SINGLE, width_m], paint);
    }

    /// A line through places, of strokes that are at most `most_m` long. The first and the last of
    /// a straight line are half as long, so that it ends more sharply.
    pub(super) fn polyline(
        &mut self,
        places_m: &[DVec3],
        normal: DVec3,
        [width_m, most_m]: [f64; 2],
        paint: Paint,
    ) {
        // Those of a distant object may be longer.
        let most_m = most_m * self.spacing.clamp(1.0, 1.5);
        for pair in places_m.windows(2) {
            let parts = (pair[0].distance(pair[1]) / most_m).ceil().max(1.0);
            let mut breaks = vec![0.0];
            if places_m.len() == 2 && parts > 1.0 {
                breaks.extend((1..=parts as i32).map(|part| (f64::from(part) - 0.5) / parts));
            } else {
                breaks.extend((1..parts as i32).map(|part| f64::from(part) / parts));
            }
            breaks.push(1.0);
            let share = if places_m.len() == 2 && parts == 1.0 { SINGLE } else { JOINED };
            for ends in breaks.windows(2) {
                let ends_m = [ends[0], ends[1]].map(|t| pair[0].lerp(pair[1], t));
                self.thin(ends_m, normal, [share, width_m], paint);
            }
        }
    }

    /// A stroke whose standard deviation along it is this share of its length.
    fn thin(
        &mut self,
        ends_m: [DVec3; 2],
        normal: DVec3,
        [share, width_m]: [f64; 2],
        paint: Paint,
    ) {
        let along_m = ends_m[1] - ends_m[0];
        let along = along_m.normalize_or_zero();
        let center_m = 0.5 * (ends_m[0] + ends_m[1]);
        let across = normal.cross(along).normalize_or_zero();
        // Ends in one place, or a line along the normal, have no direction across.
        if across == DVec3::ZERO || width_m < 1e-3 {
            return;
        }
        let axes = DMat3::from_cols(along, across, along.cross(across));
        let sigmas_m = DVec3::new(share * along_m.length(), ACROSS * width_m, 0.002);
        let rgb = self.lit(center_m, normal, &paint) + 0.3 * paint.gloss * MIRRORED_SKY;
        let slope = mirror(normal, paint.gloss);
        self.gaussian(center_m, DQuat::from_mat3(&axes), sigmas_m, 0.97, rgb, slope);
    }

    /// Display colour of a surface in this light.
    fn lit(&self, point_m: DVec3, normal: DVec3, paint: &Paint) -> DVec3 {
        if paint.glows {
            return paint.rgb;
        }
        // Display values are taken as square roots of light (a gamma of 2), so that shading is
        // linear and `sqrt` is exact everywhere.
        let light = self.light.on(point_m, normal) * paint.open * paint.rgb * paint.rgb;
        // Light above 1.1 is cut: its display value, 1.05, is white already.
        light.min(DVec3::splat(1.1)).max(DVec3::ZERO).map(f64::sqrt)
    }

    /// One Gaussian, as it is: display colour `rgb`, plus `slope · direction` of sky, where the
    /// direction points from the camera to the Gaussian.
    pub(super) fn gaussian(
        &mut self,
        mean_m: DVec3,
        rotation: DQuat,
        sigmas_m: DVec3,
        opacity: f64,
        rgb: DVec3,
        slope: DVec3,
    ) {
        // The inverse of 0.5 + C0 c.
        let dc = (rgb - 0.5) / sh::C0;
        let out = &mut self.gaussians;
        if let (Some(classes), Some(class)) = (&mut out.classes, self.class) {
            classes.push(class);
        }
        out.means_m.push(mean_m.to_array());
        let DQuat { x, y, z, w } = rotation;
        out.quats_wxyz.push([w, x, y, z].map(|c| c as f32));
        out.ln_scales.push(sigmas_m.to_array().map(|sigma_m| sigma_m.ln() as f32));
        out.logit_opacities.push((opacity / (1.0 - opacity)).ln() as f32);
        // The basis of degree 1 is C1 (-y, z, -x).
        for coefficient in [
            dc,
            MIRRORED_SKY * (-slope.y / sh::C1),
            MIRRORED_SKY * (slope.z / sh::C1),
            MIRRORED_SKY * (-slope.x / sh::C1),
        ] {
            out.sh.extend(coefficient.to_array().map(|c| c as f32));
        }
    }

    /// The display colour of a point without a surface of its own, such as a leaf.
    pub(super) fn shade(&self, point_m: DVec3, normal: DVec3, paint: &Paint) -> DVec3 {
        self.lit(point_m, normal, paint)
    }
}

/// Colour of the mirrored sky.
const MIRRORED_SKY: DVec3 = DVec3::new(0.80, 0.90, 1.0);

/// Change of the mirrored sky with the viewing direction `d`, as a vector that is multiplied by `d`
/// (dot product).
///
/// A surface with normal n reflects more at grazing angles, where d·n rises from -1 to 0. The more
/// the viewing direction rises along the surface, the higher and brighter is the reflected part of
/// the sky.
fn mirror(normal: DVec3, gloss: f64) -> DVec3 {
    gloss * (0.6 * normal + 0.5 * (DVec3::Z - normal.z * normal))
}
