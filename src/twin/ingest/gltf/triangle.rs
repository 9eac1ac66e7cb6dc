//! Covers a triangle with flat Gaussians.
//!
//! A triangle is cut into k² similar ones, each about as large as its share of the whole surface.
//! Each part becomes a Gaussian with the mean and covariance of a uniform triangle, widened so that
//! neighbours leave no gaps.

use std::sync::Arc;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3, DVec4};
use image::RgbaImage;

use crate::ingest::activation;
use wildcity_scene::Gaussians;
use wildcity_scene::srgb::{linear_from_stored, stored_from_linear};

/// Ratio of a Gaussian's standard deviation to that of its triangle. Whatever the triangle's shape,
/// a covered surface lets 4 % of the light through, 9 % at most. With 1.7 these are 8 and 19 %, and
/// what lies behind shows; with 2.1 they are 2 and 4 %, and edges lie 0.3 to 0.6 px farther out at
/// 3 and 5 m. `tests/actors/softness.py` compares them.
const WIDER: f64 = 1.9;
/// Longest edge of a triangle that becomes one Gaussian, in edges of a square with the area of a
/// share. The Gaussian of a longer, narrow triangle would reach beyond its ends.
pub(super) const LONGEST: f64 = 4.0;
/// The most halvings of one triangle. Every second one halves its length, so a rail of 4 m becomes
/// pieces of 6 cm.
const HALVINGS: u32 = 12;
/// Ratio of thickness to length.
const FLATNESS: f64 = 0.02;
/// Opacity of an opaque material.
const OPACITY: f64 = 0.97;

/// A triangle of the scene.
#[derive(Clone)]
pub(super) struct Triangle {
    pub(super) corners_m: [DVec3; 3],
    /// Linear red, green, blue, and opacity at the corners, before the texture's.
    pub(super) colors: [DVec4; 3],
    /// Coordinates in the texture of the base colour.
    pub(super) uv: [DVec2; 3],
    /// Coordinates in the texture of the emitted light, which few materials have.
    pub(super) emissive_uv: Option<Box<[DVec2; 3]>>,
    pub(super) material: Arc<Material>,
}

/// The properties that all triangles of a primitive share.
pub(super) struct Material {
    pub(super) texture: Option<Texture>,
    pub(super) emission: Option<Emission>,
    /// Opacity below which a point is invisible.
    pub(super) cutoff: f64,
    /// Whether alpha is ignored.
    pub(super) is_solid: bool,
}

/// The light that a material emits.
pub(super) struct Emission {
    /// Linear red, green and blue, before the texture's; may be above 1.
    pub(super) factor: DVec3,
    pub(super) texture: Option<Texture>,
}

pub(super) type Texture = Arc<RgbaImage>;

impl Triangle {
    pub(super) fn area_m2(&self) -> f64 {
        let [a, b, c] = self.corners_m;
        let area_m2 = 0.5 * (b - a).cross(c - a).length();
        if area_m2.is_finite() { area_m2 } else { 0.0 }
    }

    /// Cuts the triangle across its longest edge, again and again, until that edge is short, or not
    /// much longer than the triangle is wide.
    pub(super) fn halved(self, longest_m: f64) -> Vec<Self> {
        let mut whole = vec![(self, 0)];
        let mut parts = Vec::new();
        while let Some((triangle, halvings)) = whole.pop() {
            let edge_m = |k: usize| triangle.corners_m[k].distance(triangle.corners_m[(k + 1) % 3]);
            let k = (0..3).max_by(|&a, &b| edge_m(a).total_cmp(&edge_m(b))).unwrap_or(0);
            let width_m = 2.0 * triangle.area_m2() / edge_m(k);
            // Says what must hold, so that NaN is not long.
            let is_long = edge_m(k) > longest_m && edge_m(k) > LONGEST * width_m;
            if !is_long || halvings == HALVINGS {
                parts.push(triangle);
                continue;
            }
            // Each end of the edge is moved to its middle in turn, which makes the two halves.
            for replaced in [k, (k + 1) % 3] {
                let mut half = triangle.clone();
                let other = if replaced == k { (k + 1) % 3 } else { k };
                half.corners_m[replaced] =
                    0.5 * (triangle.corners_m[replaced] + triangle.corners_m[other]);
                half.colors[replaced] = 0.5 * (triangle.colors[replaced] + triangle.colors[other]);
                half.uv[replaced] = 0.5 * (triangle.uv[replaced] + triangle.uv[other]);
                if let (Some(half), Some(uv)) = (&mut half.emissive_uv, &triangle.emissive_uv) {
                    half[replaced] = 0.5 * (uv[replaced] + uv[other]);
                }
                whole.push((half, halvings + 1));
            }
        }
        parts
    }

