//! Trees and hedges.

use glam::{DQuat, DVec3};

use super::light::Occluder;
use super::random::{Random, noise};
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// A street tree, not yet painted.
#[derive(Clone, Debug)]
pub(super) struct Tree {
    foot_m: DVec3,
    trunk_m: f64,
    crown_m: f64,
    near: bool,
    random: Random,
}

impl Tree {
    /// A tree whose trunk stands at `foot_m`.
    ///
    /// `near` says whether the drive passes the tree; then it has all its leaves.
    pub(super) fn new(foot_m: DVec3, near: bool, mut random: Random) -> Self {
        let trunk_m = random.range(3.1, 3.7);
        let crown_m = random.range(1.9, 2.5);
        Self { foot_m, trunk_m, crown_m, near, random }
    }

    /// The body that casts the tree's shadow.
    pub(super) fn occluder(&self) -> Occluder {
        Occluder::Crown { center_m: self.middle_m(), radius_m: 1.05 * self.crown_m }
    }

    fn middle_m(&self) -> DVec3 {
        self.foot_m + (self.trunk_m + 0.80 * self.crown_m) * DVec3::Z
    }

    /// Paints trunk, branches and leaves.
    pub(super) fn paint(&self, painter: &mut Painter) {
        // A copy, so that a tree that is painted again is the same.
        let mut random = self.random.clone();
        let bark = Paint::matt(0.40, 0.34, 0.28).times(random.range(0.85, 1.2));
        let top_m = self.foot_m + self.trunk_m * DVec3::Z;
        stem(painter, [self.foot_m, top_m], [0.17, 0.11], bark);
        let turn_rad = random.range(0.0, std::f64::consts::TAU);
        for branch in 0..4 {
            // Four branches, a quarter turn apart.
            let (sin, cos) = (turn_rad + 1.57 * f64::from(branch)).sin_cos();
            let tip_m = 0.55 * self.crown_m * DVec3::new(cos, sin, 1.6);
            stem(painter, [top_m - 0.3 * DVec3::Z, top_m + tip_m], [0.08, 0.03], bark);
        }
        painter.labelled(SemanticClass::Terrain, |painter| self.pit(painter));

        let green = random.pick(&[
            Paint::matt(0.44, 0.56, 0.24),
            Paint::matt(0.38, 0.52, 0.25),
            Paint::matt(0.50, 0.57, 0.25),
            Paint::matt(0.34, 0.48, 0.27),
        ]);
        // Far trees have fewer and larger leaves: 26 x 0.115^2 covers as much as 74 x
        // 0.060^2 and a quarter more.
        let (leaves, size_m) = if self.near { (74, 0.060) } else { (26, 0.115) };
        for _ in 0..14 {
            let away = ball(&mut random) * DVec3::new(0.64, 0.64, 0.72);
            let middle_m = self.middle_m() + self.crown_m * away;
            let radii_m = DVec3::splat(self.crown_m * random.range(0.34, 0.50));
            let tone = random.range(0.88, 1.12);
            let foliage = Foliage { leaves, size_m, green: green.times(tone) };
            foliage.clump(painter, &mut random, middle_m, radii_m);
        }
    }

    /// The square of earth that the trunk stands in.
    fn pit(&self, painter: &mut Painter) {
        let foot_m = self.foot_m;
        let steps_m = painter.even(-0.55, 0.55, 0.16);
        let place = |x: f64, y: f64| foot_m + DVec3::new(x, y, 0.012);
        painter.sheet(&steps_m, &steps_m, place, |x, y| {
            let tone = noise(3, 6.0 * (foot_m.x + x), 6.0 * (foot_m.y + y));
            Some(Paint::matt(0.34, 0.28, 0.21).times(1.0 + 0.15 * tone))
        });
    }
}

