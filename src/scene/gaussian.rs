//! Gaussians as a trainer wrote them: raw parameters, before activation.

use std::ops::Range;

use glam::{DQuat, DVec3};

use super::geometry::Pose;
use super::semantics::SemanticClass;
use super::sh;
use super::validate::{FULL_LOGIT, LN_SCALE, MAX_SH};

/// Raw Gaussians, as columns of equal length `n`.
///
/// Activation (Kerbl et al. 2023, section 5.1): `scale = exp(ln_scale)`,
/// `opacity = sigmoid(logit)`, and the quaternion is normalised. The covariance is `R S Sᵀ Rᵀ`,
/// where `R` is the rotation and `S` the diagonal matrix of the scales.
///
/// ```
/// use wildcity_scene::Gaussians;
///
/// let mut gaussians = Gaussians::with_capacity(0, 1);
/// gaussians.means_m.push([1.0, 2.0, 0.5]);
/// gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
/// gaussians.ln_scales.push([-3.0; 3]);
/// gaussians.logit_opacities.push(2.0);
/// gaussians.sh.extend([0.5, 0.4, 0.3]); // one coefficient: red, green, blue
/// assert_eq!(gaussians.sh_at(0), [0.5, 0.4, 0.3]);
///
/// gaussians.raise_sh_degree(1);
/// assert_eq!(gaussians.sh_at(0).len(), 3 * 4); // (1 + 1)² coefficients
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Spherical-harmonic degree of the colour, 0 to 3.
    pub sh_degree: u8,
    /// Means, in metres along the axes of the file or twin. They are f64 because the coordinates of
    /// a twin may be as large as 4.5e6 m.
    pub means_m: Vec<[f64; 3]>,
    /// Rotations (w, x, y, z) that take principal axes to world axes; of any length except zero.
    pub quats_wxyz: Vec<[f32; 4]>,
    /// Natural logarithm of the standard deviation in metres along each principal axis.
    pub ln_scales: Vec<[f32; 3]>,
    /// Opacity before the sigmoid.
    pub logit_opacities: Vec<f32>,
    /// `[n, (sh_degree + 1)², 3]`: coefficient-major, then red, green, blue; the first is DC.
    pub sh: Vec<f32>,
    /// The class of each Gaussian, if the scene has classes.
    pub classes: Option<Vec<SemanticClass>>,
}

impl Gaussians {
    /// An empty set with room for `n` Gaussians.
    pub fn with_capacity(sh_degree: u8, n: usize) -> Self {
        Self {
            sh_degree,
            means_m: Vec::with_capacity(n),
            quats_wxyz: Vec::with_capacity(n),
            ln_scales: Vec::with_capacity(n),
            logit_opacities: Vec::with_capacity(n),
            sh: Vec::with_capacity(n * 3 * sh::coefficients(sh_degree)),
            classes: None,
        }
    }

    /// Reserves memory for exactly `n` more Gaussians.
    pub fn reserve_exact(&mut self, n: usize) {
        // Exact and not amortised: the count of a file is known before it is read, and a reserve of
        // half as much again would be gigabytes.
        self.means_m.reserve_exact(n);
        self.quats_wxyz.reserve_exact(n);
        self.ln_scales.reserve_exact(n);
        self.logit_opacities.reserve_exact(n);
        self.sh.reserve_exact(n * 3 * sh::coefficients(self.sh_degree));
        if let Some(classes) = &mut self.classes {
            classes.reserve_exact(n);
        }
    }

    /// Appends one Gaussian of `others`, which must have the same SH degree.
    pub fn push_from(&mut self, others: &Self, index: usize) {
        self.append_classes(others, index..index + 1);
        self.means_m.push(others.means_m[index]);
        self.quats_wxyz.push(others.quats_wxyz[index]);
        self.ln_scales.push(others.ln_scales[index]);
        self.logit_opacities.push(others.logit_opacities[index]);
        self.sh.extend_from_slice(others.sh_at(index));
    }

    /// Appends all Gaussians of `others`. Where the SH degrees differ, the result has the higher
    /// one: the missing coefficients are zero, which changes no colour. Where one of the two has
    /// classes, the Gaussians of the other become [`SemanticClass::Unlabelled`].
    pub fn append(&mut self, others: &Self) {
        self.append_range(others, 0..others.len());
    }

