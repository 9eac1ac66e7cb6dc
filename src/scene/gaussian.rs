//! Gaussians as a trainer wrote them: raw parameters, before activation.

use super::sh;

/// Raw Gaussians, as columns of equal length `n`.
///
/// Activation (Kerbl et al. 2023): `scale = exp(ln_scale)`, `opacity = sigmoid(logit)`, the
/// quaternion normalised; the covariance is `R S Sᵀ Rᵀ`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Spherical-harmonic degree of the colour, 0 to 3.
    pub sh_degree: u8,
    /// Centres, in metres along the axes of the file or twin. f64: a twin may lie at 4.5e6 m.
    pub means_m: Vec<[f64; 3]>,
    /// Rotations (w, x, y, z), of any length but zero.
    pub quats_wxyz: Vec<[f32; 4]>,
    /// Natural logarithm of the standard deviation along each own axis, of metres.
    pub ln_scales: Vec<[f32; 3]>,
    /// Opacity before the sigmoid.
    pub logit_opacities: Vec<f32>,
    /// `[n, (sh_degree + 1)², 3]`: coefficient-major, then red, green, blue; the first is DC.
    pub sh: Vec<f32>,
}

impl Gaussians {
    /// No Gaussians yet, with room for `n`.
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

    /// Makes room for `n` more, and no further.
    pub fn reserve_exact(&mut self, n: usize) {
        self.means_m.reserve_exact(n);
        self.quats_wxyz.reserve_exact(n);
        self.ln_scales.reserve_exact(n);
        self.logit_opacities.reserve_exact(n);
        self.sh.reserve_exact(n * 3 * sh::coefficients(self.sh_degree));
    }

    /// Adds one of others, which have the same SH degree.
    pub fn push_from(&mut self, others: &Self, index: usize) {
        self.means_m.push(others.means_m[index]);
        self.quats_wxyz.push(others.quats_wxyz[index]);
        self.ln_scales.push(others.ln_scales[index]);
        self.logit_opacities.push(others.logit_opacities[index]);
        self.sh.extend_from_slice(others.sh_of(index));
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.means_m.is_empty()
    }

    /// Adds coefficients of zero, which change no colour, up to a degree that is not lower.
    pub fn raise_sh_degree(&mut self, degree: u8) {
        let (from, to) = (3 * sh::coefficients(self.sh_degree), 3 * sh::coefficients(degree));
        if from < to {
            let mut raised = vec![0.0; self.len() * to];
            for (new, old) in raised.chunks_exact_mut(to).zip(self.sh.chunks_exact(from)) {
                new[..from].copy_from_slice(old);
            }
            (self.sh, self.sh_degree) = (raised, degree);
        }
    }

    /// Colour coefficients of one Gaussian: `[(sh_degree + 1)², 3]`.
    pub fn sh_of(&self, index: usize) -> &[f32] {
        let stride = 3 * sh::coefficients(self.sh_degree);
        &self.sh[index * stride..(index + 1) * stride]
    }
}