/// A clipped hedge in a box: `size_m` is half length, half depth and height.
pub(super) fn hedge(
    painter: &mut Painter,
    base_m: DVec3,
    along: DVec3,
    size_m: DVec3,
    random: &mut Random,
) {
    let green = Paint::matt(0.34, 0.46, 0.22);
    let count = (size_m.x / 0.22).ceil() as usize;
    for i in 0..count {
        // The middles of equal parts from -size to +size.
        let x_m = (2.0 * (i as f64 + 0.5) / count as f64 - 1.0) * size_m.x;
        let middle_m = base_m + x_m * along + 0.55 * size_m.z * DVec3::Z;
        let radii_m = DVec3::new(0.30, size_m.y, 0.5 * size_m.z);
        let green = green.times(random.range(0.9, 1.1));
        Foliage { leaves: 60, size_m: 0.05, green }.clump(painter, random, middle_m, radii_m);
    }
}

/// The appearance of leaves: their number in a clump, their length in metres, and their colour.
struct Foliage {
    leaves: usize,
    size_m: f64,
    green: Paint,
}

impl Foliage {
    /// Leaves on an ellipsoid of these radii around an opaque, dark core.
    fn clump(&self, painter: &mut Painter, random: &mut Random, middle_m: DVec3, radii_m: DVec3) {
        let green = self.green;
        let core = painter.shade(middle_m, DVec3::Z, &green.times(0.45).open(0.8));
        painter.gaussian(middle_m, DQuat::IDENTITY, 0.36 * radii_m, 0.9, core, DVec3::ZERO);
        for _ in 0..self.leaves {
            // Uniform on the sphere, from a point in the ball.
            let away = ball(random).normalize_or_zero();
            let depth = random.range(0.70, 1.08);
            let mean_m = middle_m + depth * away * radii_m;
            // Leaves face in random directions, mostly outwards and up.
            let normal = (away + 0.9 * ball(random) + 0.4 * DVec3::Z).normalize_or(DVec3::Z);
            // Leaves deep in a clump are darker.
            let tone = random.range(0.72, 1.28) * (0.5 + 0.5 * depth);
            let mut paint = green.times(tone);
            paint.rgb.x *= random.range(0.82, 1.18);
            // Leaves that point down or lie deep in the crown get little light from the sky.
            let rgb = painter.shade(mean_m, normal, &paint.open(0.70 + 0.30 * away.z));
            let size_m = self.size_m * random.range(0.8, 1.5);
            let sigmas_m = DVec3::new(1.4 * size_m, size_m, 0.012);
            let turn_rad = random.range(0.0, std::f64::consts::PI);
            let rotation =
                // First a turn within the leaf's plane: the arc alone would align all leaves of one
                // normal.
                DQuat::from_rotation_arc(DVec3::Z, normal) * DQuat::from_rotation_z(turn_rad);
            painter.gaussian(mean_m, rotation, sigmas_m, 0.93, rgb, DVec3::ZERO);
        }
    }
}

/// A round stem from end to end, thinner towards the second.
fn stem(painter: &mut Painter, ends_m: [DVec3; 2], radii_m: [f64; 2], bark: Paint) {
    let axis = (ends_m[1] - ends_m[0]).normalize();
    let (side, front) = axis.any_orthonormal_pair();
    let around = painter.even(0.0, std::f64::consts::TAU, 0.9);
    let along = painter.even(0.0, 1.0, 0.28 / ends_m[0].distance(ends_m[1]));
    let place = |angle_rad: f64, t: f64| {
        let (sin, cos) = angle_rad.sin_cos();
        let radius_m = radii_m[0] + t * (radii_m[1] - radii_m[0]);
        ends_m[0].lerp(ends_m[1], t) + radius_m * (cos * side + sin * front)
    };
    painter.sheet(&around, &along, place, |angle_rad, t| {
        let tone = noise(9, 3.0 * angle_rad, 4.0 * t);
        Some(bark.times(1.0 + 0.15 * tone))
    });
}

/// Uniform in the unit ball.
fn ball(random: &mut Random) -> DVec3 {
    // Rejection: the ball fills pi/6, about half, of the cube.
    loop {
        let mut axis = || random.range(-1.0, 1.0);
        let point = DVec3::new(axis(), axis(), axis());
        if point.length_squared() <= 1.0 {
            return point;
        }
    }
}