    /// Appends the Gaussians of `others` whose indices are in `range`, as [`Self::append`] does.
    pub fn append_range(&mut self, others: &Self, range: Range<usize>) {
        self.raise_sh_degree(others.sh_degree);
        self.append_classes(others, range.clone());
        self.means_m.extend_from_slice(&others.means_m[range.clone()]);
        self.quats_wxyz.extend_from_slice(&others.quats_wxyz[range.clone()]);
        self.ln_scales.extend_from_slice(&others.ln_scales[range.clone()]);
        self.logit_opacities.extend_from_slice(&others.logit_opacities[range.clone()]);
        let own = 3 * sh::coefficients(others.sh_degree);
        let raised = 3 * sh::coefficients(self.sh_degree);
        // Equal degrees, the usual case: one copy of all coefficients.
        if own == raised {
            self.sh.extend_from_slice(&others.sh[range.start * own..range.end * own]);
            return;
        }
        self.sh.reserve(range.len() * raised);
        for index in range {
            self.sh.extend_from_slice(others.sh_at(index));
            self.sh.resize(self.sh.len() + raised - own, 0.0);
        }
    }

    /// Appends classes of `others`. The Gaussians themselves are appended after them.
    fn append_classes(&mut self, others: &Self, range: Range<usize>) {
        let len = self.len();
        match (&mut self.classes, &others.classes) {
            (None, None) => {}
            (own, Some(classes)) => {
                let unlabelled = || vec![SemanticClass::Unlabelled; len];
                own.get_or_insert_with(unlabelled).extend_from_slice(&classes[range]);
            }
            (Some(own), None) => own.resize(len + range.len(), SemanticClass::Unlabelled),
        }
    }

    /// The classes of some indices, in the order of the indices; `None` without classes.
    pub fn select_classes(
        &self,
        indices: impl Iterator<Item = usize>,
    ) -> Option<Vec<SemanticClass>> {
        let classes = self.classes.as_ref()?;
        Some(indices.map(|index| classes[index]).collect())
    }

    /// The Gaussians of some indices, in the order of the indices.
    pub fn select(&self, indices: impl IntoIterator<Item = usize>) -> Self {
        let indices = indices.into_iter();
        let mut selected = Self::with_capacity(self.sh_degree, indices.size_hint().0);
        // Also where nothing is selected: a part of a scene with classes has them, too.
        selected.classes = self.classes.as_ref().map(|_| Vec::new());
        for index in indices {
            selected.push_from(self, index);
        }
        selected
    }

    /// Moves and rotates all Gaussians with their colours, from the axes of `b` to those of `a`.
    pub fn transform(&mut self, a_from_b: &Pose) {
        for mean_m in &mut self.means_m {
            *mean_m = a_from_b.transform_point(DVec3::from_array(*mean_m)).to_array();
        }
        for quat in &mut self.quats_wxyz {
            let [w, x, y, z] = quat.map(f64::from);
            // The rotation is composed on the left: the principal axes turn with the Gaussian. In
            // f64, as the result is rounded once.
            let q = a_from_b.rotation * DQuat::from_xyzw(x, y, z, w);
            *quat = [q.w, q.x, q.y, q.z].map(|q| q as f32);
        }
        let colors = sh::ShRotation::new(a_from_b.rotation_matrix(), self.sh_degree);
        for color in self.sh.chunks_exact_mut(3 * sh::coefficients(self.sh_degree)) {
            colors.apply(color);
        }
        // Rotations keep the length of a band's vector, so that one coefficient may grow up to the
        // square root of the band's size.
        self.clamp_coefficients();
    }

    /// Replaces coefficients beyond the bound by the nearest within it: a rotation may turn several
    /// at the bound into one beyond.
    pub fn clamp_coefficients(&mut self) {
        for coefficient in &mut self.sh {
            *coefficient = coefficient.clamp(-MAX_SH, MAX_SH);
        }
    }

    /// Replaces values that no file needs to avoid and that have a nearest one within the bounds of
    /// [`validate`](super::validate): opacities of 0 and 1, whose logit is infinite, and scales
    /// below the smallest one.
    pub fn clamp_activations(&mut self) {
        for logit in self.logit_opacities.iter_mut().filter(|logit| logit.is_infinite()) {
            *logit = FULL_LOGIT.copysign(*logit);
        }
        self.ln_scales.as_flattened_mut().iter_mut().for_each(raise_to_smallest);
    }

    /// Scales all Gaussians about the origin. A factor of 1 changes no bit. Scales that would
    /// become smaller than the smallest one become that one.
    pub fn scale(&mut self, factor: f64) {
        if factor == 1.0 {
            return;
        }
        // A factor on a scale is a summand of its logarithm.
        let ln = factor.ln();
        for mean in &mut self.means_m {
            *mean = mean.map(|m| m * factor);
        }
        for scale in &mut self.ln_scales {
            *scale = scale.map(|s| (f64::from(s) + ln) as f32);
            scale.iter_mut().for_each(raise_to_smallest);
        }
    }