    /// Number of parts that each edge is cut into; 0 for a triangle without area.
    pub(super) fn cuts(&self, share_m2: f64) -> u32 {
        // A triangle is at most the whole surface, so this is at most the square root of
        // MESH_GAUSSIANS.
        (self.area_m2() / share_m2).sqrt().ceil() as u32
    }

    /// Appends the Gaussians of all parts, without invisible ones.
    pub(super) fn cover(&self, cuts: u32, all: &mut Gaussians) {
        let Some((quat_wxyz, scales_m)) = self.shape(cuts) else { return };
        let ln_scales = scales_m.map(activation::ln_scale);
        for i in 0..cuts {
            for j in 0..cuts - i {
                let centre = |third: f64| [f64::from(i) + third, f64::from(j) + third];
                let upright = Some(centre(1.0 / 3.0));
                // Beside each upright part lies an inverted one, except at the edge opposite the
                // first corner.
                let turned = (j + 1 < cuts - i).then(|| centre(2.0 / 3.0));
                for [u, v] in upright.into_iter().chain(turned) {
                    let [u, v] = [u, v].map(|share| share / f64::from(cuts));
                    let (rgb, opacity) = self.color([1.0 - u - v, u, v]);
                    if opacity <= 0.0 {
                        continue;
                    }
                    let [a, b, c] = self.corners_m;
                    all.means_m.push((a + u * (b - a) + v * (c - a)).to_array());
                    all.quats_wxyz.push(quat_wxyz);
                    all.ln_scales.push(ln_scales);
                    all.logit_opacities.push(activation::logit(OPACITY * opacity));
                    all.sh.extend(rgb.map(activation::dc));
                }
            }
        }
    }

