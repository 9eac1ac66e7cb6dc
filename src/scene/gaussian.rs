//! Gaussians as a trainer wrote them: raw parameters, before activation.

use super::sh;

/// Raw Gaussians, as columns of equal length `n`.
///
/// Activation (Kerbl et al. 2023, section 5.1): `scale = exp(ln_scale)`, `opacity = sigmoid(logit)`, and the
/// quaternion is normalised. The covariance is `R S Sᵀ Rᵀ`, where `R` is the rotation and `S` the diagonal
/// matrix of the scales.
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
/// assert_eq!(gaussians.sh_of(0), [0.5, 0.4, 0.3]);
///
/// gaussians.raise_sh_degree(1);
/// assert_eq!(gaussians.sh_of(0).len(), 3 * 4); // (1 + 1)² coefficients
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Spherical-harmonic degree of the colour, 0 to 3.
    pub sh_degree: u8,
    /// Means, in metres along the axes of the file or twin. They are f64 because the coordinates of a twin
    /// may be as large as 4.5e6 m.
    pub means_m: Vec<[f64; 3]>,
    /// Rotations (w, x, y, z) that take principal axes to world axes; of any length except zero.
    pub quats_wxyz: Vec<[f32; 4]>,
    /// Natural logarithm of the standard deviation in metres along each principal axis.
    pub ln_scales: Vec<[f32; 3]>,
    /// Opacity before the sigmoid.
    pub logit_opacities: Vec<f32>,
    /// `[n, (sh_degree + 1)², 3]`: coefficient-major, then red, green, blue; the first is DC.
    pub sh: Vec<f32>,
}

impl Gaussians {
    /// No Gaussians yet, with capacity for `n`.
    pub fn with_capacity(sh_degree: u8, n: usize) -> Self {
        Self {
            sh_degree,
            means_m: Vec::with_capacity(n),
            quats_wxyz: Vec::with_capacity(n),
            ln_scales: Vec::with_capacity(n),
            logit_opacities: Vec::with_capacity(n),
            sh: Vec::with_capacity(n * 3 * sh::coefficients(sh_degree)),
        }
    }

    /// Reserves capacity for exactly `n` more Gaussians.
    pub fn reserve_exact(&mut self, n: usize) {
        self.means_m.reserve_exact(n);
        self.quats_wxyz.reserve_exact(n);
        self.ln_scales.reserve_exact(n);
        self.logit_opacities.reserve_exact(n);
        self.sh.reserve_exact(n * 3 * sh::coefficients(self.sh_degree));
    }

    /// Appends the Gaussian `others[index]`. `others` must have the same SH degree.
    pub fn push_from(&mut self, others: &Self, index: usize) {
        self.means_m.push(others.means_m[index]);
        self.quats_wxyz.push(others.quats_wxyz[index]);
        self.ln_scales.push(others.ln_scales[index]);
        self.logit_opacities.push(others.logit_opacities[index]);
        self.sh.extend_from_slice(others.sh_of(index));
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means_m.is_empty()
    }

    /// Raises the SH degree to `degree` by appending zero coefficients, which change no colour. A lower
    /// degree changes nothing.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        let from = 3 * sh::coefficients(self.sh_degree);
        let to = 3 * sh::coefficients(degree);
        if from < to {
            let mut raised = vec![0.0; self.len() * to];
            for (new, old) in raised.chunks_exact_mut(to).zip(self.sh.chunks_exact(from)) {
                new[..from].copy_from_slice(old);
            }
            self.sh = raised;
            self.sh_degree = degree;
        }
    }

    /// SH coefficients of one Gaussian: `[(sh_degree + 1)², 3]`.
    pub fn sh_of(&self, index: usize) -> &[f32] {
        let stride = 3 * sh::coefficients(self.sh_degree);
        &self.sh[index * stride..(index + 1) * stride]
    }
}