    /// Number of Gaussians: the length of each column.
    pub fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means_m.is_empty()
    }

    /// Raises the SH degree to `degree` with coefficients of zero, which change no colour. A lower
    /// `degree` than the present one changes nothing.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        let from = 3 * sh::coefficients(self.sh_degree);
        let to = 3 * sh::coefficients(degree);
        if from < to {
            // Rows become wider, so that the whole array is laid out again: O(n), and memory for
            // both at once.
            let mut raised = vec![0.0; self.len() * to];
            for (new, old) in raised.chunks_exact_mut(to).zip(self.sh.chunks_exact(from)) {
                new[..from].copy_from_slice(old);
            }
            self.sh = raised;
            self.sh_degree = degree;
        }
    }

    /// SH coefficients of one Gaussian: `[(sh_degree + 1)², 3]`.
    pub fn sh_at(&self, index: usize) -> &[f32] {
        let stride = 3 * sh::coefficients(self.sh_degree);
        &self.sh[index * stride..(index + 1) * stride]
    }
}

/// NaN stays NaN, which validation refuses.
fn raise_to_smallest(ln_scale: &mut f32) {
    if *ln_scale < LN_SCALE[0] {
        *ln_scale = LN_SCALE[0];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gaussians in which every number identifies the Gaussian that it belongs to.
    fn numbered(sh_degree: u8, numbers: &[u8]) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(sh_degree, numbers.len());
        for &number in numbers {
            gaussians.means_m.push([f64::from(number), 0.5, 0.25]);
            gaussians.quats_wxyz.push([f32::from(number); 4]);
            gaussians.ln_scales.push([-f32::from(number); 3]);
            gaussians.logit_opacities.push(f32::from(number));
            gaussians.sh.extend(
                (0..3 * sh::coefficients(sh_degree)).map(|k| 100.0 * f32::from(number) + k as f32),
            );
        }
        gaussians
    }

    #[test]
    fn appended_gaussians_come_last() {
        let mut all = numbered(1, &[1, 2]);
        all.append(&numbered(1, &[3]));
        assert_eq!(all, numbered(1, &[1, 2, 3]));
        all.append_range(&numbered(1, &[7, 8, 9, 10]), 1..3);
        assert_eq!(all, numbered(1, &[1, 2, 3, 8, 9]));
        all.append(&Gaussians::default());
        assert_eq!(all, numbered(1, &[1, 2, 3, 8, 9]));
    }

    #[test]
    fn the_higher_sh_degree_wins_on_either_side() {
        let mut expected = numbered(0, &[1]);
        expected.raise_sh_degree(2);
        expected.append(&numbered(2, &[5]));
        assert_eq!(expected.sh[3..27], [0.0; 24]);
        assert_eq!(expected.sh[27..], numbered(2, &[5]).sh);

        let mut raised = numbered(0, &[1]);
        raised.append(&numbered(2, &[5]));
        assert_eq!(raised, expected);

        let mut first = numbered(2, &[5]);
        first.append(&numbered(0, &[1]));
        assert_eq!(first.sh_degree, 2);
        assert_eq!(first.sh_at(0), numbered(2, &[5]).sh_at(0));
        assert_eq!(first.sh_at(1)[..3], numbered(0, &[1]).sh);
        assert_eq!(first.sh_at(1)[3..], [0.0; 24]);
    }

    #[test]
    fn selected_gaussians_are_in_the_order_of_their_indices() {
        let all = numbered(3, &[1, 2, 3, 4]);
        assert_eq!(all.select([3, 0, 0]), numbered(3, &[4, 1, 1]));
        assert_eq!(all.select(0..4), all);
        assert_eq!(all.select([]), Gaussians { sh_degree: 3, ..Gaussians::default() });
    }

    #[test]
    fn classes_go_with_their_gaussians() {
        use SemanticClass::{Car, Road, Unlabelled};
        let mut labelled = numbered(0, &[1, 2]);
        labelled.classes = Some(vec![Road, Car]);
        assert_eq!(labelled.select([1, 0, 1]).classes, Some(vec![Car, Road, Car]));
        // Whichever of the two has classes.
        let mut all = numbered(0, &[3]);
        all.append(&labelled);
        assert_eq!(all.classes, Some(vec![Unlabelled, Road, Car]));
        labelled.append_range(&numbered(1, &[4, 5, 6]), 1..3);
        assert_eq!(labelled.classes, Some(vec![Road, Car, Unlabelled, Unlabelled]));
        labelled.push_from(&numbered(1, &[7]), 0);
        assert_eq!(labelled.classes.as_ref().map(Vec::len), Some(labelled.len()));
        let mut none = numbered(0, &[1]);
        none.append(&numbered(0, &[2]));
        assert_eq!(none.classes, None);
    }
}