    /// Rotation (w, x, y, z) and standard deviations, in metres, of each part. A uniform triangle
    /// has the covariance Σ (corner - centre)(corner - centre)ᵀ / 12, the same for upright and
    /// inverted parts.
    fn shape(&self, cuts: u32) -> Option<([f32; 4], [f64; 3])> {
        let [a, b, c] = self.corners_m;
        let normal = (b - a).cross(c - a).try_normalize()?;
        let across = (b - a).try_normalize()?;
        let up = normal.cross(across);
        let centre_m = (a + b + c) / 3.0;
        let mut covariance = DMat2::ZERO;
        for corner_m in self.corners_m {
            let d = DVec2::new(across.dot(corner_m - centre_m), up.dot(corner_m - centre_m));
            covariance += DMat2::from_cols(d * d.x, d * d.y);
        }
        covariance *= (WIDER / f64::from(cuts)).powi(2) / 12.0;
        // The eigenvectors and eigenvalues of a symmetric 2 x 2 matrix: the angle of the major axis
        // is atan2(2 xy, xx - yy) / 2, the variances are (xx + yy) / 2 ± √((xx - yy)² / 4 + xy²).
        let xx = covariance.x_axis.x;
        let xy = covariance.x_axis.y;
        let yy = covariance.y_axis.y;
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let spread = (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
        let middle = 0.5 * (xx + yy);
        // Rounding may bring the smaller variance below 0.
        let [long_m, short_m] = [middle + spread, (middle - spread).max(0.0)].map(f64::sqrt);
        let long = angle.cos() * across + angle.sin() * up;
        let axes = DMat3::from_cols(long, normal.cross(long), normal);
        let DQuat { x, y, z, w } = DQuat::from_mat3(&axes).normalize();
        Some(([w, x, y, z].map(|q| q as f32), [long_m, short_m, FLATNESS * long_m]))
    }

    /// Display colour and opacity, 0 to 1, at a point given by its barycentric coordinates. The
    /// colour is the linear base colour plus the emitted light, encoded.
    fn color(&self, shares: [f64; 3]) -> ([f64; 3], f64) {
        let weighted = |values: [DVec4; 3]| (0..3).map(|k| shares[k] * values[k]).sum::<DVec4>();
        let texel = |image: &Texture, corners: [DVec2; 3]| {
            sample(image, (0..3).map(|k| shares[k] * corners[k]).sum::<DVec2>())
        };
        let Material { texture, emission, cutoff, is_solid } = &*self.material;
        let mut color = weighted(self.colors);
        if let Some(image) = texture {
            color *= texel(image, self.uv);
        }
        let mut light = DVec3::ZERO;
        if let Some(emission) = emission {
            let share = match (&emission.texture, &self.emissive_uv) {
                (Some(image), Some(uv)) => texel(image, **uv).truncate(),
                _ => DVec3::ONE,
            };
            light = emission.factor * share;
        }
        let opacity = match color.w {
            _ if *is_solid => 1.0,
            // The condition says what is visible, so that NaN is not.
            alpha if alpha >= *cutoff => alpha.clamp(0.0, 1.0),
            _ => 0.0,
        };
        let seen = (color.truncate() + light).clamp(DVec3::ZERO, DVec3::ONE);
        (seen.to_array().map(stored_from_linear), opacity)
    }
}

/// Linear red, green and blue, and alpha, at a point of an image.
fn sample(image: &RgbaImage, uv: DVec2) -> DVec4 {
    // Repeated, which is glTF's default.
    // Just below 0, `rem_euclid` rounds up to 1, hence the minimum.
    let place =
        |share: f64, size: u32| ((share.rem_euclid(1.0) * f64::from(size)) as u32).min(size - 1);
    let texel = image.get_pixel(place(uv.x, image.width()), place(uv.y, image.height()));
    let [red, green, blue, alpha] = texel.0.map(|value| f64::from(value) / 255.0);
    let [red, green, blue] = [red, green, blue].map(linear_from_stored);
    DVec4::new(red, green, blue, alpha)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn material(cutoff: f64) -> Material {
        Material { texture: None, emission: None, cutoff, is_solid: false }
    }

    fn triangle(corners_m: [[f64; 3]; 3]) -> Triangle {
        Triangle {
            corners_m: corners_m.map(DVec3::from_array),
            colors: [DVec4::new(1.0, 0.0, 0.0, 1.0), DVec4::Y, DVec4::Z].map(|c| c.with_w(1.0)),
            uv: [DVec2::ZERO; 3],
            emissive_uv: None,
            material: material(0.0).into(),
        }
    }

    /// The parts together have the triangle's own mean, and its covariance: that of their centres
    /// and their own, which is widened.
    #[test]
    fn the_parts_have_the_moments_of_the_whole() {
        let whole = triangle([[1.0, 2.0, 3.0], [4.0, 2.5, 2.0], [0.0, 5.0, 7.0]]);
        let [a, b, c] = whole.corners_m;
        let centre_m = (a + b + c) / 3.0;
        let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        let exact = whole.corners_m.map(|m| outer(m - centre_m)).into_iter().sum::<DMat3>() / 12.0;
        for cuts in [1, 2, 7] {
            let mut parts = Gaussians::with_capacity(0, 0);
            whole.cover(cuts, &mut parts);
            assert_eq!(parts.len(), (cuts * cuts) as usize);
            let share = 1.0 / parts.len() as f64;
            let mean_m: DVec3 =
                parts.means_m.iter().map(|&mean_m| share * DVec3::from_array(mean_m)).sum();
            assert!((mean_m - centre_m).length() < 1e-12, "{mean_m}");
            let mut covariance = DMat3::ZERO;
            for i in 0..parts.len() {
                let [w, x, y, z] = parts.quats_wxyz[i].map(f64::from);
                let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
                // Flat parts: the third axis is what was added.
                let [long, short, _] = parts.ln_scales[i].map(|ln| f64::from(ln).exp() / WIDER);
                let half = axes * DMat3::from_diagonal(DVec3::new(long, short, 0.0));
                let d = DVec3::from_array(parts.means_m[i]) - centre_m;
                covariance += (outer(d) + half * half.transpose()) * share;
            }
            let off = (covariance - exact).to_cols_array().map(f64::abs);
            assert!(off.iter().all(|&off| off < 1e-6), "{cuts}: {off:?}");
        }
    }

    /// The light that a covered surface lets through, between its Gaussians and on average.
    #[test]
    fn a_covered_surface_lets_little_through() {
        for third in [[0.0, 1.0, 0.0], [0.5, 0.9, 0.0], [3.0, 0.5, 0.0]] {
            let whole = triangle([[0.0; 3], [1.0, 0.0, 0.0], third]);
            let cuts = 24;
            let mut parts = Gaussians::with_capacity(0, 0);
            whole.cover(cuts, &mut parts);
            let [a, b, c] = whole.corners_m;
            let through = |u: f64, v: f64| -> f64 {
                let at_m = a + u * (b - a) + v * (c - a);
                let one = |i: usize| {
                    let [w, x, y, z] = parts.quats_wxyz[i].map(f64::from);
                    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
                    let off = axes.transpose() * (at_m - DVec3::from_array(parts.means_m[i]));
                    let [long, short, _] = parts.ln_scales[i].map(|ln| f64::from(ln).exp());
                    1.0 - OPACITY
                        * (-0.5 * ((off.x / long).powi(2) + (off.y / short).powi(2))).exp()
                };
                (0..parts.len()).map(one).product()
            };
            // One cell in the middle.
            let points = (0..400).map(|k| (f64::from(k % 20), f64::from(k / 20)));
            let place = |share: f64| (8.0 + share / 20.0) / f64::from(cuts);
            let lets: Vec<f64> = points.map(|(u, v)| through(place(u), place(v))).collect();
            let mean = lets.iter().sum::<f64>() / 400.0;
            let most = lets.iter().copied().fold(0.0, f64::max);
            assert!(mean < 0.05 && most < 0.1, "{third:?}: {mean} on average, {most} at most");
        }
    }

    #[test]
    fn a_rail_is_halved_until_its_parts_are_short() {
        let rail = triangle([[0.0; 3], [5.0, 0.0, 0.0], [5.0, 0.01, 0.0]]);
        let area_m2 = rail.area_m2();
        let parts = rail.halved(0.1);
        // One of its two long edges is halved first, and then the edges of both halves in turn.
        assert!((100..=1 << HALVINGS).contains(&parts.len()), "{}", parts.len());
        let sum_m2: f64 = parts.iter().map(Triangle::area_m2).sum();
        assert!((sum_m2 / area_m2 - 1.0).abs() < 1e-12);
        let sides_m = parts.iter().flat_map(|part| {
            let [a, b, c] = part.corners_m;
            [a.distance(b), b.distance(c), c.distance(a)]
        });
        let longest_m = sides_m.fold(0.0, f64::max);
        assert!(longest_m <= 0.1, "{longest_m}");
        // However long, and however thin; and what is not thin stays whole.
        let line = triangle([[0.0; 3], [1e9, 0.0, 0.0], [2e9, 0.0, 0.0]]);
        assert_eq!(line.halved(1e-3).len(), 1 << HALVINGS);
        assert_eq!(triangle([[0.0; 3], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]]).halved(0.1).len(), 1);
    }

    #[test]
    fn colour_runs_between_the_corners_and_what_is_cut_off_is_not_there() {
        let mut whole = triangle([[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let ([red, green, blue], opacity) = whole.color([0.5, 0.5, 0.0]);
        assert_eq!((red, blue, opacity), (green, 0.0, 1.0));
        assert!((red - 0.7354).abs() < 1e-4, "half the light, displayed: {red}");
        whole.material = material(2.0).into();
        let mut parts = Gaussians::with_capacity(0, 0);
        whole.cover(3, &mut parts);
        assert_eq!(parts.len(), 0);
        // A line gives no Gaussians.
        let line = triangle([[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!(line.cuts(1e-3), 0);
        line.cover(1, &mut parts);
        assert_eq!(parts.len(), 0);
    }
}
